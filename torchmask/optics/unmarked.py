"""Pixels of frames that tell nothing true and that nobody has marked: saturated ones, dead ones and spikes."""

from __future__ import annotations

import math
import warnings

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.bad_pixels import fill_bad_pixels
from torchmask.optics.dead import find_dead
from torchmask.optics.saturation import find_saturated
from torchmask.optics.spikes import find_spikes

_NO_WEIGHT = "They get no weight, as if they were marked in `valid`"


def leave_out_unmarked(
    frames: Tensor, valid: Tensor, grid: Grid, aperture: Aperture, stacklevel: int
) -> tuple[Tensor, Tensor]:
    """Return frames (T, H, W) with saturated and dead pixels and spikes filled in, and `valid` (T, H, W) without them.

    If there are any, a warning says so, as if it were raised `stacklevel` calls above. Raises ValueError if no pixel of
    a frame is left.
    """
    saturated = find_saturated(frames, valid)
    if bool(saturated.any()):
        warnings.warn(_what_is_cut_off(frames, saturated, int(valid.sum())), stacklevel=stacklevel + 1)
        frames, valid = _fill(frames, valid & ~saturated)
    dead = find_dead(frames, valid)
    if bool(dead.any()):
        warnings.warn(_what_is_dead(dead, int(valid.sum())), stacklevel=stacklevel + 1)
        frames, valid = _fill(frames, valid & ~dead)
    spikes = find_spikes(frames, valid, grid, aperture)
    if bool(spikes.any()):
        warnings.warn(_what_stands_out(frames, spikes), stacklevel=stacklevel + 1)
        frames, valid = _fill(frames, valid & ~spikes)
    return frames, valid


def _fill(frames: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    unseen = (~valid.any(2).any(1)).nonzero()[:, 0].tolist()
    if unseen:
        raise ValueError(f"frames {unseen} of this stack, counted from 0, are saturated everywhere: leave them out")
    return fill_bad_pixels(frames, valid), valid


def _what_is_cut_off(frames: Tensor, saturated: Tensor, n_valid: int) -> str:
    n_saturated = int(saturated.sum())
    return (
        f"{n_saturated} pixels ({n_saturated / n_valid:.2g} of all) in {int(saturated.any(2).any(1).sum())} of "
        f"{len(frames)} frames hold {float(frames[saturated][0]):.10g}, the largest value of all, so the camera seems "
        f"to cut off there. {_NO_WEIGHT}"
    )


def _what_is_dead(dead: Tensor, n_valid: int) -> str:
    return (
        f"{int(dead[0].sum())} pixels ({int(dead.sum()) / n_valid:.2g} of all) hold one value in all frames of this "
        f"stack, as dead ones or a border that was filled up. {_NO_WEIGHT}"
    )


def _what_stands_out(frames: Tensor, spikes: Tensor) -> str:
    where = torch.where(spikes, frames, -math.inf).argmax()
    place = tuple(int(one) for one in torch.unravel_index(where, frames.shape))
    numbers = spikes.any(2).any(1).nonzero()[:, 0].tolist()
    return (
        f"{int(spikes.sum())} pixels of frames {numbers} of this stack, counted from 0, hold what no optics can make, "
        f"such as cosmic rays, hot and dead pixels, or lie beside it; the brightest has {float(frames[place]):.3g} "
        f"electrons at (frame, row, column) {place}. {_NO_WEIGHT}"
    )
