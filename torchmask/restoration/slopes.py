"""Slopes of an image, and the scale of an object that they tell."""

from __future__ import annotations

from torch import Tensor

from torchmask.restoration.change import Change

_LIGHT = 40.0  # light from which on the rate of gentle slopes is at least 1
_MOST = 2.0  # the highest least rate: up to 8 tried
_BENT = 3.0  # factor on the rate of gentle slopes if aberrations are unknown: 1 to 10 tried
_BENT_MOST, _BENT_MOST_FULL = 2.0, 3.0  # what it leads to at most, for a mask and for a full pupil: up to 10 tried


def rate_of_slopes(image: Tensor) -> float:
    """Return 3 sum |g| / sum |g|^2 of the gradients g of `image` (H', W'); 0 if there are none.

    It is the rate mu of gradients that are drawn from exp(-mu |g|) in some pixels, whose moments are E|g| = 2 / mu and
    E|g|^2 = 6 / mu^2, and zero in the others, however many.
    """
    dy, dx = gradient(image)
    squared = dy**2 + dx**2
    total = float(squared.sum())
    return 3 * float(squared.sqrt().sum()) / total if total > 0 else 0.0


def rate_of_descent(rate: float, *, full: bool) -> float:
    """Return the rate that the prior of a last descent suits for slopes of this `rate`.

    Aberrations that are unknown bend to what an object shows of the noise, from which a heavier prior keeps it. So
    gentle slopes, whose rate is above a third, have three times that rate, but no more than 2, or 3 for a `full` pupil.
    The numbers are empirical.
    """
    heavier = min(_BENT * rate, _BENT_MOST_FULL if full else _BENT_MOST)
    return max(rate, heavier) if heavier > 1 else rate


def rate_in_light(change: Change) -> float:
    """Return the least rate of gentle slopes in this much light: light / 40, from 1 to 2."""
    return min(max(change.light / _LIGHT, 1.0), _MOST)


def gradient(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the periodic forward differences of (..., H, W) along the rows' axis (dy) and the columns' axis (dx)."""
    return image.roll(-1, -2) - image, image.roll(-1, -1) - image


def divergence(dy: Tensor, dx: Tensor) -> Tensor:
    """Return the adjoint of `gradient`."""
    return dy.roll(1, -2) - dy + dx.roll(1, -1) - dx
