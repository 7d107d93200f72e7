"""The noise that frames tell of themselves, against noise of known variance."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.optics.fading import beyond_faded
from torchmask.optics.noise import noise_variance
from torchmask.restoration.noise import (
    FrameNoise,
    check_errors,
    even_photons,
    expected_variance,
    least_by_chance,
    photon_slope,
)

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


def exposed(n_frames=8, level=200.0, seed=0):
    """Photons of a scene that varies over the field, and read-out noise of 3 electrons."""
    generator = torch.Generator().manual_seed(seed)
    lit = torch.poisson(blurred(n_frames, generator, level), generator=generator)
    return lit + 3 * torch.randn(lit.shape, dtype=torch.float64, generator=generator)


@pytest.mark.parametrize("readout", [None, 3.0])
@pytest.mark.parametrize(
    "spoil",
    [
        lambda frames: (frames / 8).round(),
        lambda frames: frames / 2,
        lambda frames: frames + 100,
        lambda frames: frames / frames.mean(),
        lambda frames: (frames + frames.roll(1, -1)) / 2,
        lambda frames: (frames[:4] + frames[4:]) / 2,
    ],
    ids=["ADU", "few electrons per ADU", "bias", "normalised", "smoothed", "means"],
)
def test_noise_below_that_of_photons_is_noticed(spoil, readout):
    """Their noise is less than electrons can have."""
    with pytest.warns(UserWarning, match=r"photons alone give .*in ADU .*the gain.* bias .*give errors"):
        expected_variance(spoil(exposed()), GRID, PUPIL, readout)


@pytest.mark.parametrize("readout", [None, 3.0])
@pytest.mark.parametrize("n_frames", [1, 8])
def test_electrons_have_no_less_noise_than_photons_by_chance(n_frames, readout):
    """Nor what is left of them beside a sky, nor where pixels are missing, nor twice the noise of an EMCCD."""
    valid = torch.rand(n_frames, *GRID.shape, generator=torch.Generator().manual_seed(0)) > 0.1
    for seed, level in enumerate([1e-2, 1.0, 30.0, 1e4] * 3):
        frames = exposed(n_frames, level, seed)
        expected_variance(frames, GRID, PUPIL, readout)
        expected_variance(frames, GRID, PUPIL, readout, valid)
        for sky in (0.9, 1.0, 1.5):
            expected_variance(frames - sky * frames.mean(), GRID, PUPIL, None)
        noise = torch.randn(frames.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        expected_variance(frames + frames.clamp(min=0).sqrt() * noise, GRID, PUPIL, None)


def test_means_of_several_reads_are_fine_with_their_errors():
    """The photon noise of a mean of two is half of its light."""
    frames = exposed()
    means = (frames[:4] + frames[4:]) / 2
    expected_variance(means, GRID, PUPIL, None, None, ((means.clamp(min=0) + 9) / 2).sqrt())


def test_a_readout_noise_that_is_clearly_too_large_is_noticed():
    """By less than the factor of 2 in the variance to which noise beyond the expected one goes unsaid."""
    frames = exposed()
    with pytest.warns(UserWarning, match=r"photon noise and readout_noise give 13.*check the gain and readout_noise"):
        expected_variance(frames, GRID, PUPIL, 8.8)


@pytest.mark.parametrize(("kind", "share"), [("none", 0.0), ("scattered", 0.1), ("scattered", 0.3), ("round", 0.2)])
def test_the_least_noise_by_chance_is_some_standard_errors_away(kind, share):
    """Of even light, and of a star, in whose frames fewer powers are independent."""
    n_powers = 2 * int(beyond_faded(GRID, PUPIL, torch.ones(1, *GRID.shape)).sum())
    y, x = torch.meshgrid(*(2 * [torch.arange(32.0) - 15.5]), indexing="ij")
    for star in (False, True):
        light = 200 * torch.exp(-(x**2 + y**2) / 30).double() if star else torch.full(GRID.shape, 50.0).double()
        ratios, bounds = [], []
        for seed in range(16):
            generator = torch.Generator().manual_seed(seed)
            frames = torch.poisson(light.expand(2, -1, -1), generator=generator)
            valid = torch.rand(2, *GRID.shape, generator=generator) >= share
            if kind == "round":
                valid = (torch.hypot(x, y) < 16).expand(2, -1, -1)
            seen, missing = frames[valid], int((~valid).sum())
            ratios.append(noise_variance(frames, GRID, PUPIL, valid) / float(seen.mean()))
            bounds.append(math.log(least_by_chance(seen, float(seen.mean()), n_powers, missing)))
        scatter = float(torch.tensor(ratios).log().square().mean().sqrt())
        assert scatter < -sum(bounds) / len(bounds) / 3, (star, scatter)  # of four standard errors, one for the 16


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
@pytest.mark.parametrize("even", [True, False])
def test_noise_of_frames_follows_their_light(gain, readout, even):
    """Half of the pixels have 3 times the light of the others, and frames 0.5 to 2 times that of the mean.

    The variance of a pixel is its light and that of the read-out noise, which is assumed with the mean light. Without
    read-out noise the unit does not matter. If `even` is False, some rows have more read-out noise, and another
    row is not valid. Over n = 10000 pixels a mean is known to the pixels' scatter over sqrt(n), their variance to
    sqrt(2 / n) of itself.
    """
    transmission = torch.tensor([0.5, 0.7, 1.0, 1.8], dtype=torch.float64)
    pattern = torch.cat([torch.full((50, 100), 20.0), torch.full((50, 100), 60.0)]).double()
    light = transmission[:, None, None] * pattern
    generator = torch.Generator().manual_seed(0)
    frames = torch.poisson(light, generator=generator)
    frames = frames + readout * torch.randn(light.shape, generator=generator, dtype=torch.float64)
    readouts, valid = torch.full_like(light, readout**2), torch.ones_like(light, dtype=torch.bool)
    if not even:
        readouts[:, 60:70], valid[:, 3] = 400.0, False
        frames[:, 60:70] = light[:, 60:70] + 20 * torch.randn(4, 10, 100, generator=generator, dtype=torch.float64)
    assumed = light.mean() + readouts
    frames, found_in = gain * frames, gain**2 * assumed
    found = FrameNoise.of(frames, valid, torch.where(valid, 1 / found_in, 0.0), gain)
    variance = (light + readouts) / assumed
    means = torch.stack([variance[t][valid[t]].mean() for t in range(4)])
    scatter = torch.stack([((light.var((1, 2)).mean() + variance * assumed) / assumed**2)[t].mean() for t in range(4)])
    of_mean = scatter.sqrt() / 100 / means
    torch.testing.assert_close(found.level, means, rtol=5 * float(of_mean.max()), atol=0)
    expected = torch.stack([(variance[t][valid[t]] ** 2).mean() for t in range(4)]) / means**2
    error = math.sqrt(2 / 10000) * scatter / means**2 + 2 * of_mean * (expected - 1)
    assert bool(((found.unevenness - expected).abs() < 4 * error).all())


def photons_on_a_map(slope, dtype=torch.float64, n_frames=6):
    """Frames of changing light, and the variances that a pipeline writes: `slope` times the counts and a map."""
    generator = torch.Generator().manual_seed(1)
    light = 60 * torch.rand(n_frames, 40, 40, generator=generator, dtype=torch.float64)
    detector = 2 + 100 * torch.rand(40, 40, generator=generator, dtype=torch.float64) ** 8
    frames = torch.poisson(light, generator=generator)
    frames += detector.sqrt() * torch.randn(frames.shape, generator=generator, dtype=torch.float64)
    return frames.to(dtype), (slope * frames.clamp(min=0) + detector).to(dtype), detector.to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("slope", [0.0, 0.25, 1.0, 2.0])
def test_photons_in_errors_are_found_and_evened_out(slope, dtype):
    frames, variance, detector = photons_on_a_map(slope, dtype)
    errors, valid = variance.sqrt(), torch.ones_like(frames, dtype=torch.bool)
    rounding = 20 * torch.finfo(dtype).eps
    found = photon_slope(frames, errors, valid)
    # a difference of two variances of at most 200, over one of counts, most of which are above 1
    assert found == pytest.approx(slope, abs=200 * rounding)
    even = even_photons(frames, errors, valid, found)
    expected = (slope * frames.mean() + detector).sqrt().expand_as(frames)
    torch.testing.assert_close(even, expected, rtol=200 * rounding, atol=0)


@pytest.mark.parametrize("slope", [0.0, 0.25, 1.0])
def test_slope_of_photons_is_right_within_its_statistical_error(slope):
    """Variances that scatter by sigma: least absolute deviations are normal, of variance 1 / (4 f(0)^2 sum of run^2).

    A difference of two such variances has the density f(0) = 1 / (2 sigma sqrt(pi)) at 0 (Bassett & Koenker 1978).
    """
    frames, variance, _ = photons_on_a_map(slope)
    sigma = 1.5
    noise = sigma * torch.randn(frames.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    run = (frames[0::2] - frames[1::2])[(frames[0::2] > 0) & (frames[1::2] > 0)]
    deviation = sigma * math.sqrt(math.pi) / float(run.norm())
    found = photon_slope(frames, (variance + noise).clamp(min=0).sqrt(), torch.ones_like(frames, dtype=torch.bool))
    assert abs(found - slope) < 4 * deviation
    assert 4 * deviation < 0.02  # which tells 0 from 0.25


def test_cosmic_rays_and_dead_pixels_do_not_change_the_slope_and_keep_their_errors():
    frames, variance, _ = photons_on_a_map(1.0)
    errors, valid = variance.sqrt(), torch.ones_like(frames, dtype=torch.bool)
    errors[:, 3], errors[2, 10:14, 5:30] = 1e6, 1e5  # a dead row, and a hit of one frame
    errors[:, 7], valid[:, 7] = math.nan, False
    slope = photon_slope(frames, errors, valid)
    assert slope == pytest.approx(1.0, abs=1e-9)
    even = even_photons(frames, errors, valid, slope)
    torch.testing.assert_close(even[:, 3], errors[:, 3], rtol=1e-9, atol=0)
    torch.testing.assert_close(even[2, 10:14, 5:30], errors[2, 10:14, 5:30], rtol=1e-7, atol=0)
    assert float(even[3, 10:14, 5:30].max()) < 15


def test_errors_that_are_the_same_in_all_frames_hold_no_photons():
    frames, variance, detector = photons_on_a_map(1.0)
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert photon_slope(frames, detector.sqrt().expand_as(frames), valid) == 0
    assert photon_slope(frames[:1], variance[:1].sqrt(), valid[:1]) == 0  # one frame does not tell
    assert photon_slope(-frames.abs(), variance.sqrt(), valid) == 0


def test_errors_that_fall_where_counts_rise_hold_no_photons():
    frames, variance, _ = photons_on_a_map(1.0)
    falling = variance.max() + 1 - variance
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert photon_slope(frames, falling.sqrt(), valid) == 0


def test_errors_are_taken_as_given_where_frames_show_more_noise():
    """Not those of photon and read-out noise, which leave out a sky that was subtracted, or a dark current."""
    frames = 49 + 7 * torch.randn(8, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    errors, valid = torch.full_like(frames, 5.5), torch.ones_like(frames, dtype=torch.bool)
    assert expected_variance(frames, GRID, PUPIL, None, valid, errors) == pytest.approx(5.5**2, rel=1e-12)
    dark = frames - 20.0  # of photons 29, while 49 are measured within a tenth
    assert expected_variance(dark, GRID, PUPIL, 0.0, valid) == pytest.approx(49, rel=0.1)
    assert expected_variance(dark, GRID, PUPIL, 0.0, valid) == expected_variance(dark, GRID, PUPIL, None, valid)


def test_noise_is_no_evener_than_even():
    """Even light leaves a mean square of 1, from which taking the noise off alone would leave less by chance."""
    frames = torch.full((1, 4, 4), 50.0, dtype=torch.float64)
    valid, precision = torch.ones(1, 4, 4, dtype=torch.bool), torch.full((1, 1, 1), 1 / 50, dtype=torch.float64)
    found = FrameNoise.of(frames, valid, precision, 1.0)
    assert float(found.level) == 1
    assert float(found.unevenness) == 1


def test_errors_below_their_photon_noise_have_that_of_a_mean_pixel_alone():
    """As where counts are noisier than the light that the errors were made from: nothing is left of the detector."""
    frames = torch.tensor([[[100.0, 20.0, 30.0, -10.0]]], dtype=torch.float64)
    errors = torch.tensor([[[60.0, 20.0, 34.0, 9.0]]], dtype=torch.float64).sqrt()
    found = even_photons(frames, errors, torch.ones_like(frames, dtype=torch.bool), 1.0).square()
    torch.testing.assert_close(found, 35.0 + torch.tensor([[[0.0, 0.0, 4.0, 9.0]]]).double(), rtol=1e-12, atol=1e-12)


def test_the_noise_is_that_of_valid_pixels_whatever_stands_in_the_others():
    """A frame whose dark half is left out: the mean of all pixels would count half of the photons only."""
    generator = torch.Generator().manual_seed(2)
    light = torch.cat([torch.zeros(4, 16, 32), torch.full((4, 16, 32), 80.0)], 1).double()
    frames, valid = torch.poisson(light, generator=generator), light > 0
    errors = torch.full_like(frames, 9.0)
    assert expected_variance(frames, GRID, PUPIL, 3.0, valid) == pytest.approx(float(frames[valid].mean()) + 9)
    even = even_photons(frames, errors, valid, 1.0)[valid].square()
    torch.testing.assert_close(even, frames[valid].mean() + (81 - frames[valid]).clamp(min=0))
    precision = valid / (frames[valid].mean() + 9)
    level = FrameNoise.of(frames, valid, precision, 1.0).level
    expected = (frames.sum((1, 2)) / valid.sum((1, 2)) + 9) / (frames[valid].mean() + 9)
    torch.testing.assert_close(level, expected, rtol=1e-12, atol=0)
