"""The background of the frames, uniform light that does not come from the object."""

from __future__ import annotations

import math
from enum import Enum

import torch
from torch import Tensor

from torchmask.io import as_tensor

_PRICE = 1.0  # relative to a weight of 1 of total variation, see docs/tried.md
_BLOCKS = 8  # blocks along each side of the field, of which the darkest is sought
_SEEN = 0.1  # of the mean light in the darkest part, where holes scatter up to 0.06, see docs/tried.md
_FILLS = 0.43  # of the mean light above the darkest part: halos leave up to 0.38 at the border, see docs/tried.md
_SURE = 5.0  # standard deviations of a part's noise: by chance the darkest of 64 parts is 2.4 below the mean


class Background(Enum):
    """Assumption of a restoration about a background that is not given.

    A free constant needs no variable, whether every frame has its own or all have the same: for any object, the best
    constant is the weighted mean of the residual, or zero if that is negative. One constant for all frames takes half
    as long again, since it must be known before the gradient of any frame.

    A uniform level of the object looks the same as a background. A small penalty on the object's light therefore moves
    such a level to the background, as far as the object stays positive: an object that is nowhere dark loses the light
    of its darkest part.

    If the darkest part of the field has no more light than the optics scatter there, the fit does not need a sky and is
    quicker without one. If most of the border is nearly as bright as the rest, the object extends beyond the field, and
    what is even in its light is its own: a sky cannot be told from it. `IF_SEEN` makes this decision.

    Examples
    --------
    >>> difference = torch.tensor([[[3.0, 5.0]], [[-1.0, -2.0]]])
    >>> precision = torch.tensor([[[1.0, 3.0]]])
    >>> Background.PER_FRAME.level(difference, precision).flatten().tolist()
    [4.5, 0.0]
    >>> Background.COMMON.level(difference, precision).flatten().tolist()
    [1.375, 1.375]
    """

    NONE = "none"
    PER_FRAME = "one constant for each frame, not negative"
    COMMON = "one constant for all frames, not negative"
    IF_SEEN = "one constant for each frame, if the darkest part of the field shows a sky and the border no object"

    def of(self, frames: Tensor, fills: bool) -> Background:
        """Return the assumption for frames (T, H, W), never `IF_SEEN`, which becomes `NONE` or `PER_FRAME`.

        `fills` says whether their object extends beyond the field, see `fills_field`.
        """
        if self is not Background.IF_SEEN:
            return self
        is_seen = float(darkest_level(frames).mean()) > _SEEN * float(frames.mean())
        return Background.PER_FRAME if is_seen and not fills else Background.NONE

    @property
    def price(self) -> float:
        """Penalty on the object's light, per mean pixel, in the cost of a restoration."""
        return 0.0 if self is Background.NONE else _PRICE

    def level(self, difference: Tensor, precision: Tensor, unit: Tensor | float = 1.0) -> Tensor:
        """Return the background (T, 1, 1) that fits `difference` (T, H, W) best, weighted by `precision`.

        `unit` (T, 1, 1) is what a background of 1 amounts to in each frame; it matters for `COMMON` only.
        """
        if self is Background.NONE:
            return torch.zeros_like(difference[:, :1, :1])
        if self is Background.PER_FRAME:
            return weighted_mean(difference, precision).clamp(min=0)
        units = unit * torch.ones_like(difference[:, :1, :1])
        weight = precision.expand_as(difference) * units
        total = (weight * units).sum().clamp(min=torch.finfo(weight.dtype).tiny)
        return ((weight * difference).sum() / total).clamp(min=0) * units

    def residual(self, difference: Tensor, precision: Tensor, unit: Tensor | float = 1.0) -> Tensor:
        """Return `difference` (T, H, W) minus the background that fits it best; arguments as for `level`."""
        return difference if self is Background.NONE else difference - self.level(difference, precision, unit)

    def first_guess(self, frames: Tensor) -> Tensor:
        """Return an estimate of the background (T, 1, 1) of frames (T, H, W) before their object is known."""
        if self is Background.NONE:
            return torch.zeros_like(frames[:, :1, :1])
        darkest = darkest_level(frames)
        darkest = darkest.mean(0, keepdim=True).expand_as(darkest) if self is Background.COMMON else darkest
        return darkest.clamp(min=0)


def weighted_mean(values: Tensor, precision: Tensor) -> Tensor:
    """Return the mean (T, 1, 1) of values (T, H, W) weighted by `precision`; 0 where all weights are 0."""
    if precision.shape[-2:] == (1, 1):
        return values.mean((1, 2), keepdim=True)
    least = torch.finfo(precision.dtype).tiny
    return (precision * values).sum((1, 2), keepdim=True) / precision.sum((1, 2), keepdim=True).clamp(min=least)


def darkest_level(frames: Tensor) -> Tensor:
    """Return the level (T, 1, 1) of frames (T, H, W) in the part of the field that is darkest in their mean.

    It includes the background and light that the object scatters there.

    Examples
    --------
    >>> frames = torch.full((2, 32, 32), 7.0); frames[:, 4:28, 4:28] = 100.0
    >>> darkest_level(frames).flatten().tolist()
    [7.0, 7.0]
    """
    size = [math.ceil(side / _BLOCKS) for side in frames.shape[-2:]]
    means = torch.nn.functional.avg_pool2d(frames[:, None], size, ceil_mode=True)[:, 0]
    return means.flatten(1)[:, means.mean(0).argmin()][:, None, None]


def fills_field(frames: Tensor, valid: Tensor, variance: float) -> bool:
    """Return whether the object of frames (T, H, W) extends beyond the field, since most of the border shows it.

    `valid` (T, H, W) bool is False where a pixel tells nothing, and `variance` is the noise of a pixel. A median, as a
    star at the border makes a part of it bright, and not most.
    """
    light = frames.mean(0) - darkest_level(frames).mean()
    border = valid.any(0)
    border[1:-1, 1:-1] = False
    part = math.prod(math.ceil(side / _BLOCKS) for side in light.shape)
    noise = math.sqrt(variance / (part * len(frames)))
    if not bool(border.any()) or float(light.mean()) < _SURE * noise:
        return False
    return float(light[border].median()) > _FILLS * float(light.mean())


def check_known_level(level: float | Tensor, frames: Tensor) -> Tensor:
    """Expand a known background [electrons] to the shape of the frames (T, H, W).

    Raises ValueError if it is text, is not finite, is negative, or does not broadcast to the frames.
    """
    if isinstance(level, str):
        raise ValueError(
            f"background is {level!r}: electrons per pixel are needed, or an assumption such as Background.COMMON"
        )
    given = as_tensor(level, frames.device, frames.dtype)
    if not bool(torch.isfinite(given).all()):
        raise ValueError("background holds values that are not finite: electrons per pixel are needed")
    if bool((given < 0).any()):
        raise ValueError(
            f"background is negative ({float(given.min()):.3g} electrons per pixel), which light cannot be: if too "
            "much was subtracted from the frames, add it back"
        )
    try:
        return given.expand_as(frames)
    except RuntimeError:
        raise ValueError(
            f"background has shape {tuple(given.shape)}: a number, or a tensor that broadcasts to the frames "
            f"{tuple(frames.shape)}, is needed; one number for each frame has shape ({len(frames)}, 1, 1)"
        ) from None
