"""Pixels that a camera has cut off at the largest value that it can hold, and that nobody has marked.

Light spreads over many values, and ever fewer pixels reach the larger ones. Where a camera cuts off, all that is
brighter piles up at one value.
"""

from __future__ import annotations

import torch
from scipy.special import bdtrc
from torch import Tensor

from torchmask.optics.copies import copies_among

_CHANCE = 1e-6  # of finding saturation in frames without any
_BELOW = 0.03  # of the largest value: how far below it fewer pixels than at it mean saturation
_ALIKE = 8  # pixels of an image that are equal by symmetry, at most
_MOST = 0.5  # of all pixels: if there are more, as in frames of zeros and ones, the largest value is no exception


def find_saturated(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) hold a value at which a camera has cut them off, (T, H, W) bool.

    That is the largest value of all, if pixels share it to the last digit, but for one in each frame more than eight
    and more than chance explains: no value that pixels can take within 3 % below it should be rarer. How many such
    values there are follows from the smallest difference of two pixels of a frame, which is 1 for counts. Frames that
    repeat earlier ones do not count.

    Pixels that have become unequal since they were cut off, as by a dark or a flat of their own, are not found, nor are
    those below a larger value. Nor are there any if more than half of all pixels share the largest value.

    Examples
    --------
    >>> light = torch.linspace(0.0, 5000.0, 400).reshape(1, 20, 20)
    >>> everywhere = torch.ones_like(light, dtype=torch.bool)
    >>> int(find_saturated(light, everywhere).sum()), int(find_saturated(light.clamp(max=4095), everywhere).sum())
    (0, 73)
    """
    light = torch.where(valid, frames, 0).double()
    top = float(light.max())
    saturated = valid & (light == top)
    counted = valid.clone()
    counted[copies_among(light)] = False
    shared = (saturated & counted).sum((1, 2))
    more = int((shared - 1).clamp(min=0).sum())  # each frame has a largest value, which may have been scaled
    if more <= _ALIKE or int(shared.sum()) > _MOST * int(counted.sum()):
        return torch.zeros_like(valid)
    steps = [frame[own].unique().diff() for frame, own in zip(light, counted, strict=True)]
    step = max((float(each.min()) for each in steps if each.numel()), default=0.0)
    if step == 0.0:  # each frame is even
        return torch.zeros_like(valid)
    n_below = int(max(1.0, _BELOW * top / step))  # values that pixels could take
    near = int((counted & ~saturated & (light > top - (n_below + 0.5) * step)).sum())
    chance = bdtrc(more - 1, more + near, 1 / (n_below + 1))  # of so many or more
    return saturated if chance < _CHANCE else torch.zeros_like(valid)
