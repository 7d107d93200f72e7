"""The background of the frames: light that no object sends, the same in every pixel of a frame."""

from __future__ import annotations

import math
from enum import Enum

import torch
from torch import Tensor

_PRICE = 0.1  # against the weight 1 of total variation: see docs/restoration.md
_BLOCKS = 8  # along each side of the field, in which its darkest part is looked for
_SEEN = 0.1  # of the mean light, in the darkest part: holes scatter up to 0.06 there, see docs/restoration.md


class Background(Enum):
    """What a restoration assumes of the background where it is not given.

    A constant that is free in every frame costs no variable: whatever the object, the constant that fits best is the
    weighted mean of what the object leaves, or zero if that is negative, and the misfit is what is left beside it.

    An even level of the object looks the same in the frames. So the object pays a small price for its light, which
    moves such a level to the background as far as the object stays positive: one that is nowhere dark loses the light
    of its darkest part.

    Where the darkest part of the field holds no more than what optics scatter there, nothing is lost without a sky, and
    the descent is shorter. `IF_SEEN` decides by that.

    Examples
    --------
    >>> difference = torch.tensor([[[3.0, 5.0]], [[-1.0, -2.0]]])
    >>> Background.PER_FRAME.level(difference, torch.tensor([[[1.0, 3.0]]])).flatten().tolist()
    [4.5, 0.0]
    """

    NONE = "none"
    PER_FRAME = "one constant for each frame, not negative"
    IF_SEEN = "one constant for each frame, if the darkest part of the field shows a sky"

    def of(self, frames: Tensor) -> Background:
        """What is free once the frames (T, H, W) are there, whose own light alone decides: `NONE` or `PER_FRAME`."""
        if self is not Background.IF_SEEN:
            return self
        is_seen = float(darkest_level(frames).mean()) > _SEEN * float(frames.mean())
        return Background.PER_FRAME if is_seen else Background.NONE

    @property
    def price(self) -> float:
        """Of an object's light, per mean pixel, in the cost of a restoration."""
        return 0.0 if self is Background.NONE else _PRICE

    def level(self, difference: Tensor, precision: Tensor) -> Tensor:
        """The background (T, 1, 1) nearest to `difference` (T, H, W), whose pixels count with `precision`."""
        if self is Background.NONE:
            return torch.zeros_like(difference[:, :1, :1])
        return weighted_mean(difference, precision).clamp(min=0)

    def residual(self, difference: Tensor, precision: Tensor) -> Tensor:
        """`difference` (T, H, W) without the background nearest to it."""
        return difference if self is Background.NONE else difference - self.level(difference, precision)

    def first_guess(self, frames: Tensor) -> Tensor:
        """The background (T, 1, 1) of frames (T, H, W) before anything is known of their object."""
        return torch.zeros_like(frames[:, :1, :1]) if self is Background.NONE else darkest_level(frames).clamp(min=0)


def weighted_mean(values: Tensor, precision: Tensor) -> Tensor:
    """The mean (T, 1, 1) of values (T, H, W) that count with `precision`; 0 where none counts."""
    if precision.shape[-2:] == (1, 1):
        return values.mean((1, 2), keepdim=True)
    least = torch.finfo(precision.dtype).tiny
    return (precision * values).sum((1, 2), keepdim=True) / precision.sum((1, 2), keepdim=True).clamp(min=least)


def darkest_level(frames: Tensor) -> Tensor:
    """The level (T, 1, 1) of frames (T, H, W) in the part of the field that is darkest on average over all of them.

    It holds the background and what light of the object is scattered there.

    Examples
    --------
    >>> frames = torch.full((2, 32, 32), 7.0); frames[:, 4:28, 4:28] = 100.0
    >>> darkest_level(frames).flatten().tolist()
    [7.0, 7.0]
    """
    size = [math.ceil(side / _BLOCKS) for side in frames.shape[-2:]]
    means = torch.nn.functional.avg_pool2d(frames[:, None], size, ceil_mode=True)[:, 0]
    return means.flatten(1)[:, means.mean(0).argmin()][:, None, None]


def check_known_level(level: float | Tensor, frames: Tensor) -> Tensor:
    """A background that is given [electrons] as (T, H, W), for frames of that shape.

    Raises ValueError if it is not finite, negative, or does not broadcast to the frames.
    """
    given = torch.as_tensor(level, dtype=frames.dtype, device=frames.device)
    if not bool(torch.isfinite(given).all()):
        raise ValueError("background holds values that are not finite: electrons per pixel are needed")
    if bool((given < 0).any()):
        raise ValueError(
            f"background is negative ({float(given.min()):.3g} electrons per pixel), and light is not: if too much was "
            "subtracted from the frames, add it to them"
        )
    try:
        return given.expand_as(frames)
    except RuntimeError:
        raise ValueError(
            f"background has shape {tuple(given.shape)}: a number, or what broadcasts to the frames "
            f"{tuple(frames.shape)}, is needed; one number for each frame has shape ({len(frames)}, 1, 1)"
        ) from None
