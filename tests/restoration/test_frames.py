"""A stack of frames: its unit, its weights, what changes from frame to frame, and what it warns of."""

import math
import warnings
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.restoration.background import Background
from torchmask.restoration.frames import FrameStack, border_brightness
from torchmask.restoration.myopic import MyopicDeconvolution

GRID = Grid.nyquist(1.0, 550e-9, 32)
PUPIL = FullAperture(1.0)
READOUT = 3.0


def exposures(n_frames=4, level=50.0, seed=0, sky=0.0):
    """A block on dark ground, or on a sky, with photon and read-out noise."""
    generator = torch.Generator().manual_seed(seed)
    expected = torch.full((n_frames, *GRID.shape), sky, dtype=torch.float64)
    expected[:, 10:20, 12:22] += level
    noise = READOUT * torch.randn(expected.shape, dtype=torch.float64, generator=generator)
    return torch.poisson(expected, generator=generator) + noise


def test_a_stack_is_in_units_of_its_mean_pixel():
    frames = exposures()
    stack = FrameStack.of(frames, None, GRID, PUPIL, READOUT)
    assert len(stack) == 4
    assert stack.unit == pytest.approx(float(frames.mean()), rel=1e-12)
    assert float(stack.frames.mean()) == pytest.approx(1, rel=1e-12)
    torch.testing.assert_close(stack.frames * stack.unit, frames)
    assert stack.variance == pytest.approx(float(frames.mean()) + READOUT**2, rel=1e-12)
    assert stack.photon_share.item() == pytest.approx(stack.unit / (stack.unit + READOUT**2), rel=1e-12)


def test_precision_is_the_inverse_variance_of_valid_pixels():
    frames, valid = exposures(), torch.ones(GRID.shape, dtype=torch.bool)
    whole = FrameStack.of(frames, valid, GRID, PUPIL, READOUT)
    expected = whole.unit**2 / whole.variance
    assert whole.precision.shape == (1, 1, 1)  # one number for all spares a stack's memory
    assert whole.precision.item() == pytest.approx(expected, rel=1e-12)
    valid[3, 4] = False
    partly = FrameStack.of(torch.where(valid, frames, math.nan), valid, GRID, PUPIL, READOUT)
    assert partly.precision.shape == frames.shape
    assert bool((partly.precision[:, 3, 4] == 0).all())
    assert float(partly.precision[:, valid].min()) == pytest.approx(partly.unit**2 / partly.variance, rel=1e-12)
    assert bool(torch.isfinite(partly.frames).all())


def test_change_is_the_chi_square_against_the_mean_frame():
    """Noise alone leaves 1 - 1/T of its variance; another brightness is no change."""
    stack = FrameStack.of(exposures(n_frames=8), None, GRID, PUPIL, READOUT)
    degrees = stack.frames.numel() * (1 - 1 / 8)
    assert stack.change.n_frames == len(stack)
    assert stack.change.n_pixels == pytest.approx(float(stack.valid.sum()) / len(stack))
    assert stack.change.each == pytest.approx(1 - 1 / 8, abs=4 * math.sqrt(2 / degrees))
    frames = exposures()[:1] * torch.tensor([0.5, 1.0, 1.5]).double()[:, None, None]
    scaled = FrameStack.of(frames, None, GRID, PUPIL, None)
    assert scaled.change.each < 1e-20


def test_change_counts_valid_pixels_only():
    """What half of the pixels show of noise, they show whatever the others are."""
    valid = torch.rand(GRID.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    stack = FrameStack.of(exposures(n_frames=8), valid, GRID, PUPIL, READOUT)
    light = stack.frames[:, valid]
    moved = light - stack.frames.mean((1, 2))[:, None] * light.mean(0)
    assert stack.change.each == pytest.approx(float(moved.square().mean()) * stack.unit**2 / stack.variance, rel=1e-12)


def test_a_stack_moves_to_another_precision():
    stack = FrameStack.of(exposures(), None, GRID, PUPIL, READOUT)
    single = stack.to(torch.float32, torch.device("cpu"))
    assert single.frames.dtype == single.precision.dtype == torch.float32
    assert (single.unit, single.variance) == (stack.unit, stack.variance)


def test_border_brightness():
    frames = torch.zeros(2, 4, 6)
    frames[:, 1:3, 1:5] = torch.tensor([2.0, -8.0])[:, None, None]
    valid = torch.ones_like(frames, dtype=torch.bool)
    assert border_brightness(frames + 10, valid) == pytest.approx(10 / (10 - 3 / 3), rel=1e-6)


def test_pixels_that_are_not_valid_make_no_border_bright():
    frames, valid = torch.ones(2, 6, 6), torch.ones(2, 6, 6, dtype=torch.bool)
    frames[:, 0] = 50.0
    valid[:, 0] = False
    assert border_brightness(frames, valid) == 1
    valid[:, :, [0, -1]] = valid[:, -1] = False
    assert border_brightness(frames, valid) == 0  # none is known


def test_photons_are_counted_over_valid_pixels():
    """Where the dark half of the field is left out, a mean pixel has twice the light."""
    frames, valid = exposures(), torch.ones(GRID.shape, dtype=torch.bool)
    valid[:, :10] = False
    stack = FrameStack.of(frames, valid, GRID, PUPIL, READOUT)
    assert stack.variance == pytest.approx(float(frames[:, valid].mean()) + READOUT**2, rel=1e-12)
    assert float(stack.noise_of_frames.level.mean()) == pytest.approx(1, rel=1e-12)


def test_frames_that_are_read_twice_are_told():
    frames = exposures()
    with pytest.warns(UserWarning, match=r"frames \[4, 6\] .* repeat earlier ones pixel by pixel"):
        FrameStack.of(torch.cat([frames, frames[1:2], exposures(1, seed=9), frames[:1]]), None, GRID, PUPIL, READOUT)
    moved = torch.cat([frames, frames[1:2].roll(1, -1)])  # with as much light
    FrameStack.of(moved, None, GRID, PUPIL, READOUT)  # warnings are errors


def test_a_cosmic_ray_gets_no_weight_and_is_told():
    """Its frame is as without it elsewhere, and so is the noise that is measured."""
    frames = exposures()
    hit = frames.clone()
    hit[2, 14, 25] += 1e4
    with pytest.warns(UserWarning, match=r"9 pixels of frames \[2\].*9.99e\+03 electrons at .* \(2, 14, 25\)"):
        stack = FrameStack.of(hit, None, GRID, PUPIL, None)
    left_out = (~stack.valid).nonzero()
    assert {tuple(place) for place in left_out.tolist()} == {(2, y, x) for y in (13, 14, 15) for x in (24, 25, 26)}
    assert bool((stack.precision[~stack.valid] == 0).all())
    torch.testing.assert_close((stack.frames * stack.unit)[stack.valid], frames[stack.valid], rtol=1e-9, atol=1e-9)
    # four standard errors of a median of some 110 frequencies of 4 frames; the hit has 24000 electrons^2 there
    assert stack.variance == pytest.approx(FrameStack.of(frames, None, GRID, PUPIL, None).variance, rel=0.25)


def test_pixels_at_which_a_camera_cuts_off_get_no_weight_and_are_told():
    """As if they had been marked."""
    frames = exposures()
    level = float(frames.quantile(0.98))
    with pytest.warns(UserWarning, match=rf"hold {level:.10g}, the largest.*seems to cut off there"):
        stack = FrameStack.of(frames.clamp(max=level), None, GRID, PUPIL, None)
    marked = FrameStack.of(frames, frames < level, GRID, PUPIL, None)
    assert torch.equal(stack.valid, frames < level)
    assert torch.equal(stack.frames, marked.frames)
    assert stack.variance == marked.variance


def test_a_bright_border_is_noticed():
    """And what its light is taken for."""
    for assumed, taken in ((Background.NONE, "an object that extends beyond"), (Background.PER_FRAME, "for a sky")):
        with pytest.warns(UserWarning, match=taken):
            stack = FrameStack.of(exposures(sky=100.0), None, GRID, PUPIL, None, assumed)
        assert not stack.fills_field
    wide = exposures(sky=40.0)
    wide[:, 1:9, 1:9] -= 30.0
    with pytest.warns(UserWarning, match="an object that extends beyond .* holes spread light to the border"):
        stack = FrameStack.of(wide, None, GRID, PUPIL, None, Background.IF_SEEN)
    assert stack.fills_field
    assert stack.free is Background.NONE


def test_warnings_name_the_line_that_restores():
    """And so each caller is told, not only the first."""
    method = MyopicDeconvolution(PUPIL, GRID, 3, readout_noise=1e5, max_iterations=1)
    for call in (method.restore, method.objective):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            call(exposures() + 100.0)
        ours = {str(one.message)[:24]: one.filename for one in told if one.category is UserWarning}
        assert ours == dict.fromkeys(("the noise of the frames ", "much of the light is eve"), __file__)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_errors_with_photon_noise_weigh_pixels_as_if_they_had_not_been_given(dtype):
    frames = exposures()
    told = FrameStack.of(frames, None, GRID, PUPIL, READOUT)
    errors = (frames.clamp(min=0) + READOUT**2).sqrt().to(dtype)
    stack = FrameStack.of(frames, None, GRID, PUPIL, None, errors=errors)
    close = {"rtol": 100 * torch.finfo(dtype).eps, "atol": 0}
    torch.testing.assert_close(stack.precision, told.precision.expand_as(frames), **close)
    torch.testing.assert_close(stack.photon_share, told.photon_share.expand_as(frames), **close)
    for found, expected in zip(stack.noise_of_frames, told.noise_of_frames, strict=True):
        torch.testing.assert_close(found, expected, **close)


def test_errors_without_photons_weigh_every_pixel_by_itself():
    frames, valid = exposures(), torch.ones(GRID.shape, dtype=torch.bool)
    valid[3, 4] = False
    errors = READOUT * (0.8 + torch.arange(32.0).double() / 64).expand(GRID.shape).clone()
    errors[3, 4] = math.nan
    stack = FrameStack.of(frames, valid, GRID, PUPIL, None, errors=errors)
    assert bool((stack.precision[:, 3, 4] == 0).all())
    torch.testing.assert_close(stack.precision[:, valid], ((stack.unit / errors[valid]) ** 2).expand(4, -1))
    assert float(stack.photon_share.abs().max()) == 0
    assert bool((stack.noise_of_frames.level == 1).all())
    single = stack.to(torch.float32, torch.device("cpu"))
    assert single.precision.dtype == torch.float32


def test_frames_are_still_if_they_change_by_their_noise_alone(seeded):
    """However bright; a single one tells nothing of it, nor do several where the noise that is told is too large."""
    y, x = torch.meshgrid(*(torch.arange(32.0) - 16,) * 2, indexing="ij")
    peak = 1e4 * torch.exp(-(x**2 + y**2) / 20)
    wave = 1 + 0.05 * torch.sin(x)
    for number in range(5):
        still = [torch.poisson(peak, generator=seeded(10 * number + frame)) for frame in range(4)]
        moved = [*still[:3], torch.poisson(peak * wave, generator=seeded(10 * number + 3))]
        for frames, readout_noise, expected in (
            (still, 0.0, True),
            (moved, 0.0, False),
            (still[:1], 0.0, False),
            (still, 40.0, False),
        ):
            counts = torch.stack(frames)
            mean = float(counts.mean())
            variance = mean + readout_noise**2
            valid = torch.ones_like(counts, dtype=torch.bool)
            stack = FrameStack(counts / mean, valid, mean, variance, slope=mean / variance)
            assert stack.is_still is expected


@pytest.mark.parametrize(("deviations", "still"), [(4.99, True), (5.01, False), (-4.99, True), (-5.01, False)])
def test_frames_are_still_within_five_standard_deviations_of_what_noise_changes(deviations, still):
    """Two frames change by half of the noise variance a pixel, over as many degrees of freedom as there are pixels."""
    wave = torch.ones(GRID.shape, dtype=torch.float64)
    wave[:, ::2] = -1.0  # so that frames keep their light
    change = 0.5 * (1 + deviations * math.sqrt(2 / wave.numel()))  # of a pixel against the mean frame
    frames = 1 + math.sqrt(change / 100) * torch.stack([wave, -wave])
    stack = FrameStack(frames, torch.ones_like(frames, dtype=torch.bool), 10.0, 1.0)
    assert stack.change.each == pytest.approx(change, rel=1e-12)
    assert stack.is_still is still


def test_contrast_is_the_chi_square_of_the_weighted_mean_frame_against_an_even_one():
    """Each pixel of the mean has the inverse variance of all its valid frames; pixels without any do not count."""
    generator = torch.Generator().manual_seed(2)
    frames, errors = exposures(), 1 + 5 * torch.rand(4, *GRID.shape, dtype=torch.float64, generator=generator)
    valid = torch.rand(4, *GRID.shape, generator=generator) > 0.2
    valid[:, 3, :5] = False
    stack = FrameStack(frames / 7, valid, 7.0, 1.0, errors=errors)
    means, weights = [], []
    for row, column in ((row, column) for row in range(32) for column in range(32)):
        seen = valid[:, row, column]
        if bool(seen.any()):
            weight = errors[seen, row, column] ** -2
            weights.append(float(weight.sum()))
            means.append(float((weight * frames[seen, row, column]).sum()) / weights[-1])
    mean, weight = (torch.tensor(values, dtype=torch.float64) for values in (means, weights))
    level = float((weight * mean).sum() / weight.sum())
    assert stack.contrast == pytest.approx(float((weight * (mean - level) ** 2).mean()), rel=1e-9)


def test_contrast_of_noise_alone_is_one():
    """Within four standard errors, of a chi-square of nearly as many degrees of freedom as pixels."""
    noise = READOUT * torch.randn(6, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    stack = FrameStack(noise + 4.0, torch.ones(6, *GRID.shape, dtype=torch.bool), 1.0, READOUT**2)
    assert stack.contrast == pytest.approx(1, abs=4 * math.sqrt(2 / 1024))


def test_noise_of_frames_includes_that_of_a_known_sky():
    """It makes a frame noisier where it is brighter, whether it was subtracted or not."""
    sky = torch.tensor([0.0, 20.0, 60.0, 10.0], dtype=torch.float64)[:, None, None]
    frames, known = exposures() + sky, sky * torch.linspace(0.5, 1.5, 32, dtype=torch.float64)
    valid, variance = torch.ones_like(frames, dtype=torch.bool), float(frames.mean()) + READOUT**2
    bare = FrameStack(frames / 30, valid, 30.0, variance, slope=1.0)
    told = FrameStack((frames - known) / 5, valid, 5.0, variance, known, slope=1.0)
    assert float(bare.noise_of_frames.level.max()) > 1.5 * float(bare.noise_of_frames.level.min())
    for one, other in zip(told.noise_of_frames, bare.noise_of_frames, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=0)


def test_a_free_sky_that_changes_is_no_change():
    """Of frames whose light is the same but for its brightness, above the sky in their darkest part."""
    light = torch.zeros(GRID.shape, dtype=torch.float64)
    light[10:20, 12:22] = 5.0
    frames = light * torch.tensor([0.5, 1.0, 1.5]).double()[:, None, None]
    sky = torch.tensor([3.0, 0.2, 1.0], dtype=torch.float64)[:, None, None]
    stack = FrameStack(frames + sky, torch.ones_like(frames, dtype=torch.bool), 1.0, 0.01, free=Background.PER_FRAME)
    unit = float(frames.mean())  # of the light, which is what brightness is relative to
    assert replace(stack, frames=stack.frames / unit, unit=unit).change.each < 1e-20
    assert replace(stack, frames=stack.frames / unit, unit=unit, free=Background.NONE).change.each > 1
