"""Which way a phase moves an image. docs/conventions.md, "Signs"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.optics.otf import analytic_otf
from torchmask.simulation.exposures import simulate_observation

GRID = tm.Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)


def tilt(aperture, shift_x, shift_y, oversampling=1):
    """Phase 2 pi s x pixel_scale / wavelength on the samples of an aperture [rad]."""
    samples = aperture.samples(GRID, oversampling)
    positions = samples.offsets + aperture.centers[:, None]
    return 2 * math.pi / GRID.period * (shift_x * positions[..., 0] + shift_y * positions[..., 1])


@pytest.mark.parametrize(("shift_x", "shift_y"), [(5, 0), (0, 3), (-4, 2)])
def test_a_growing_phase_moves_the_image_towards_positive_pixels(shift_x, shift_y):
    psf = tm.PSF(tm.FullAperture(1.0), GRID)
    moved = psf(tilt(psf.aperture, shift_x, shift_y))
    # Light that folds over the border moves with it; what cell-averaging leaves is a smooth factor near 1.
    assert divmod(int(moved.argmax()), 64) == (shift_y % 64, shift_x % 64)
    assert divmod(int(psf().argmax()), 64) == (0, 0)


def test_zernike_2_moves_along_x_and_3_along_y():
    mask = tm.SparseAperture([[0.0, 0.0]], subaperture_diameter=1.0, mask_diameter=1.0)
    layer, psf = tm.ZernikePhase(mask, GRID, n_modes=3), tm.PSF(mask, GRID)
    # Noll 2 is 2 x / radius: a coefficient a is a slope of 4 a / diameter, which is a shift of 4 a / pi pixels here.
    pixels = 3
    coefficients = torch.zeros(2, 1, 3, dtype=torch.float64)
    coefficients[0, 0, 1] = coefficients[1, 0, 2] = pixels * math.pi / 4
    along_x, along_y = psf(layer(coefficients))
    assert divmod(int(along_x.argmax()), 64) == (0, pixels)
    assert divmod(int(along_y.argmax()), 64) == (pixels, 0)


def test_frames_move_the_same_way_as_psfs():
    """The simulation draws the image where the phase sends it."""

    class Tilt(tm.TurbulencePhase):
        def forward(self, samples, n_frames, generator=None):
            return tilt(tm.FullAperture(1.0), 6, -2, oversampling=4).expand(n_frames, -1, -1)

    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[30, 20] = 1e9
    observation = simulate_observation(scene, tm.FullAperture(1.0), GRID, Tilt(1.0, 1.0), tm.Detector(), 1)
    assert divmod(int(observation.frames[0].argmax()), 64) == (28, 26)


def test_otf_phase_of_a_shift():
    """Moved by +s pixels, an image is multiplied by exp(-2 pi i nu s): torch.fft's sign."""
    aperture = tm.FullAperture(1.0)
    otf = tm.OTF(aperture, GRID, oversampling=4)(tilt(aperture, 2, 0, oversampling=4))
    expected = 2 * math.pi * 2 * 3 / 64  # s = 2 pixels at 3 cycles across the field
    # 1 % for the cells of the pupil samples: their smooth factor on the image does not move with it
    assert float(-otf[0, 3].angle()) == pytest.approx(expected, rel=0.01)


def test_piston_of_one_hole_turns_the_fringes_of_its_baselines():
    """h(nu_m - nu_n) carries exp(i (phase_n - phase_m)): the fringe moves as under a phase that grows from n to m."""
    mask = tm.SparseAperture([[0.25, 0.0], [-0.25, 0.0]], 0.2, 1.0)
    samples = mask.samples(GRID)
    pistons = torch.tensor([0.7, 0.0], dtype=torch.float64)
    baseline = (0, 16)  # +0.5 m along x, of a period of 2 m in 64 columns
    exact = analytic_otf(mask, GRID, pistons)
    sampled = tm.OTF(mask, GRID)(pistons[:, None].expand_as(samples.weights))
    assert float(exact[baseline].angle()) == pytest.approx(-0.7, abs=1e-12)
    assert float(sampled[baseline].angle()) == pytest.approx(-0.7, rel=0.01)  # the cells of the samples, as above
