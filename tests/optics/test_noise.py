"""The noise that frames tell of themselves, against noise of known variance."""

import math

import pytest
import torch
from scipy.stats import gamma

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.observation import check_frames
from torchmask.optics.aperture import FullAperture
from torchmask.optics.detector import Detector
from torchmask.optics.noise import noise_variance
from torchmask.simulation.exposures import simulate_observation

GRID = Grid.nyquist(1.0, 550e-9, 32)
PUPIL = FullAperture(1.0)


@pytest.mark.parametrize("n_frames", [1, 20])
def test_noise_variance_is_measured_beyond_the_cutoff(n_frames):
    generator = torch.Generator().manual_seed(n_frames)
    nu_y, nu_x = GRID.frequencies(torch.float64)
    inside, ratios = torch.hypot(nu_y, nu_x) < 0.45, []
    for _ in range(40):
        noise = 3.0 * torch.randn(n_frames, *GRID.shape, dtype=torch.float64, generator=generator)
        scene = torch.rand(GRID.shape, dtype=torch.float64, generator=generator)
        scene = torch.fft.ifft2(torch.fft.fft2(scene) * inside).real
        ratios.append(noise_variance(1e3 * scene + noise, GRID, PUPIL) / 9)
    ratios = torch.tensor(ratios)
    # Standard error, and 2 % for the Wilson-Hilferty formula at few degrees of freedom and conjugate pairs.
    assert abs(float(ratios.mean()) - 1) < 4 * float(ratios.std()) / math.sqrt(40) + 0.02
    assert float(ratios.std()) < 2.5 / math.sqrt(n_frames * 100)


@pytest.mark.parametrize("n_frames", [1, 2, 3, 8])
def test_the_median_power_of_few_frames_is_below_its_mean_as_that_of_a_gamma_distribution(n_frames):
    """Whose shape is the number of frames; Wilson and Hilferty's formula is within 0.4 % of it for two and more."""
    noise = torch.randn(n_frames, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    beyond = torch.hypot(*GRID.frequencies(torch.float64)) > GRID.cutoff(PUPIL.extent)
    median = (torch.fft.fft2(noise).abs().square().mean(0) / math.prod(GRID.shape))[beyond].median()
    measured = noise_variance(noise, GRID, PUPIL)
    assert measured is not None
    assert float(median) / measured == pytest.approx(gamma(n_frames).median() / n_frames, rel=5e-3)


@pytest.mark.parametrize("holes", ["scattered", "a blob"])
def test_noise_variance_is_that_of_the_valid_pixels(holes):
    """What stands in dead and saturated pixels is no noise, and what is put there takes none away."""
    generator = torch.Generator().manual_seed(4)
    valid = torch.rand(GRID.shape, generator=generator) > 0.05
    if holes == "a blob":
        valid = torch.ones(GRID.shape, dtype=torch.bool)
        valid[12:18, 14:20] = False
    nu_y, nu_x = GRID.frequencies(torch.float64)
    inside, ratios, naive = torch.hypot(nu_y, nu_x) < 0.45, [], []
    for _ in range(40):
        scene = torch.rand(GRID.shape, dtype=torch.float64, generator=generator)
        scene = 1e3 * torch.fft.ifft2(torch.fft.fft2(scene) * inside).real
        frames = scene + 3.0 * torch.randn(4, *GRID.shape, dtype=torch.float64, generator=generator)
        filled, mask = check_frames(torch.where(valid, frames, math.inf), valid, GRID)
        ratios.append(noise_variance(filled, GRID, PUPIL, mask) / 9)
        naive.append(noise_variance(filled, GRID, PUPIL) / 9)
    ratios = torch.tensor(ratios)
    assert abs(float(ratios.mean()) - 1) < 4 * float(ratios.std()) / math.sqrt(40) + 0.05  # that of the white noise
    assert min(naive) > 2


@pytest.mark.parametrize("readout_noise", [1.5, 30.0])
def test_a_star_near_the_border_is_no_noise(golay6, seeded, readout_noise):
    """Its light is cut off there, which has power at all frequencies: here 30 to 60 times that of noise."""
    grid = Grid.nyquist(1.0, 550e-9, 64)
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[32, 61], scene[27, 22] = 7e6, 3e6
    detector = Detector(readout_noise)
    seen = simulate_observation(scene, golay6, grid, TurbulencePhase(0.2, 20.0), detector, 5, seeded(0))
    for valid in (
        torch.ones_like(seen.frames, dtype=torch.bool),
        torch.rand(seen.frames.shape, generator=seeded(1)) > 0.02,
    ):
        measured = noise_variance(seen.frames, grid, golay6, valid)
        assert measured == pytest.approx(float(seen.frames.mean()) + readout_noise**2, rel=0.2)


def test_noise_variance_needs_frequencies_beyond_the_cutoff():
    coarse = Grid.nyquist(1.0, 550e-9, (4, 4))
    assert noise_variance(torch.rand(3, 4, 4), coarse, PUPIL) is None
