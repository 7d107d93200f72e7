"""Pixels that a camera has cut off at the largest value that it can hold, and that nobody has marked.

Light spreads over many values, and ever fewer pixels reach the larger ones. Where a camera cuts off, all that is
brighter piles up at one value.
"""

from __future__ import annotations

import math

import torch
from scipy.stats import binom
from torch import Tensor

from torchmask.optics.copies import copies_among

_CHANCE = 1e-6  # of finding saturation in frames without any
_BELOW = 0.03  # of the largest value: how far below it fewer pixels than at it mean saturation
_ALIKE = 8  # pixels of an image that are equal by symmetry, at most
_MOST = 0.5  # of all pixels: if there are more, as in frames of zeros and ones, the largest value is no exception


def find_saturated(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) hold a value at which a camera has cut them off, (T, H, W) bool.

    That is the largest value of all, if more than eight pixels share it to the last digit, and more than chance
    explains: no value that pixels can take within 3 % below it should be rarer. How many such values there are follows
    from the smallest difference of two pixels, which is 1 for counts. Frames that repeat earlier ones do not count.

    Pixels that have become unequal since they were cut off, as by a dark or a flat of their own, are not found. Nor are
    there any if more than half of all pixels share the largest value.

    Examples
    --------
    >>> light = torch.linspace(0.0, 5000.0, 400).reshape(1, 20, 20)
    >>> everywhere = torch.ones_like(light, dtype=torch.bool)
    >>> int(find_saturated(light, everywhere).sum()), int(find_saturated(light.clamp(max=4095), everywhere).sum())
    (0, 73)
    """
    top = frames.masked_fill(~valid, -math.inf).max()
    saturated = valid & (frames == top)
    counted = valid.clone()
    counted[copies_among(frames)] = False
    n_saturated = int((saturated & counted).sum())
    if not _ALIKE < n_saturated <= _MOST * int(counted.sum()):
        return torch.zeros_like(valid)
    step = float(frames[counted].unique().diff().min())
    n_below = int(max(1.0, _BELOW * float(top) / step))  # values that pixels could take
    near = int((counted & ~saturated & (frames > top - (n_below + 0.5) * step)).sum())
    # one pixel is at the largest value by its definition: of the others, each may be at any
    chance = binom.sf(n_saturated - 2, n_saturated - 1 + near, 1 / (n_below + 1))
    return saturated if chance < _CHANCE else torch.zeros_like(valid)
