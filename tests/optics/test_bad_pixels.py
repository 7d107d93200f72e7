"""What stands in for dead pixels: closed forms, and laws that hold for any hole."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.optics.bad_pixels import fill_bad_pixels


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_lone_pixel_is_the_mean_of_its_neighbours(dtype):
    frames = torch.rand(3, 6, 7, dtype=dtype, generator=torch.Generator().manual_seed(0))
    valid = torch.ones(3, 6, 7, dtype=torch.bool)
    valid[:, 2, 3] = valid[:, 0, 0] = valid[1, 5, 3] = False
    filled = fill_bad_pixels(torch.where(valid, frames, math.nan), valid)
    rounding = {"rtol": 8 * torch.finfo(dtype).eps, "atol": 0.0}  # sums of up to 8 numbers
    torch.testing.assert_close(filled[:, 2, 3], (frames[:, 1:4, 2:5].sum((1, 2)) - frames[:, 2, 3]) / 8, **rounding)
    torch.testing.assert_close(filled[:, 0, 0], (frames[:, :2, :2].sum((1, 2)) - frames[:, 0, 0]) / 3, **rounding)
    torch.testing.assert_close(filled[1, 5, 3], (frames[1, 4:, 2:5].sum() - frames[1, 5, 3]) / 5, **rounding)
    assert filled.dtype == dtype
    assert torch.equal(filled[valid], frames[valid])


def test_a_region_is_filled_from_its_rim_inwards():
    """Three dead columns beside a step: the outer ones take the side they touch, the middle one their mean."""
    frames = torch.zeros(1, 8, 7, dtype=torch.float64)
    frames[..., 5:] = 6.0
    valid = torch.ones(1, 8, 7, dtype=torch.bool)
    valid[..., 2:5] = False
    filled = fill_bad_pixels(torch.where(valid, frames, 1e9), valid)
    torch.testing.assert_close(filled[0, 3], torch.tensor([0, 0, 0, 3, 6, 6, 6], dtype=torch.float64))


def test_a_frame_without_a_valid_pixel_is_dark_and_leaves_the_others_alone():
    frames = torch.full((2, 5, 5), 3.0)
    valid = torch.ones(2, 5, 5, dtype=torch.bool)
    valid[0], valid[1, 2, 2] = False, False
    filled = fill_bad_pixels(torch.where(valid, frames, math.inf), valid)
    assert torch.equal(filled[0], torch.zeros(5, 5))
    assert torch.equal(filled[1], torch.full((5, 5), 3.0))


@settings(derandomize=True, deadline=None)
@given(st.integers(0, 2**31), st.floats(0.0, 0.99))
def test_what_is_filled_lies_between_the_valid_pixels(seed, dead):
    generator = torch.Generator().manual_seed(seed)
    frames = torch.randn(3, 7, 9, dtype=torch.float64, generator=generator)
    valid = torch.rand(3, 7, 9, generator=generator) >= dead
    filled = fill_bad_pixels(torch.where(valid, frames, math.nan), valid)
    assert torch.equal(filled[valid], frames[valid])
    for frame, good, whole in zip(filled, valid, frames, strict=True):
        known = whole[good] if good.any() else torch.zeros(1, dtype=torch.float64)
        assert known.min() - 1e-12 <= frame.min()
        assert frame.max() <= known.max() + 1e-12
    # every frame by itself
    alone = [fill_bad_pixels(frames[t : t + 1], valid[t : t + 1]) for t in range(3)]
    torch.testing.assert_close(torch.cat(alone), filled, rtol=1e-12, atol=1e-12)
