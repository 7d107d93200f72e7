"""Strips around a common centre, whose intersection is a convex and point-symmetric polygon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def require_strips(name: str, strips: Sequence[tuple[float, float]]) -> None:
    """Raise ValueError unless strips (angle of the normal [rad], width) may enclose a polygon, which has this name.

    >>> require_strips("Slit", [(0.0, 1.0)])
    Traceback (most recent call last):
    ValueError: Slit has the strips [(0.0, 1.0)]: at least two (angle, width) are needed to enclose a polygon
    """
    given = f"{name} has the strips {list(strips)}"
    if len(strips) < 2:
        raise ValueError(f"{given}: at least two (angle, width) are needed to enclose a polygon")
    angles = [angle for angle, _ in strips]
    if not all(low < high for low, high in zip(angles, [*angles[1:], math.pi], strict=True)) or angles[0] < 0:
        raise ValueError(f"{given}: their angles must ascend from 0 to less than pi")
    if not all(math.isfinite(width) and width > 0 for _, width in strips):
        raise ValueError(f"{given}: their widths must be finite and positive, in diameters")


class StripArea(torch.autograd.Function):
    """Area of the intersection of concentric strips with `half_widths` (..., S) and normals at `angles` (S,).

    It is the sum of half-width times side length over the strips, and its derivative by a half-width is the length of
    the strip's two sides. Autograd would have no unique gradient where three sides meet in a corner.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(half_widths: Tensor, angles: Sequence[float]) -> Tensor:
        return (half_widths * StripArea._side(half_widths, angles)).sum(-1)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        half_widths, ctx.angles = inputs
        ctx.save_for_backward(half_widths)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None]:
        (half_widths,) = ctx.saved_tensors
        return 2 * StripArea._side(half_widths, ctx.angles) * grad[0][..., None], None

    @staticmethod
    def _side(half_widths: Tensor, angles: Sequence[float]) -> Tensor:
        """Return the length (..., S) of each of the two sides of a strip, between the edges of the other strips."""
        others = [[k for k in range(len(angles)) if k != own] for own in range(len(angles))]  # S times S - 1
        turns = [[(angles[k] - angle) % math.pi for k in row] for row, angle in zip(others, angles, strict=True)]
        cosine, sine = (
            half_widths.new_tensor([[f(turn) for turn in row] for row in turns]) for f in (math.cos, math.sin)
        )
        beyond, across = (
            half_widths[..., torch.tensor(others, device=half_widths.device)],
            half_widths[..., None] * cosine,
        )
        ends = ((beyond - across) / sine).amin(-1) + ((beyond + across) / sine).amin(-1)
        return ends.clamp(min=0)
