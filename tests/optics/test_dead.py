"""Pixels that hold one value in all frames, told from those that repeat themselves by chance."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics.dead import find_dead


def everywhere(frames):
    return torch.ones_like(frames, dtype=torch.bool)


def light(side=32, width=5.0):
    axis = torch.arange(side, dtype=torch.float64) - side / 2
    return torch.exp(-(axis[:, None] ** 2 + axis**2) / (2 * width**2))


def exposures(peak=300.0, n_frames=6, seed=0, readout=2.0, bias=0.0):
    """Frames (T, 32, 32) of a round spot with photon and read-out noise."""
    generator = torch.Generator().manual_seed(seed)
    seen = torch.poisson((peak * light()).expand(n_frames, 32, 32), generator=generator)
    return bias + seen + readout * torch.randn(seen.shape, generator=generator, dtype=torch.float64)


@given(st.floats(-2.0, 6.0), st.integers(1, 40), st.sampled_from([0.0, 0.3, 1.0, 3.0]), st.integers(0, 2**31))
@settings(deadline=None, max_examples=150)
def test_counts_that_vary_have_no_dead_pixels(log_peak, n_frames, readout, seed):
    """From single photons, whose zeros stay zero, to bright light; by chance one in a thousand has."""
    frames = exposures(10**log_peak, n_frames, seed, readout).round()
    assert not bool(find_dead(frames, everywhere(frames)).any())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("whole", [False, True])
def test_columns_borders_and_single_pixels_are_found(dtype, whole):
    """Of one value, or of one for each, as after a dark was subtracted; counts beside a bias have no other zeros."""
    frames = exposures(n_frames=8, readout=3.0, bias=100.0)
    frames = (frames.round() if whole else frames).to(dtype)
    dead = torch.zeros(32, 32, dtype=torch.bool)
    dead[:, 7], dead[:3], dead[20, 25] = True, True, True
    zero = torch.where(dead, 0.0, frames)
    own = torch.where(dead, -torch.arange(32.0 * 32).reshape(32, 32) - 1, frames)
    for spoilt in (zero, own):
        assert torch.equal(find_dead(spoilt, everywhere(spoilt)), dead.expand_as(frames))


def test_a_value_that_other_pixels_have_too_may_be_light():
    """Zeros of frames from which the negative half of the noise was cut off."""
    frames = exposures(peak=30.0, n_frames=3).clamp(min=0)
    still = (frames == frames[0]).all(0)
    assert bool(still.any())
    assert not bool(find_dead(frames, everywhere(frames)).any())


def test_few_frames_do_not_tell_and_copies_of_them_no_more():
    """Of 992 pixels without any repetition among 992 n pairs, one would stand still with a chance of 993 times
    (1 / (992 n + 1))^n after n further frames: 1 after one, 2.5e-4 after two."""
    frames = exposures()
    frames[:, :, 7] = 0.0
    for n_frames, found in ((1, 0), (2, 0), (3, 3 * 32)):
        part = frames[:n_frames]
        assert int(find_dead(part, everywhere(part)).sum()) == found
    again = frames[:2].repeat(5, 1, 1)
    assert not bool(find_dead(again, everywhere(again)).any())


def test_the_more_values_repeat_themselves_the_more_frames_are_needed():
    """Half of all pixels repeat their value in each frame, and none has that of another: 1000 of them stand still for
    n further frames with chances of 1000 / 2^n, so that one in a thousand stacks has one after 20."""
    generator = torch.Generator().manual_seed(3)
    own = torch.arange(32.0 * 32).reshape(32, 32)
    dead = torch.zeros(32, 32, dtype=torch.bool)
    dead[:, 7] = True
    values = [own]
    for _ in range(29):
        kept = torch.rand(32, 32, generator=generator) < 0.5
        values.append(torch.where(kept | dead, values[-1], values[-1] + 1024))
    frames = torch.stack(values)
    needed = next(n for n in range(2, 31) if bool(find_dead(frames[:n], everywhere(frames[:n])).any()))
    assert 20 <= needed <= 22
    # by then single other pixels may stand still by chance, which is what one in a thousand means
    assert int((find_dead(frames[:needed], everywhere(frames[:needed]))[0] & ~dead).sum()) <= 1


def test_pixels_that_are_not_valid_in_all_frames_are_left_to_their_marks():
    frames = exposures()
    frames[:, :, 7] = 0.0
    valid = everywhere(frames)
    valid[2, :10, 7] = False
    valid[:, :, 30] = False
    frames[:, :, 30] = torch.nan
    expected = torch.zeros(32, 32, dtype=torch.bool)
    expected[10:, 7] = True
    assert torch.equal(find_dead(frames, valid), expected.expand_as(frames))


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_frames_that_do_not_change_have_none(value):
    frames = torch.full((4, 8, 8), value)
    assert not bool(find_dead(frames, everywhere(frames)).any())
    still = exposures(n_frames=1).repeat(4, 1, 1) + torch.tensor([0.0, 0.0, 0.0, 0.0])[:, None, None]
    assert not bool(find_dead(still, everywhere(still)).any())
