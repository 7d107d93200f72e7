"""Pixels that hold one value in all frames, and that nobody has marked: dead columns, borders that were filled up."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.optics.copies import copies_among

_CHANCE = 1e-3  # of finding one in frames without any


def find_dead(frames: Tensor, valid: Tensor) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) are dead, the same in all frames, (T, H, W) bool.

    They are valid in all frames and hold one value to the last digit, which no other pixel has in any frame: zero
    often, or a value of its own for each, after a dark was subtracted. By chance a pixel repeats itself the more often
    the fewer values it can take, for which the repetitions of all others stand. There are none if chance would make one
    in more than a thousandth of stacks, as in one or two frames, or in single photons. Frames that repeat earlier ones
    do not count.

    Examples
    --------
    >>> frames = torch.rand(4, 16, 16, generator=torch.Generator().manual_seed(0))
    >>> frames[:, :, 3] = 0.0
    >>> int(find_dead(frames, torch.ones_like(frames, dtype=torch.bool)).sum())
    64
    """
    copies = set(copies_among(frames))
    others = [number for number in range(len(frames)) if number not in copies]
    different, always = frames[others], valid.all(0)
    still = always & (different == different[0]).all(0)
    varying = different[:, always & ~still]  # (T, n)
    if not bool(still.any()) or not varying.numel():
        return torch.zeros_like(valid)
    values, which, times = varying.unique(return_inverse=True, return_counts=True)
    n_alone = int((times[which] == 1).any(0).sum())  # pixels that had no other beside them, if they repeated themselves
    repeated = float((varying[1:] == varying[:-1]).sum() + 1) / (varying[1:].numel() + 1)
    if (n_alone + 1) * math.pow(repeated, len(different) - 1) > _CHANCE:
        return torch.zeros_like(valid)
    return (still & ~torch.isin(frames[0], values)).expand_as(valid)
