"""Slopes of an image, and the scale of an object that they tell."""

from __future__ import annotations

from torch import Tensor


def rate_of_slopes(image: Tensor) -> float:
    """Return 3 sum |g| / sum |g|^2 of the gradients g of `image` (H', W'); 0 if there are none.

    It is the rate mu of gradients that are drawn from exp(-mu |g|) in some pixels, whose moments are E|g| = 2 / mu and
    E|g|^2 = 6 / mu^2, and zero in the others, however many.
    """
    dy, dx = gradient(image)
    squared = dy**2 + dx**2
    total = float(squared.sum())
    return 3 * float(squared.sqrt().sum()) / total if total > 0 else 0.0


def gradient(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the periodic forward differences of (..., H, W) along the rows' axis (dy) and the columns' axis (dx)."""
    return image.roll(-1, -2) - image, image.roll(-1, -1) - image


def divergence(dy: Tensor, dx: Tensor) -> Tensor:
    """Return the adjoint of `gradient`."""
    return dy.roll(1, -2) - dy + dx.roll(1, -1) - dx
