"""Observables of a star divide those of an object: what drops out, and the errors that stay."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.disc_visibility import disc_visibilities
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

CENTERS = [[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]]
WAVELENGTH = 550e-9


def dimmed(frames, grid):
    """Frames whose fringes an instrument dims, the finer the more."""
    nu_y, nu_x = grid.frequencies(torch.float64)
    transfer = torch.exp(-((nu_x**2 + nu_y**2) / 0.5**2))
    return torch.fft.ifft2(torch.fft.fft2(frames) * transfer).real.clamp(min=0)


def measured(frames, mask, grid, seed=0):
    return frame_observables(Observation(torch.poisson(frames, torch.Generator().manual_seed(seed)), mask, grid, 0.0))


def test_a_calibrator_takes_the_instrument_out(expose_points, binary):
    mask = SparseAperture(CENTERS, 0.06, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)
    pair = binary(1.5 * grid.pixel_scale, -1.0 * grid.pixel_scale, 0.3)
    stars = ((0.0, 0.0, 1.0), (1.5, -1.0, 0.3))
    binary_frames = dimmed(expose_points(mask, grid, stars, electrons=3e4, n_frames=12), grid)
    star_frames = dimmed(expose_points(mask, grid, electrons=3e4, n_frames=12), grid)
    pulls, plain = [], []
    for seed in range(6):
        raw = measured(binary_frames, mask, grid, seed)
        star = measured(star_frames, mask, grid, 100 + seed)
        found = raw.calibrate(star)
        expected = torch.from_numpy(np.abs(pair.visibilities(found.baselines, WAVELENGTH)) ** 2)
        pulls.append((found.vis2 - expected) / found.vis2_errors)
        plain.append((raw.vis2 - expected) / raw.vis2_errors)
        torch.testing.assert_close(found.closure_covariance, raw.closure_covariance + star.closure_covariance)
        assert bool((found.vis2_errors / found.vis2 > raw.vis2_errors / raw.vis2).all())
    # errors of six baselines are correlated by no more than half; the larger of two estimates makes them too large
    bound = 3 * math.sqrt((1 + 5 * 0.5) / 6 / len(pulls))
    lost = pair.dimming(grid, 0.06)
    assert lost / float(found.vis2_errors.mean()) < 0.2
    assert abs(float(torch.stack(pulls).mean())) < bound + 0.2
    assert float(torch.stack(plain).mean()) < -5 * bound


def test_errors_of_a_calibrated_ratio_are_its_derivatives(expose_points):
    mask = SparseAperture(CENTERS, 0.06, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)
    frames = expose_points(mask, grid, electrons=3e4, n_frames=3)
    raw, star = (measured(frames, mask, grid, seed) for seed in (0, 1))
    for name, covariance in (("vis2", "vis2_covariance"), ("triple_amplitudes", "triple_covariance")):
        a, b = getattr(raw, name), getattr(star, name)
        by_a, by_b = torch.autograd.functional.jacobian(lambda x, y: x / y, (a, b))
        expected = by_a @ getattr(raw, covariance) @ by_a.T + by_b @ getattr(star, covariance) @ by_b.T
        torch.testing.assert_close(getattr(raw.calibrate(star), covariance), expected)


def test_a_star_of_another_mask_or_without_fringes_is_refused(expose_points):
    mask, grid = SparseAperture(CENTERS, 0.06, 1.0), Grid.nyquist(0.9, WAVELENGTH, 48, 1.1)
    raw = measured(expose_points(mask, grid, electrons=3e4), mask, grid)
    for wrong in (SparseAperture(CENTERS[:3], 0.06, 1.0), SparseAperture(CENTERS[::-1], 0.06, 1.0)):
        star = measured(expose_points(wrong, grid, electrons=3e4), wrong, grid)
        with pytest.raises(ValueError, match="the star was seen through another mask"):
            raw.calibrate(star)
    turned = mask.centers @ torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64)
    star = measured(
        expose_points(SparseAperture(turned, 0.06, 1.0), grid, electrons=3e4), SparseAperture(turned, 0.06, 1.0), grid
    )
    assert raw.calibrate(star).vis2.shape == (6,)
    dark = replace(star, vis2=star.vis2 * torch.tensor([1, 1, -1, 1, 1, 1]))
    with pytest.raises(ValueError, match=r"no fringes of holes 0-3"):
        raw.calibrate(dark)


def test_triple_amplitudes_and_visibilities_are_divided_by_those_of_a_known_disc_too(expose_points):
    mask, grid = SparseAperture(CENTERS, 0.06, 1.0), Grid.nyquist(0.9, WAVELENGTH, 48, 1.1)
    raw, star = (measured(expose_points(mask, grid, electrons=3e4, n_frames=3), mask, grid, seed) for seed in (0, 1))
    size, error = 2e-7, 1e-8
    point, known = raw.calibrate(star), raw.calibrate(star, size, error, WAVELENGTH)
    disc = disc_visibilities(raw.baselines / WAVELENGTH, size)
    number = {tuple(pair): index for index, pair in enumerate(raw.pairs.tolist())}
    sides = [[number[pair] for pair in ((i, j), (j, k), (i, k))] for i, j, k in raw.triangles.tolist()]
    torch.testing.assert_close(known.visibilities, point.visibilities * disc)
    torch.testing.assert_close(known.triple_amplitudes, point.triple_amplitudes * disc[torch.tensor(sides)].prod(1))
    step = 1e-4 * size
    above, below = (raw.calibrate(star, size + sign * step, 0.0, WAVELENGTH) for sign in (1, -1))
    by_size = (above.triple_amplitudes - below.triple_amplitudes) / (2 * step) * error
    surplus = known.triple_covariance - raw.calibrate(star, size, 0.0, WAVELENGTH).triple_covariance
    torch.testing.assert_close(surplus, by_size[:, None] * by_size, rtol=1e-5, atol=1e-12)
    with pytest.raises(ValueError, match="diameter needs the wavelength"):
        raw.calibrate(star, size)
