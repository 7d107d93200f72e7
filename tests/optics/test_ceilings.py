"""Pixels that a camera has cut off before a dark and a flat, told from the brightest ones of frames that it has not."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics.ceilings import find_ceilings

CHANCE = 1e-6  # as documented: of finding any in frames without
SIDE = 40


def everywhere(frames):
    return torch.ones_like(frames, dtype=torch.bool)


def spot(n_photons, n_frames, width=6.0, seed=0):
    """Frames (T, H, W) of whole electrons, of a round spot of light that flickers by half."""
    generator = torch.Generator().manual_seed(seed)
    axis = torch.arange(SIDE, dtype=torch.float64) - SIDE / 2
    light = torch.exp(-(axis[:, None] ** 2 + axis**2) / (2 * width**2))
    flicker = 0.75 + 0.5 * torch.rand(n_frames, SIDE, SIDE, generator=generator, dtype=torch.float64)
    return torch.poisson(light * (n_photons / float(light.sum())) * flicker, generator=generator)


def flat(rms, seed=1):
    generator = torch.Generator().manual_seed(seed)
    return 1 + rms * torch.randn(SIDE, SIDE, generator=generator, dtype=torch.float64)


def columns(*pixels):
    """Frames (T, 1, P) of which each pixel holds the values of one column."""
    return torch.tensor(pixels, dtype=torch.float64).T[:, None]


@given(st.floats(0.0, 8.0), st.floats(0.5, 40.0), st.integers(1, 12), st.sampled_from([0.0, 0.02, 0.2]), st.integers())
@settings(deadline=None, max_examples=100)
def test_counts_that_are_not_cut_off_have_no_ceilings(log_photons, width, n_frames, rms, seed):
    frames = spot(10**log_photons, n_frames, width, seed % 2**31) / flat(rms)
    assert not bool(find_ceilings(frames, everywhere(frames)).any())


@given(st.floats(6.0, 8.0), st.floats(0.03, 0.1), st.sampled_from([0.002, 0.01, 0.04]), st.integers(8, 12))
@settings(deadline=None, max_examples=50)
def test_counts_that_are_cut_off_before_a_dark_and_a_flat_are_found(log_photons, share, rms, n_frames):
    """All of them; besides only what is no further below their ceilings than these scatter, in the extreme."""
    raw, dark = 100 + spot(10**log_photons, n_frames), 100 + flat(1.0)
    level = float(raw.quantile(1 - share, interpolation="lower"))
    for unit, dtype in ((1.0, torch.float64), (1e-6, torch.float64), (0.37, torch.float32)):
        frames = (unit * (raw.clamp(max=level) - dark) / flat(rms)).to(dtype)
        found = find_ceilings(frames, everywhere(frames))
        ceilings = frames[raw >= level]
        farthest = ceilings.median() - 6 * (ceilings - ceilings.median()).abs().median()
        # six median deviations, known to a third from few pixels, are 2.7 standard deviations: 0.4 % lie below
        lost = int((found < (raw >= level)).sum())
        assert lost <= max(3, 0.01 * int((raw >= level).sum()))
        assert bool((frames[found] >= farthest * (1 - 5 * rms)).all())


def test_as_bright_as_the_lowest_ceilings_is_six_median_deviations_below_the_middle_one():
    """Thirty-nine pixels come back to 1000, or 10 more or less: the limit is 940, which single values reach too."""
    ceilings = [1000.0] * 13 + [990.0] * 13 + [1010.0] * 13
    dark = [[100.0 + i, 90.0 + i, 80.0 + i, 70.0 + i] for i in range(400)]
    for single, is_found in ((940.0, True), (939.0, False)):
        frames = columns(*[[top, top, top - 1, 0.0] for top in ceilings], [single, 3.0, 2.0, 1.0], *dark)
        found = find_ceilings(frames, everywhere(frames))
        assert bool(found[0, 0, 39]) == is_found
        assert bool(found[:3, 0, :39].all())
        assert int(found.sum()) == 3 * 39 + is_found


@pytest.mark.parametrize("n_below", [0, 3, 8])
def test_more_pixels_come_back_than_chance_explains(n_below):
    """Either is as likely as the other: exact tails of binomials, for each number of the brightest pixels."""

    def tail(n):
        return sum(math.comb(n + n_below, k) for k in range(n, n + n_below + 1)) / 2 ** (n + n_below)

    def bright(n):
        back = [[1000.0, 1000.0, 999.0, 0.0]] * n
        return columns(*[[1001.0, 999.0, 999.0, 0.0]] * n_below, *back, *[[4.0, 3.0, 2.0, 1.0]] * 500)

    least = next(n for n in range(1, 200) if tail(n) * (n + n_below + 500) <= CHANCE)
    for n in (least - 1, least):
        frames = bright(n)
        assert bool(find_ceilings(frames, everywhere(frames)).any()) == (n == least)


@pytest.mark.parametrize(("top", "is_found"), [(29.0, False), (30.0, True)])
def test_few_values_come_back_by_themselves(top, is_found):
    """Thirty steps of the smallest difference lead to a ceiling, at least."""
    frames = columns(*[[top, top, top - 1, 0.0]] * 100, *[[4.0, 3.0, 2.0, 1.0]] * 100)
    assert bool(find_ceilings(frames, everywhere(frames)).any()) == is_found
    single = (spot(1e4, 8) > 0).double() / flat(0.02)
    assert not bool(find_ceilings(single, everywhere(single)).any())


@pytest.mark.parametrize(("apart", "is_found"), [(83.0, True), (84.0, False)])
def test_ceilings_are_of_about_the_same_height(apart, is_found):
    """Six median deviations are at most half of the middle one."""
    heights = [1000.0 - apart] * 20 + [1000.0] * 20 + [1000.0 + apart] * 20
    frames = columns(*[[top, top, top - 1, 0.0] for top in heights], *[[4.0, 3.0, 2.0, 1.0]] * 100)
    assert bool(find_ceilings(frames, everywhere(frames)).any()) == is_found


def test_a_still_scene_that_is_dimmed_once_is_not_cut_off():
    """All pixels come back to their largest values, but these are of all heights."""
    frames = spot(1e6, 1).expand(8, -1, -1).clone()
    frames[0] *= 0.5
    frames[:, 0, 0] = torch.arange(8)  # so that no frame repeats another
    assert not bool(find_ceilings(frames, everywhere(frames)).any())


@pytest.mark.parametrize(("dense", "is_found"), [(102, True), (104, False)])
def test_a_quarter_of_the_brightest_come_back(dense, is_found):
    """Others as bright are 3 times as many, at most."""
    back, others = [[1000.0, 1000.0, 980.0, 0.0]] * 33 + [[990.0, 990.0, 980.0, 0.0]], [[1001.0, 9.0, 8.0, 7.0]]
    frames = columns(*others * dense, *back, *[[4.0, 3.0, 2.0, 1.0]] * 200)
    assert bool(find_ceilings(frames, everywhere(frames)).any()) == is_found


def test_frames_that_repeat_others_neither_hide_nor_make_ceilings():
    frames = spot(1e6, 3)
    again = torch.cat([frames, frames[:1]])
    assert not bool(find_ceilings(again, everywhere(again)).any())
    brightest = columns(*[[1000.0 + i % 7, 998.0, 3.0] for i in range(100)])
    twice = brightest[[0, 0, 1, 2]]
    twice[1, 0, 0] = math.nan
    assert not bool(find_ceilings(twice, twice.isfinite().all(0).expand_as(twice)).any())
    cut_off = spot(1e6, 8).clamp(max=3000) / flat(0.01)
    twice = cut_off.repeat(2, 1, 1)
    assert torch.equal(
        find_ceilings(twice, everywhere(twice)), find_ceilings(cut_off, everywhere(cut_off)).repeat(2, 1, 1)
    )


def test_pixels_that_are_not_valid_neither_hide_nor_make_ceilings():
    frames = spot(1e6, 8).clamp(max=3000) / flat(0.01)
    valid = everywhere(frames)
    valid[:, 20, :] = False
    spoilt = frames.clone()
    spoilt[:, 20, 0], spoilt[:, 20, 1], spoilt[:, 20, 2:] = math.inf, math.nan, 1e9
    found = find_ceilings(spoilt, valid)
    assert bool(found.any())
    assert not bool(found[:, 20].any())
    assert not bool(find_ceilings(frames, torch.zeros_like(valid)).any())
    whole = spot(1e6, 8)
    whole[:, 20, :] = torch.tensor([5e4, 5e4, 5e4, 5e4, 1e4, 1e4, 0, 1])[:, None]
    assert not bool(find_ceilings(whole, valid).any())
    bright = [[1000.0 + i % 7] * 3 + [0.0, 1.0] for i in range(100)]
    still = columns(*bright, [1000.0, 1000.0, 999.0, 0.0, 1.0], *[[4.0, 3.0, 2.0, 1.0, 0.0]] * 100)
    valid = everywhere(still)
    valid[3:, 0, :100] = False
    assert not bool(find_ceilings(still, valid).any())


def test_two_frames_and_even_ones_tell_nothing():
    for frames in (
        spot(1e6, 2).clamp(max=3000),
        torch.full((5, 20, 20), 7.0),
        torch.arange(5.0)[:, None, None] + torch.ones(20, 20),
    ):
        assert not bool(find_ceilings(frames, everywhere(frames)).any())


def test_whole_numbers_of_any_type():
    frames = spot(1e6, 8).clamp(max=3000)
    for dtype in (torch.int16, torch.int64):
        assert torch.equal(find_ceilings(frames.to(dtype), everywhere(frames)), frames == 3000)
