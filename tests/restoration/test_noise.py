"""The noise that frames tell of themselves, against noise of known variance."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.restoration.noise import FrameNoise, check_errors, expected_variance

GRID = Grid.nyquist(1.0, 550e-9, 32)
PUPIL = FullAperture(1.0)


def blurred(n_frames, generator, level=100.0):
    """Band-limited frames: smooth within the cut-off of the pupil."""
    nu_y, nu_x = GRID.frequencies(torch.float64)
    inside = torch.hypot(nu_y, nu_x) < 0.4
    noise = torch.rand(n_frames, *GRID.shape, dtype=torch.float64, generator=generator)
    return level * torch.fft.ifft2(torch.fft.fft2(noise) * inside).real.clamp(min=0)


def test_noise_that_cannot_be_measured_must_be_told():
    coarse = Grid.nyquist(1.0, 550e-9, (4, 4))
    with pytest.raises(ValueError, match="give readout_noise"):
        expected_variance(torch.rand(3, 4, 4), coarse, PUPIL, None)


def test_wrong_noise_level_is_noticed():
    generator = torch.Generator().manual_seed(0)
    frames = torch.poisson(blurred(8, generator), generator=generator)
    right = expected_variance(frames, GRID, PUPIL, 0.0)
    assert right == pytest.approx(float(frames.mean()))
    assert expected_variance(frames, GRID, PUPIL, None) == pytest.approx(right, rel=0.1)
    with pytest.warns(UserWarning, match="check the gain"):
        expected_variance(frames, GRID, PUPIL, 100.0)
    with pytest.warns(UserWarning, match="check the gain"):
        expected_variance(frames * 10, GRID, PUPIL, 0.0)  # not in electrons


def test_errors_that_were_measured_tell_the_variance_of_valid_pixels():
    frames = torch.poisson(torch.full((8, *GRID.shape), 49.0, dtype=torch.float64))
    errors, valid = torch.full_like(frames, 7.0), torch.ones_like(frames, dtype=torch.bool)
    errors[:, 0, :4], errors[:, 1, :4] = 8.0, 1e6
    valid[:, 1, :4] = False
    size = math.prod(GRID.shape)
    mean = (49 * (size - 8) + 64 * 4) / (size - 4)
    assert expected_variance(frames, GRID, PUPIL, None, valid, errors) == pytest.approx(mean, rel=1e-12)
    with pytest.warns(UserWarning, match="errors give 14"):
        expected_variance(frames, GRID, PUPIL, None, None, torch.full_like(frames, 14.0))


def test_errors_are_those_of_every_frame_or_of_each():
    frames, valid = torch.ones(3, *GRID.shape).double(), torch.ones(3, *GRID.shape).bool()
    each = torch.rand(*GRID.shape) + 1
    assert torch.equal(check_errors(each, frames, valid), each.double().expand_as(frames))
    assert torch.equal(check_errors(each.numpy(), frames, valid), each.double().expand_as(frames))
    errors, holes = torch.ones_like(frames), valid.clone()
    errors[1, 2, 3], errors[2, 0, 0] = 0.0, math.nan
    with pytest.raises(ValueError, match=r"not positive at 2 valid pixels, the first is 0 at .* \(1, 2, 3\)"):
        check_errors(errors, frames, valid)
    holes[1, 2, 3] = holes[2, 0, 0] = False
    assert float(check_errors(errors, frames, holes)[holes].min()) == 1
    with pytest.raises(ValueError, match="errors has shape"):
        check_errors(errors[:2], frames, valid)


@pytest.mark.parametrize(("gain", "readout"), [(1.0, 0.0), (1.0, 6.0), (0.25, 0.0)])
def test_noise_of_frames_follows_their_light(gain, readout):
    """Half of the pixels have 3 times the light of the others, and frames 0.5 to 2 times that of the mean.

    The variance of a pixel is its light and that of the read-out noise; without the latter the unit does not matter.
    Over n = 10000 pixels a mean is known to the pixels' scatter over sqrt(n), their variance to sqrt(2 / n) of itself.
    """
    transmission = torch.tensor([0.5, 0.7, 1.0, 1.8], dtype=torch.float64)
    pattern = torch.cat([torch.full((50, 100), 20.0), torch.full((50, 100), 60.0)]).double()
    light = transmission[:, None, None] * pattern
    generator = torch.Generator().manual_seed(0)
    frames = torch.poisson(light, generator=generator)
    frames = frames + readout * torch.randn(light.shape, generator=generator, dtype=torch.float64)
    variance = light + readout**2
    found = FrameNoise.of(gain * frames, gain**2 * float(variance.mean()))
    means, scatter = variance.mean((1, 2)), 20.0**2 * transmission**2 + variance.mean((1, 2))
    of_mean = scatter.sqrt() / 100 / means
    torch.testing.assert_close(found.level, means / means.mean(), rtol=4 * float(of_mean.max()), atol=0)
    expected = variance.square().mean((1, 2)) / means**2
    error = math.sqrt(2 / 10000) * scatter / means**2 + 2 * of_mean * (expected - 1)
    assert bool(((found.unevenness - expected).abs() < 4 * error).all())
