"""Pixels that are cut off in all frames before a flat, told from the brightest of frames that are not."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics.steady import find_steady

SIDE = 40


def everywhere(frames):
    return torch.ones_like(frames, dtype=torch.bool)


def star(peak, n_frames, seed=0, width=2.0):
    """Frames (T, H, W) of whole electrons, of a round spot of light that stays as it is."""
    axis = torch.arange(SIDE, dtype=torch.float64) - SIDE / 2 + 0.3
    light = peak * torch.exp(-(axis[:, None] ** 2 + axis**2) / (2 * width**2))
    return torch.poisson(light.expand(n_frames, -1, -1), generator=torch.Generator().manual_seed(seed))


def flat(rms):
    noise = torch.randn(SIDE, SIDE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return 1 + rms * noise


def cut_off(n_pixels, n_frames, rms=0.02, peak=1e4):
    """Frames of which the core is cut off before the flat, and where it is in all of them (H, W)."""
    seen = star(peak, n_frames)
    level = float(seen.amin(0).flatten().sort(descending=True).values[n_pixels - 1])
    return seen.clamp(max=level) / flat(rms), (seen >= level).all(0)


@given(st.integers(4, 20), st.sampled_from([4, 5, 20]), st.sampled_from([0.005, 0.02, 0.05]))
@settings(deadline=None, max_examples=40)
def test_the_core_of_a_steady_star_is_found(n_pixels, n_frames, rms):
    """All of it, and besides only what is as bright, but for 5 % and the scatter of the flat."""
    frames, core = cut_off(n_pixels, n_frames, rms)
    for unit, dtype in ((1.0, torch.float64), (1e-6, torch.float64), (0.37, torch.float32)):
        scaled = (unit * frames).to(dtype)
        found = find_steady(scaled, everywhere(scaled))
        assert bool(found[:, core].all())
        assert float(scaled[found].min()) >= 0.95 * float(scaled[:, core].min()) * (1 - 1e-6)


@given(st.floats(-1.0, 6.0), st.integers(1, 20), st.sampled_from([0.5, 2.0, 30.0]), st.integers(0, 2**31))
@settings(deadline=None, max_examples=150)
def test_stars_that_are_not_cut_off_have_none(log_peak, n_frames, width, seed):
    """Not even behind a dark, where single photons repeat themselves, nor scaled by their brightest pixel."""
    frames = star(10**log_peak, n_frames, seed, width)
    dark = torch.rand(SIDE, SIDE, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    peak = frames.amax((1, 2), keepdim=True).clamp(min=1)
    for spoilt in (
        frames / flat(0.02),
        frames - dark,
        frames + 100 * dark,
        frames.clamp(max=1) / flat(0.02),
        frames / peak,
    ):
        assert not bool(find_steady(spoilt, everywhere(spoilt)).any())


def test_frames_without_noise_have_none():
    """Their pixels repeat themselves but for rounding, or wherever it makes whole numbers of them."""
    still = star(1e4, 1)
    for frames in (still.expand(5, -1, -1), still * torch.tensor([1.0, 1.3, 0.7, 1.1])[:, None, None]):
        for scaled in (frames, frames / frames.sum((1, 2), keepdim=True), frames.round() / flat(0.02)):
            assert not bool(find_steady(scaled, everywhere(scaled)).any())
    moved = star(1e4, 1).expand(6, -1, -1) + 0.2 * torch.randn(
        6, SIDE, SIDE, generator=torch.Generator().manual_seed(2)
    )
    assert not bool(find_steady(moved.round() / flat(0.02), everywhere(moved)).any())


def chosen(n_still, n_others, n_frames, n_repeats, height=1000.0):
    """Frames (T, 1, P): still pixels of several heights, others as many as told that repeat a value once, dark ones."""
    generator = torch.Generator().manual_seed(0)
    others = 100 * torch.rand(n_frames, n_others, generator=generator, dtype=torch.float64)
    others[1, :n_repeats] = others[0, :n_repeats]
    still = (height + torch.arange(n_still, dtype=torch.float64)).expand(n_frames, -1)
    dark = torch.rand(n_frames, 30, generator=generator, dtype=torch.float64)
    return torch.cat([others[:, : n_others // 2], still, others[:, n_others // 2 :], dark], 1)[:, None]


@pytest.mark.parametrize("n_still", [2, 3, 5])
def test_chance_is_that_of_a_binomial(n_still):
    """Among four others beside them over T frames, r = (repeats + 1) / (4 (T - 1) + 1)."""
    for n_frames in (3, 4, 6, 10):
        for n_repeats in range(5):
            frames = chosen(n_still, 4, n_frames, n_repeats)
            share = (n_repeats + 1) / (4 * (n_frames - 1) + 1)
            by_itself = min(1.0, math.sqrt(2) * share) ** (n_frames - 1)
            chance = by_itself**n_still * frames.shape[-1]  # so many of as many, for any number of the brightest
            assert bool(find_steady(frames, everywhere(frames)).any()) == (chance <= 1e-6)


def test_a_quarter_of_the_brightest_never_vary():
    frames = chosen(4, 4, 12, 0)
    for brighter, is_found in ((11, True), (13, False)):
        spoilt = frames.clone()
        spoilt[:, :, -brighter:] += 2000
        assert bool(find_steady(spoilt, everywhere(spoilt)).any()) == is_found


def test_ceilings_are_of_about_the_same_height_but_not_equal():
    frames = chosen(4, 4, 12, 0)
    for values, n_found in (([1000, 1000, 1000, 501], 4), ([1000, 1000, 999, 499], 3), ([1000] * 4, 0)):
        frames[:, 0, 2:6] = torch.tensor(values, dtype=torch.float64)
        assert int(find_steady(frames, everywhere(frames)).sum()) == 12 * n_found
    assert not bool(find_steady(-frames, everywhere(frames)).any())


def test_few_values_repeat_themselves():
    """Four of the smallest step of others, at least, make the median one, and thirty a ceiling: it is 1 here."""
    for typical, height, is_found in ((3.0, 1e3, False), (4.0, 1e3, True), (4.0, 30.0, True), (4.0, 29.0, False)):
        frames = chosen(4, 4, 12, 0, height)
        frames[:, 0, [0, 1, 6, 7]] = torch.tensor([0.0, 1.0] + 5 * [1 + typical, 1.0]).double()[:, None]
        assert bool(find_steady(frames, everywhere(frames)).any()) == is_found


def test_dead_columns_and_borders_of_zeros_do_not_hide_the_core():
    frames, core = cut_off(6, 10)
    frames[:, :, 5], frames[:, -4:] = 0.0, 0.0
    found = find_steady(frames, everywhere(frames))
    assert bool(found[:, core].all())
    assert not bool(found[:, :, 5].any())


def test_what_is_not_valid_and_frames_that_repeat_others_do_not_count():
    frames, core = cut_off(8, 3)
    assert bool(find_steady(frames, everywhere(frames)).any())
    twice = frames[:2].repeat(4, 1, 1)
    assert not bool(find_steady(twice, everywhere(twice)).any())
    valid = everywhere(frames)
    valid[0, core] = False
    assert not bool(find_steady(frames, valid).any())
    spoilt = torch.where(core, torch.nan, frames)
    assert not bool(find_steady(spoilt, ~core.expand_as(frames)).any())
    assert not bool(find_steady(frames, torch.zeros_like(valid)).any())
