"""Slopes of an image, and the scale of an object that they tell."""

from __future__ import annotations

from torch import Tensor

from torchmask.restoration.change import Change

_LIGHT = 40.0  # light from which on the rate of gentle slopes is at least 1
_MOST = 2.0  # the highest least rate: up to 8 tried
_SHOWN = 2048.0  # chi-square of a frame beyond noise below which it is the prior that has made slopes gentle
_SMALLEST = 0.25  # the smallest factor by which they are taken to be steeper then: down to 0.125 tried
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


def rate_in_noise(image: Tensor, change: Change, *, gentle: bool) -> float:
    """Return the rate of slopes of an object (H', W') that was restored together with uncertain aberrations.

    These bend to the noise of their frames, and an object that follows it has slopes that are steeper than the true
    ones. What the fit gains by that grows with the light, so from a light of 40 on slopes that are `gentle` have at
    least the rate light / 40, up to 2. Where frames change by hardly more than their noise, on the other hand, the
    prior has smoothed what it has found, and would smooth it the more: below a chi-square of 2048 beyond noise, in a
    frame, the rate falls in proportion, down to a quarter. A single frame does not tell. The limits are empirical.
    """
    rate = rate_of_slopes(image)
    if change.n_frames > 1 and (part := shown(change)) < 1:
        return rate * max(part, _SMALLEST)
    return max(rate, rate_in_light(change)) if gentle and change.light > _LIGHT else rate


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


def shown(change: Change) -> float:
    """Return how much frames show beyond noise; below 1 it is too little to tell slopes."""
    return change.beyond_noise / _SHOWN


def gradient(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the periodic forward differences of (..., H, W) along the rows' axis (dy) and the columns' axis (dx)."""
    return image.roll(-1, -2) - image, image.roll(-1, -1) - image


def divergence(dy: Tensor, dx: Tensor) -> Tensor:
    """Return the adjoint of `gradient`."""
    return dy.roll(1, -2) - dy + dx.roll(1, -1) - dx
