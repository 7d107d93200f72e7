"""Slopes of an image, and the scale of an object that they tell."""

from __future__ import annotations

from torch import Tensor

from torchmask.restoration.change import Change
from torchmask.restoration.schedule import Schedule

_GENTLE = 0.4  # rate above which slopes are gentle: faint frames find 0.10 to 0.23 for satellites, 0.46 on for balls
_GENTLE_AT_END = 0.53  # after a last descent: it leaves up to 0.47 of satellites, 0.59 on of asteroids and balls
_LIGHT = 40.0  # change of all frames, in noise variances, from which on the rate of gentle slopes is at least 1
_LEAST = 2.0  # the highest least rate: up to 8 tried
_SHOWN = 2048.0  # chi-square of a frame beyond noise below which it is the prior that has made slopes gentle
_SMALLEST = 0.25  # the smallest factor by which they are taken to be steeper then: down to 0.125 tried


def rate_of_slopes(image: Tensor) -> float:
    """Return 3 sum |g| / sum |g|^2 of the gradients g of `image` (H', W'); 0 if there are none.

    It is the rate mu of gradients that are drawn from exp(-mu |g|) in some pixels, whose moments are E|g| = 2 / mu and
    E|g|^2 = 6 / mu^2, and zero in the others, however many.
    """
    dy, dx = gradient(image)
    squared = dy**2 + dx**2
    total = float(squared.sum())
    return 3 * float(squared.sqrt().sum()) / total if total > 0 else 0.0


def rate_in_noise(image: Tensor, change: Change) -> float:
    """Return the rate of slopes of an object (H', W') that was restored together with uncertain aberrations.

    These bend to the noise of their frames, and an object that follows it has slopes that are steeper than the true
    ones. What the fit gains by that grows with the light, so from a light of 40 on gentle slopes have at least the rate
    light / 40, up to 2: those of a rate above 0.4, or 0.53 where a last descent has found them. Where frames change by
    hardly more than their noise, on the other hand, the prior has smoothed what it has found, and would smooth it the
    more: below a chi-square of 2048 beyond noise, in a frame, the rate falls in proportion, down to a quarter. A single
    frame does not tell. The limits are empirical.
    """
    rate, least = rate_of_slopes(image), min(change.light / _LIGHT, _LEAST)
    gentle = _GENTLE if change.each < Schedule.faint else _GENTLE_AT_END  # from there on a last descent goes before
    shown = change.beyond_noise / _SHOWN if change.n_frames > 1 else 1.0
    if shown < 1:
        return rate * max(shown, _SMALLEST)
    return max(rate, least) if rate > gentle and least > 1 else rate


def gradient(image: Tensor) -> tuple[Tensor, Tensor]:
    """Return the periodic forward differences of (..., H, W) along the rows' axis (dy) and the columns' axis (dx)."""
    return image.roll(-1, -2) - image, image.roll(-1, -1) - image


def divergence(dy: Tensor, dx: Tensor) -> Tensor:
    """Return the adjoint of `gradient`."""
    return dy.roll(1, -2) - dy + dx.roll(1, -1) - dx
