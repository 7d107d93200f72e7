"""Frames behind thin clouds: each has the photon noise of its own light."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.noise import uneven_light

GRID = Grid.nyquist(1.0, 550e-9, 32)
PUPIL = FullAperture(1.0)
READOUT = 3.0
CLOUDS = torch.tensor([1.0, 0.3, 0.08, 0.6], dtype=torch.float64)[:, None, None]


def expected_light(sky=0.0):
    """A smooth spot, (32, 32) [electrons], which the pupil lets pass; clouds do not change the sky."""
    away = torch.arange(32, dtype=torch.float64) - 16
    profile = (-(away**2) / 32).exp()
    return CLOUDS * 600 * profile[:, None] * profile + sky


def draw(expected, seed=0):
    generator = torch.Generator().manual_seed(seed)
    noise = READOUT * torch.randn(expected.shape, dtype=torch.float64, generator=generator)
    return torch.poisson(expected, generator=generator) + noise


@pytest.mark.parametrize("told", ["readout noise", "errors"])
@pytest.mark.parametrize("sky", [0.0, 20.0])
def test_each_frame_has_the_mean_noise_of_its_own_pixels(told, sky):
    """Within four standard errors of a frame's mean light, which is all that is measured."""
    expected = expected_light(sky)
    frames, valid = draw(expected), torch.ones(GRID.shape, dtype=torch.bool)
    valid[2, 3:30:5] = False
    frames[:, ~valid] = math.nan
    how = {"readout_noise": READOUT}
    if told == "errors":
        how = {"readout_noise": None, "errors": (frames.clamp(min=0) + READOUT**2).sqrt()}
    stack = FrameStack.of(frames, valid, GRID, PUPIL, background=sky, **how)
    truth = expected[:, valid].mean(1) + READOUT**2
    found = stack.unit**2 / stack.precision.expand_as(frames)[:, valid].mean(1)
    assert bool(((found - truth).abs() < 4 * (truth / int(valid.sum())).sqrt()).all())
    assert bool((stack.precision.expand_as(frames)[:, ~valid] == 0).all())


def test_a_frame_is_as_noisy_as_its_weight_says():
    """So that its verdict asks for a chi-square of 1; the object's photons are what its light makes of its variance."""
    frames = draw(expected_light(20.0))
    stack = FrameStack.of(frames, None, GRID, PUPIL, READOUT, 20.0)
    torch.testing.assert_close(stack.noise_of_frames.level, torch.ones(4).double(), rtol=1e-12, atol=0)
    light = frames.mean((1, 2))
    torch.testing.assert_close(stack.photon_share.flatten(), (light - 20) / (light + READOUT**2), rtol=1e-12, atol=0)
    assert stack.to(torch.float32, torch.device("cpu")).precision.dtype == torch.float32


@pytest.mark.parametrize(("faintest", "alike"), [(76.1, True), (75.9, False)])
def test_frames_of_about_the_same_light_have_one_variance(faintest, alike):
    """Up to a quarter more in one than in another: 104 + 16 electrons of read-out noise against 96."""
    frames = torch.tensor([104.0, faintest + 4]).double()[:, None, None].expand(2, 4, 4)
    excess = uneven_light(frames, torch.ones_like(frames, dtype=torch.bool), float(frames.mean()) + 16, 1.0)
    assert (excess is None) is alike
    if excess is not None:
        torch.testing.assert_close(excess, frames[:, 0, 0] - frames.mean())


def test_a_frame_without_light_does_not_rule_the_others():
    """It has a hundredth of the mean variance, where photons alone make noise."""
    frames = torch.tensor([10.0, 0.0, 5.0]).double()[:, None, None].expand(3, 4, 4)
    excess = uneven_light(frames, torch.ones_like(frames, dtype=torch.bool), 5.0, 1.0)
    torch.testing.assert_close(excess, torch.tensor([5.0, -4.95, 0.0]).double())


@pytest.mark.parametrize("seen", [slice(0, 2), slice(2, 4)])
def test_light_is_that_of_valid_pixels(seen):
    frames = torch.tensor([[1.0, 3.0, 7.0, 9.0], [10.0, 30.0, 70.0, 90.0]]).double()[:, None]
    valid = torch.zeros_like(frames, dtype=torch.bool)
    valid[..., seen] = True
    light = frames[..., seen]
    excess = uneven_light(frames, valid, float(light.mean()), 1.0)
    torch.testing.assert_close(excess, light.mean((1, 2)) - light.mean())
    valid[0, 0, seen.start] = False  # in one frame only, so that the other weighs more in the mean of all
    excess = uneven_light(frames, valid, float(frames[valid].mean()), 1.0)
    torch.testing.assert_close(
        excess, torch.stack([frames[0, valid[0]].mean(), light[1].mean()]) - frames[valid].mean()
    )


def test_noise_of_the_detector_alone_is_the_same_behind_clouds():
    frames = expected_light()
    assert uneven_light(frames, torch.ones_like(frames, dtype=torch.bool), 9.0, 0.0) is None


def test_a_restoration_fits_all_frames_to_their_own_noise(golay6, seeded):
    """One variance for all leaves 0.05 to 2.2 times the noise.

    Bounds: four standard errors, and what an object of as many unknowns as the mask passes frequencies takes from a
    frame, by its share in what is known of them.
    """
    grid, generator = Grid.nyquist(1.0, 550e-9, 32), seeded(0)
    model = ExposureModel(golay6, grid, 3)
    z = 0.5 * torch.randn(6, model.aberrations.n_parameters, dtype=torch.float64, generator=generator)
    scene = torch.zeros(model.window.field.shape, dtype=torch.float64)
    scene[12:20, 10:23] = torch.rand(8, 13, dtype=torch.float64, generator=generator)
    clouds = torch.tensor([1.0, 1.0, 0.5, 0.1, 0.05, 0.02], dtype=torch.float64)[:, None, None]
    expected = clouds * model(scene * 5e5 / scene.sum(), z)
    noise = 1.5 * torch.randn(expected.shape, dtype=torch.float64, generator=generator)
    frames = torch.poisson(expected, generator=generator) + noise
    method = MyopicDeconvolution(golay6, grid, 3, readout_noise=1.5, dtype=torch.float64)
    found = method.restore(frames, coefficients=model.aberrations.coefficients(z)).chi_square
    slack = 4 * math.sqrt(2 / 1024)
    known = clouds.flatten() ** 2 / (expected.mean((1, 2)) + 1.5**2)
    transfer = torch.fft.fft2(model.psf(0 * z[:1])).abs()
    taken = (transfer > 1e-6 * transfer.max()).double().mean() * known / known.sum()
    assert bool((found < 1 + slack).all())
    assert bool((found > 1 - slack - taken).all())
