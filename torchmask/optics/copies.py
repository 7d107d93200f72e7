"""Frames that repeat earlier ones, as a file that is read twice does."""

from __future__ import annotations

import torch
from torch import Tensor


def copies_among(frames: Tensor) -> list[int]:
    """Return the numbers of the frames (T, H, W) that equal an earlier one in all pixels.

    Examples
    --------
    >>> copies_among(torch.tensor([1.0, 2.0, 1.0, 1.0])[:, None, None])
    [2, 3]
    """
    first: dict[float, list[int]] = {}
    copies = []
    for number, light in enumerate(frames.sum((1, 2)).tolist()):
        alike = first.setdefault(light, [])
        if any(torch.equal(frames[number], frames[other]) for other in alike):
            copies.append(number)
        else:
            alike.append(number)
    return copies
