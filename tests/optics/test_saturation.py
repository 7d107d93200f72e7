"""Pixels that a camera has cut off, told from the brightest ones of frames that it has not."""

import math
from fractions import Fraction

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics.saturation import find_saturated

CHANCE = 1e-6  # as documented: of finding saturation in frames without any
ALIKE = 8


def everywhere(frames):
    return torch.ones_like(frames, dtype=torch.bool)


def counts(n_photons, width=6.0, n_frames=5, side=40, seed=0):
    """Frames (T, H, W) of whole electrons, of a round spot of light."""
    axis = torch.arange(side, dtype=torch.float64) - side / 2
    spot = torch.exp(-(axis[:, None] ** 2 + axis**2) / (2 * width**2))
    spot = spot * (n_photons / float(spot.sum()))
    return torch.poisson(spot.expand(n_frames, side, side), generator=torch.Generator().manual_seed(seed))


@given(
    st.floats(0.0, 8.0), st.floats(0.5, 40.0), st.integers(1, 12), st.sampled_from([0.1, 0.37, 1.0, 4.0]), st.integers()
)
@settings(deadline=None, max_examples=100)
def test_counts_that_are_not_cut_off_have_no_saturation(log_photons, width, n_frames, gain, seed):
    """From single electrons to even light of hundreds of electrons in each pixel, whole after division by the gain."""
    frames = (counts(10**log_photons, width, n_frames, seed=seed % 2**31) / gain).round() * gain
    assert not bool(find_saturated(frames, everywhere(frames)).any())


@given(st.floats(6.0, 8.0), st.floats(0.005, 0.3), st.sampled_from([torch.float32, torch.float64]))
@settings(deadline=None, max_examples=50)
def test_counts_that_are_cut_off_are_found_whatever_their_unit(log_photons, share, dtype):
    frames = counts(10**log_photons).to(dtype)
    level = float(frames.quantile(1 - share, interpolation="lower"))
    for unit in (1.0, 0.37, 1e-6):
        cut_off = unit * frames.clamp(max=level)
        assert torch.equal(find_saturated(cut_off, everywhere(cut_off)), frames >= level)


def test_light_with_noise_of_no_step_needs_few_pixels_and_has_no_equal_ones_by_itself():
    frames = counts(1e6) + torch.randn(5, 40, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert not bool(find_saturated(frames, everywhere(frames)).any())
    for more in (ALIKE, ALIKE + 1):  # of the third frame, which has one of its own
        cut_off = frames.clone()
        cut_off[2] = frames[2].clamp(max=float(frames[2].flatten().topk(more + 1).values[-1]))
        cut_off[2] += 1e4  # brighter than the others
        assert int(find_saturated(cut_off, everywhere(cut_off)).sum()) == (more + 1 if more > ALIKE else 0)


def tail(n, of, chance):
    """Chance of n or more among `of`, each with a chance of its own."""
    return sum(math.comb(of, k) * chance**k * (1 - chance) ** (of - k) for k in range(n, of + 1))


@pytest.mark.parametrize("top", [40, 300, 4095])
@pytest.mark.parametrize("near", [0, 5, 40])
def test_as_many_pixels_are_saturated_as_chance_does_not_explain(top, near):
    """Each of the pixels within 3 % of the largest value has the same chance of it as of any of the whole numbers
    there, but for one, that is largest by definition: exact tails of binomials say how many are too many."""
    below = max(1, int(0.03 * top))
    one = Fraction(1, below + 1)
    least = next(n for n in range(ALIKE + 2, 1000) if tail(n - 1, n - 1 + near, one) < CHANCE)
    ranks = torch.arange(near) % below
    others = torch.arange(1200) % (top - below)  # all values further down, so that the step is 1
    for n in (least - 1, least):
        values = torch.cat([torch.full((n,), top), top - 1 - ranks, others]).double()
        frames = torch.cat([values, torch.zeros(-len(values) % 20)]).reshape(1, -1, 20)
        assert int(find_saturated(frames, everywhere(frames)).sum()) == (n if n == least else 0)


def test_few_values_take_more_pixels():
    """Of 20 levels of light cut-off ones are told by being more than those at 19."""
    frames = counts(3e4).clamp(max=20)
    n, below = int((frames == 20).sum()), int((frames == 19).sum())
    assert n > 5 * below
    assert torch.equal(find_saturated(frames, everywhere(frames)), frames == 20)


def test_frames_that_repeat_others_do_not_count():
    """Neither pixels at the largest value, of which there are four in each, nor those near it."""
    frame = torch.arange(400.0, dtype=torch.float64).remainder(39)
    frame[::100] = 40
    again = frame.reshape(1, 20, 20).repeat(50, 1, 1)
    assert not bool(find_saturated(again, everywhere(again)).any())
    frame[:60:2] = 39  # as 100 pixels at the largest value would not be among 30 at the next, but among 330
    cut_off = torch.arange(400.0, dtype=torch.float64).remainder(38).flip(0)
    cut_off[:100] = 40
    frame[::100] = 38
    both = torch.stack([cut_off, *[frame] * 11]).reshape(12, 20, 20)
    assert int(find_saturated(both, everywhere(both)).sum()) == 100


def test_of_more_than_half_of_the_valid_pixels_the_largest_value_is_no_exception():
    light = torch.arange(800, dtype=torch.float64).reshape(2, 20, 20)
    light[1] = light[0] + 0.5
    half = everywhere(light)
    half[:, 10:] = False
    for valid in (everywhere(light), half):
        for share, found in ((0.45, True), (0.55, False)):
            level = float(light[valid].quantile(1 - share, interpolation="lower"))
            assert bool(find_saturated(light.clamp(max=level), valid).any()) == found


def test_frames_scaled_by_their_own_largest_value_or_mean_have_no_saturation():
    """Whatever they hold: one pixel of each frame is at 1; counts of a frame keep steps of their own."""
    for n_photons in (300, 1e5):
        frames = counts(n_photons, n_frames=40)
        for scale in (frames.amax((1, 2)), frames.mean((1, 2)), 2.0 + 0.1 * (torch.arange(40) % 2)):
            scaled = frames / scale[:, None, None]
            assert not bool(find_saturated(scaled, everywhere(scaled)).any())
    single = (counts(100, 40.0, 12) > 0).double()
    for frames in (single / single.mean((1, 2), keepdim=True), single - single.mean((1, 2), keepdim=True)):
        assert not bool(find_saturated(frames, everywhere(frames)).any())


def test_whole_numbers_of_any_type_and_frames_that_are_cut_off_everywhere():
    frames = counts(1e6).clamp(max=1000)
    for dtype in (torch.int16, torch.int64, torch.float32):
        assert torch.equal(find_saturated(frames.to(dtype), everywhere(frames)), frames == 1000)
    frames = counts(1e6, n_frames=6)
    frames[2] = frames.max() + 1
    found = find_saturated(frames, everywhere(frames))
    assert found.all(2).all(1).tolist() == [number == 2 for number in range(6)]


def test_pixels_that_are_not_valid_neither_hide_nor_make_saturation():
    frames = counts(1e6).clamp(max=1000.0)
    valid = everywhere(frames)
    valid[:, 0, :] = False
    spoilt = frames.clone()
    spoilt[:, 0, 0], spoilt[:, 0, 1], spoilt[:, 0, 2] = math.inf, math.nan, 1000.0
    assert torch.equal(find_saturated(spoilt, valid), frames == 1000.0)
    again = counts(1e5, n_frames=1).repeat(50, 1, 1)
    again[:, 0, 1] = math.nan
    assert not bool(find_saturated(again, valid[:1].expand_as(again)).any())
    spoilt = counts(1e6)
    spoilt[:, 0, :] = 1e6
    assert not bool(find_saturated(spoilt, valid).any())
    assert not bool(find_saturated(spoilt, torch.zeros_like(valid)).any())


@pytest.mark.parametrize("value", [0.0, 1.0, 65535.0])
def test_even_frames_and_frames_of_zeros_and_ones_have_none(value):
    even = torch.full((3, 20, 20), value)
    assert not bool(find_saturated(even, everywhere(even)).any())
    unlike = even + torch.arange(3.0)[:, None, None]
    assert not bool(find_saturated(unlike, everywhere(unlike)).any())
    ones = (torch.arange(1200) % 3 > 0).double().reshape(3, 20, 20)
    assert not bool(find_saturated(ones, everywhere(ones)).any())
