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
    frames = exposures(peak=30.0, n_frames=20).clamp(min=0)
    frames[:, :, 7] = 0.0
    assert not bool(find_dead(frames, everywhere(frames)).any())


@given(st.floats(1.0, 7.0), st.integers(3, 60), st.sampled_from([0.0, 0.2, 0.3, 0.5]), st.integers(0, 2**31))
@settings(deadline=None, max_examples=150)
def test_faint_counts_minus_a_dark_or_a_sky_have_none(log_photons, n_frames, readout, seed):
    """Zero counts repeat themselves, and what is subtracted makes them unlike all others."""
    spot = light() + 1e-3  # as optics leave some light everywhere
    photons = torch.poisson(
        (10**log_photons * spot / spot.sum()).expand(n_frames, 32, 32), generator=torch.Generator().manual_seed(seed)
    )
    noise = torch.randn(photons.shape, generator=torch.Generator().manual_seed(seed + 1), dtype=torch.float64)
    frames = photons + (readout * noise).round()
    dark = torch.rand(32, 32, generator=torch.Generator().manual_seed(seed + 2), dtype=torch.float64)
    sky = 0.05 + 0.02 * torch.arange(32.0)[:, None] + 0.013 * torch.arange(32.0) ** 2
    for subtracted in (dark, sky, 100 - dark):
        assert not bool(find_dead(frames - subtracted, everywhere(frames)).any())


def test_few_frames_and_few_pixels_do_not_tell_and_copies_of_them_no_more():
    frames = exposures()
    frames[:, :, 7] = 0.0
    for n_frames, found in ((1, 0), (2, 0), (3, 3 * 32)):
        part = frames[:n_frames]
        assert int(find_dead(part, everywhere(part)).sum()) == found
    again = frames[:2].repeat(5, 1, 1)
    assert not bool(find_dead(again, everywhere(again)).any())
    counted = frames[:2].round()
    assert not bool(find_dead(counted, everywhere(counted)).any())
    for n_dead in (8, 9):
        frames = exposures()
        frames[:, :n_dead, 7] = 0.0
        assert int(find_dead(frames, everywhere(frames)).sum()) == (6 * 9 if n_dead == 9 else 0)


def test_a_column_is_found_though_a_hit_and_a_rare_value_look_like_it():
    """Of 48 rows one is hit in one of a hundred frames, and another pixel is 0 once."""
    generator = torch.Generator().manual_seed(1)
    frames = 100 + 3 * torch.randn(100, 48, 48, generator=generator, dtype=torch.float64)
    frames[:, :, 20] = 0.0
    frames[30, 10, 20], frames[50, 5, 5] = 900.0, 0.0
    dead = torch.zeros(48, 48, dtype=torch.bool)
    dead[:, 20] = True
    dead[10, 20] = False
    assert torch.equal(find_dead(frames, everywhere(frames)), dead.expand_as(frames))
    few = frames[28:34]  # in which the pixel that is hit repeats itself less often, and is one of those that change
    assert torch.equal(find_dead(few, everywhere(few)), dead.expand_as(few))
    wide = frames.clone()
    wide[:, :, 18:21] = 0.0
    wide[30, 10:14, 19] = 900.0  # four of 144, which hold more zeros than are rare among the others
    assert int(find_dead(wide, everywhere(wide))[0].sum()) == 140
    frames[31, 12, 20] = 900.0  # two of 48 are more than 3 %
    assert not bool(find_dead(frames, everywhere(frames)).any())


def test_pixels_that_mostly_repeat_themselves_let_others_stand_still_by_chance():
    """Of frames with nine still pixels, one pixel repeats itself after 15 or 14 of 20 frames: three quarters are 15."""
    for n_repeats, n_found in ((14, 21 * 9), (15, 0)):
        frames = exposures(n_frames=21)
        frames[:, :9, 7] = 0.0
        frames[: n_repeats + 1, 20, 20] = 5.5
        assert int(find_dead(frames, everywhere(frames)).sum()) == n_found


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
    again = frames[:1].repeat(4, 1, 1)  # one frame, though no NaN equals another
    assert not bool(find_dead(again, valid[:1].expand_as(again)).any())


@pytest.mark.parametrize("value", [0.0, 5.0])
def test_frames_that_do_not_change_have_none(value):
    frames = torch.full((4, 8, 8), value)
    assert not bool(find_dead(frames, everywhere(frames)).any())
    still = exposures(n_frames=1).repeat(4, 1, 1) + torch.tensor([0.0, 0.0, 0.0, 0.0])[:, None, None]
    assert not bool(find_dead(still, everywhere(still)).any())
