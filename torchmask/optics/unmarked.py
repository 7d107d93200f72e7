"""Pixels of frames that tell nothing true and that nobody has marked: saturated ones, dead ones and spikes."""

from __future__ import annotations

import math
import warnings
from functools import partial

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.bad_pixels import fill_bad_pixels
from torchmask.optics.ceilings import find_ceilings
from torchmask.optics.dead import find_dead
from torchmask.optics.saturation import find_saturated
from torchmask.optics.spikes import find_spikes
from torchmask.optics.steady import find_steady


def leave_out_unmarked(
    frames: Tensor, valid: Tensor, grid: Grid, aperture: Aperture, stacklevel: int
) -> tuple[Tensor, Tensor]:
    """Return frames (T, H, W) with saturated and dead pixels and spikes filled in, and `valid` (T, H, W) without them.

    If there are any, a warning says so, as if it were raised `stacklevel` calls above. Raises ValueError if no pixel of
    a frame is left.
    """
    kinds = (
        (find_saturated, _what_is_cut_off),
        (find_ceilings, _what_has_ceilings),
        (find_steady, _what_never_varies),
        (find_dead, _what_is_dead),
        (partial(find_spikes, grid=grid, aperture=aperture), _what_stands_out),
    )
    for find, describe in kinds:
        found = find(frames, valid)
        if bool(found.any()):
            share = f"{int(found.sum()) / int(valid.sum()):.2g} of all"
            said = f"{describe(frames, found, share)}. They get no weight, as if they were marked in `valid`"
            warnings.warn(said, stacklevel=stacklevel + 1)
            valid = valid & ~found
            frames = _fill(frames, valid)
    return frames, valid


def _fill(frames: Tensor, valid: Tensor) -> Tensor:
    unseen = (~valid.any(2).any(1)).nonzero()[:, 0].tolist()
    if unseen:
        raise ValueError(f"frames {unseen} of this stack, counted from 0, have no other valid pixel: leave them out")
    return fill_bad_pixels(frames, valid)


def _what_is_cut_off(frames: Tensor, saturated: Tensor, share: str) -> str:
    return (
        f"{int(saturated.sum())} pixels ({share}) in {int(saturated.any(2).any(1).sum())} of {len(frames)} frames hold "
        f"{float(frames[saturated][0]):.10g}, the largest value of all, so the camera seems to cut off there"
    )


def _what_has_ceilings(frames: Tensor, cut_off: Tensor, share: str) -> str:
    return (
        f"{int(cut_off.sum())} pixels ({share}) in {int(cut_off.any(2).any(1).sum())} of {len(frames)} frames hold "
        f"{float(frames[cut_off].min()):.4g} or more, and pixels that reach so much come back to their own largest "
        "value again and again, so the camera seems to have cut them off before they were calibrated"
    )


def _what_never_varies(frames: Tensor, cut_off: Tensor, share: str) -> str:
    return (
        f"{int(cut_off.sum())} pixels ({share}) in {int(cut_off.any(2).any(1).sum())} of {len(frames)} frames hold "
        f"{float(frames[cut_off].min()):.4g} or more, and the brightest of them hold one value each in all frames, so "
        "the camera seems to have cut them off before they were calibrated"
    )


def _what_is_dead(frames: Tensor, dead: Tensor, share: str) -> str:
    return (
        f"{int(dead[0].sum())} pixels ({share}) hold one value in all {len(frames)} frames of this stack, as dead ones "
        "or a border that was filled up"
    )


def _what_stands_out(frames: Tensor, spikes: Tensor, share: str) -> str:
    where = torch.where(spikes, frames, -math.inf).argmax()
    place = tuple(int(one) for one in torch.unravel_index(where, frames.shape))
    numbers = spikes.any(2).any(1).nonzero()[:, 0].tolist()
    return (
        f"{int(spikes.sum())} pixels of frames {numbers} of this stack, counted from 0, hold what no optics can make, "
        f"such as cosmic rays, hot and dead pixels, or lie beside it ({share}); the brightest has "
        f"{float(frames[place]):.3g} electrons at (frame, row, column) {place}"
    )
