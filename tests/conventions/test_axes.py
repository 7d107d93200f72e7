"""Rows are y, columns are x, and centres are (x, y). docs/conventions.md, "Axes"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.optics.otf import analytic_otf
from torchmask.optics.psf import psf_from_samples

GRID = tm.Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)


def pair(x, y):
    """Two holes whose separation is (x, y) [m]."""
    return tm.SparseAperture([[x / 2, y / 2], [-x / 2, -y / 2]], subaperture_diameter=0.1, mask_diameter=1.0)


@pytest.mark.parametrize(("x", "y"), [(0.5, 0.0), (0.0, 0.5)])
def test_a_baseline_along_x_is_a_peak_along_the_columns(x, y):
    modulus = tm.OTF(pair(x, y), GRID)().abs()
    row, column = round(64 * y / GRID.period), round(64 * x / GRID.period)
    assert float(modulus[row, column]) == pytest.approx(0.5, abs=0.02)  # two of the four pairs, on top of each other
    assert float(modulus[column, row]) < 0.02


def test_a_hole_to_the_right_lies_on_columns_of_positive_frequency():
    mask = tm.SparseAperture([[0.4, -0.1], [-0.4, -0.1]], 0.1, 1.0)
    samples = mask.samples(GRID)
    columns, rows = samples.index[0] % 64, samples.index[0] // 64  # of the hole at x = +0.4 m, y = -0.1 m
    heavy = samples.weights[0] > 0.5
    assert bool(heavy.any())
    assert int(columns[heavy].max()) < 32  # positive x comes first in FFT order
    assert int(rows[heavy].min()) > 32  # negative y comes last


def test_grids_and_images_give_rows_first():
    grid = tm.Grid((6, 9), 1e-7, 550e-9)
    nu_y, nu_x = grid.frequencies()
    assert grid.shape == (6, 9)
    assert (tuple(nu_y.shape), tuple(nu_x.shape)) == ((6, 1), (1, 9))


def test_leading_axes_are_free_and_frames_come_before_sub_apertures_and_modes():
    mask = pair(0.5, 0.2)
    layer = tm.ZernikePhase(mask, GRID, n_modes=3)
    phase = layer(torch.zeros(4, 7, 2, 3, dtype=torch.float64))  # (batch, frame, sub-aperture, mode)
    assert tm.PSF(mask, GRID)(phase).shape == (4, 7, 64, 64)


POPULATION = torch.tensor(
    [[[0.25, 0.1], [-0.25, -0.1]], [[-0.25, -0.1], [0.25, 0.1]], [[0.0, 0.3], [0.1, -0.3]]], dtype=torch.float64
)
"""As many masks as there are frames below, so that axes in another order would have the same shape."""


@pytest.mark.parametrize("kind", [tm.PSF, tm.OTF])
def test_masks_of_a_population_come_before_their_frames(kind):
    coefficients = torch.randn(3, 3, 2, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def images(centers, coefficients):
        mask = tm.SparseAperture(centers, 0.2, 1.0)
        return kind(mask, GRID)(tm.ZernikePhase(mask, GRID, n_modes=4)(coefficients))

    together = images(POPULATION, coefficients)  # (mask, frame, H, W)
    alone = torch.stack([images(c, a) for c, a in zip(POPULATION, coefficients, strict=True)])
    torch.testing.assert_close(together, alone, rtol=0, atol=1e-14)
    # one frame each, without an axis for it
    torch.testing.assert_close(images(POPULATION, coefficients[:, 1]), alone[:, 1], rtol=0, atol=1e-14)


def test_pistons_of_a_population_have_their_frames_after_the_masks():
    mask = tm.SparseAperture(POPULATION, 0.2, 1.0)
    pistons = torch.randn(3, 3, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    together = analytic_otf(mask, GRID, pistons)
    alone = [analytic_otf(tm.SparseAperture(c, 0.2, 1.0), GRID, p) for c, p in zip(POPULATION, pistons, strict=True)]
    torch.testing.assert_close(together, torch.stack(alone), rtol=0, atol=1e-14)


@pytest.mark.parametrize("wind", [{}, {"wind": (3.0, 1.0), "frame_interval": 0.01}], ids=["independent", "frozen flow"])
def test_turbulence_over_a_population_is_the_same_screen_for_all_masks_frame_by_frame(wind):
    samples = tm.SparseAperture(POPULATION, 0.2, 1.0).samples(GRID)
    phase = tm.TurbulencePhase(0.1, 20.0, **wind)(samples, 3, torch.Generator().manual_seed(0))
    assert phase.shape == (3, 3, *samples.weights.shape[-2:])  # (mask, frame, hole, sample)
    assert torch.equal(phase[0, :, 0], phase[1, :, 1])  # the first two masks have their holes in another order
    assert torch.equal(phase[0, :, 1], phase[1, :, 0])
    assert float((phase[:, 0] - phase[:, 1]).std()) > 0.1  # frames differ


def test_wind_to_the_right_carries_the_phase_to_the_right():
    samples = tm.FullAperture(1.0).samples(GRID)
    wind = tm.TurbulencePhase(0.1, 20.0, wind=(4 * samples.step[1], 0.0), frame_interval=1.0)
    first, later = wind(samples, 2, torch.Generator().manual_seed(0))[:, 0]
    rows, columns = samples.index[0] // 64, samples.index[0] % 64
    place = {(int(r), (int(c) + 32) % 64): k for k, (r, c) in enumerate(zip(rows, columns, strict=True))}
    moved = [(k, place[r, c + 4]) for (r, c), k in place.items() if (r, c + 4) in place]
    source, target = (torch.tensor(part) for part in zip(*moved, strict=True))
    assert len(moved) > 500
    torch.testing.assert_close(later[target], first[source], rtol=0, atol=1e-5 * float(first.std()))


def test_a_star_moves_its_image_and_its_rays_the_same_way():
    """A star to the right: its image is at positive columns, and it shines through what lies to the right."""
    direction = 5 * GRID.pixel_scale
    samples = tm.FullAperture(1.0).samples(GRID)
    x = (samples.index[0] % 64 + 32) % 64 - 32
    height = 4 * samples.step[1] / direction  # there the star's rays are four samples to the right
    layers = tm.Layers([height], [1e-13])
    stars = torch.tensor([[0.0, 0.0], [direction, 0.0]], dtype=torch.float64)
    middle, right = tm.LayeredPhase(layers, 550e-9, 20.0)(samples, 1, torch.Generator().manual_seed(0), stars)[:, 0, 0]
    tilt = 2 * math.pi * direction / GRID.wavelength * x * samples.step[1]  # the star's own wavefront
    image = psf_from_samples(samples, tilt[None])
    assert divmod(int(image.argmax()), 64) == (0, 5)
    place = {int(i): k for k, i in enumerate(samples.index[0])}
    row = samples.index[0] // 64 == 0
    here, there = zip(*[(k, place[int(c) + 4]) for k, c in enumerate(x) if row[k] and 0 <= c < 12], strict=True)
    torch.testing.assert_close(right[list(here)], middle[list(there)], rtol=0, atol=1e-9)
    assert float((right - middle).abs().max()) > 0.1


def test_the_sky_seen_through_a_phase_is_not_turned():
    """A quarter turn of pupil and phase is a quarter turn of the image: nothing is mirrored on the way."""
    generator = torch.Generator().manual_seed(1)
    centers = torch.tensor([[0.31, 0.02], [-0.12, 0.27], [-0.2, -0.3]], dtype=torch.float64)
    pistons = torch.rand(3, 1, generator=generator, dtype=torch.float64) * 2 * math.pi
    turned = centers.flip(-1) * torch.tensor([-1.0, 1.0])  # (x, y) -> (-y, x)
    images = []
    for c in (centers, turned):
        samples = tm.SparseAperture(c, 0.2, 1.0).samples(GRID)
        images.append(psf_from_samples(samples, pistons.expand_as(samples.weights)))
    # In an array a turn from x to y takes (row, column) = (y, x) to (x, -y); the origin stays at [0, 0].
    expected = images[0].T.flip(1).roll(1, 1)
    torch.testing.assert_close(images[1], expected, rtol=0, atol=1e-12)
