"""Pixels that hold one value in all frames, and that nobody has marked: dead columns, borders that were filled up."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.optics.copies import copies_among

_FEW = 8  # pixels, at most, that stand still by chance, or for most of the time by hits of dead ones
_MOSTLY = 0.75  # of the frames, in which a pixel repeats what it held before
_HARDLY = 0.03  # so many such pixels for each one that always does
_RARE = 1e-3  # share of all pixels that may hold the value of a dead one


def find_dead(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) are dead, the same in all frames, (T, H, W) bool.

    They are valid in all frames and hold one value to the last digit, which hardly any other pixel ever has: zero
    often, or a value of its own for each, after a dark was subtracted. Few values, as those of faint light, let pixels
    stand still by chance; but then others do so for most of the time. So there are none unless more than eight always
    do, and hardly any in three quarters of the frames. Two frames cannot tell. Frames that repeat earlier ones do not
    count.

    Examples
    --------
    >>> frames = torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))
    >>> frames[:, :, 3] = 0.0
    >>> int(find_dead(frames, torch.ones_like(frames, dtype=torch.bool)).sum())
    64
    """
    light, always = torch.where(valid, frames, 0), valid.all(0)
    copies = set(copies_among(light))
    light = light[[number for number in range(len(light)) if number not in copies]]
    n_steps = len(light) - 1
    if n_steps < 2:
        return torch.zeros_like(valid)
    repeats = (light[1:] == light[:-1]).sum(0)
    still = always & (repeats == n_steps)
    mostly = always & ~still & (repeats >= min(math.ceil(_MOSTLY * n_steps), n_steps - 1))
    n_still = int(still.sum())
    if n_still <= _FEW or int(mostly.sum()) > min(_HARDLY * n_still, _FEW):
        return torch.zeros_like(valid)
    values, times = light[:, always & ~still & ~mostly].unique(return_counts=True)
    common = values[times > _RARE * int(times.sum())]
    return (still & ~torch.isin(light[0], common)).expand_as(valid)
