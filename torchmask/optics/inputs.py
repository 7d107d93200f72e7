"""Refusal of what a layer cannot take: what is no tensor, numbers that are not real, and axes that do not fit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchmask.plain import require_plain


def require_tensor(name: str, values: Any) -> None:
    """Raise TypeError unless the values are a tensor.

    >>> require_tensor("phase", [0.1, 0.2])
    Traceback (most recent call last):
    TypeError: phase is of type list: a tensor is needed, give torch.as_tensor(phase)
    """
    if not isinstance(values, Tensor):
        require_plain(name, values)  # a unit, or a mask over values, would be lost in a tensor
        raise TypeError(f"{name} is of type {type(values).__name__}: a tensor is needed, give torch.as_tensor({name})")


def require_real(name: str, values: Any) -> None:
    """Raise TypeError unless the values are a tensor of float32 or float64.

    >>> require_real("phase", torch.tensor([1, 2]))
    Traceback (most recent call last):
    TypeError: phase is torch.int64: float32 or float64 is needed, give phase.double()
    """
    require_tensor(name, values)
    if values.dtype not in (torch.float32, torch.float64):
        mended = f"{name}.real" if values.is_complex() else f"{name}.double()"
        raise TypeError(f"{name} is {values.dtype}: float32 or float64 is needed, give {mended}")


def require_masks(name: str, values: Tensor, masks: Sequence[int]) -> None:
    """Raise ValueError unless values (..., [frame,] N, P) broadcast against a population of masks of shape `masks`.

    The axis of the frame is there if the values have an axis more than the population.

    >>> require_masks("phase", torch.zeros(2, 5, 7, 121), (2,))
    >>> require_masks("phase", torch.zeros(3, 7, 121), (2,))
    Traceback (most recent call last):
    ValueError: phase has shape (3, 7, 121) and the population of masks (2,): the axes before the last two must be \
(2,), or (2, frames)
    """
    given, masks = tuple(values.shape[:-2]), tuple(masks)
    needed = (*masks, 1) if len(given) > len(masks) else masks
    if any(n != m and n != 1 and m != 1 for n, m in zip(reversed(given), reversed(needed), strict=False)):
        frames = f"({', '.join(map(str, masks))}, frames)"
        raise ValueError(
            f"{name} has shape {tuple(values.shape)} and the population of masks {masks}: the axes before the last two "
            f"must be {masks}, or {frames}"
        )
