"""Pixels that hold what no optics can make: cosmic rays, hot and dead pixels that nobody has marked.

An aperture transmits nothing beyond its cut-off frequency, so all that frames hold there is noise. A single pixel that
is brighter or darker by A than it should be has the same power at all frequencies: beyond the cut-off it stands out by
A times the share of the plane that lies there, whatever the object. Hits of several pixels stand out beside them, too.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.fading import beyond_faded, fading
from torchmask.optics.noise import FEWEST, fill_with_least_power

_CHANCE = 0.001  # of finding one in frames without any
_ROUNDS = 30  # in each, spikes that stand beside brighter ones come to light
_BESIDE = 0.5  # of the largest spike of a frame: smaller ones may be its side lobes
_NEAR = 2  # pixels on either side, among which only the largest spike of a round counts
_GROWN = 1  # pixels on either side that are left out with a spike, as few hits keep to one
_AROUND = 7  # the same among which the noise is alike
_UNEVEN = 0.02  # error of the flat, and of what is left of borders, over the light
_MOST = 0.05  # of all pixels: if there are more, what is beyond the cut-off is light after all
_MEDIAN = 0.4549  # of the square of a normal deviate, over its mean


def find_spikes(frames: Tensor, valid: Tensor, grid: Grid, aperture: Aperture) -> Tensor:
    """Return which valid pixels of `frames` (T, H, W) [electrons] are spikes or their neighbours, (T, H, W) bool.

    Pixels that are not `valid` (T, H, W) must hold finite values. A pixel is a spike if normal noise would reach what
    it holds beyond the cut-off in one of a thousand stacks at most. The variance of the noise is measured there, and is
    at least that of the photons that the pixel itself and its neighbours hold, so that few photons make no spike. Near
    the border, in a twelfth of the frame's side, there are none. Nor are there any if more than a twentieth of all
    pixels would be, as in an image that no optics have blurred, or if fewer than eight frequencies lie beyond the
    cut-off.
    """
    found = torch.zeros_like(valid)
    beyond = beyond_faded(grid, aperture, frames)
    if int(beyond.sum()) < FEWEST:
        return found
    share = float(beyond.double().mean())
    window = fading(frames)  # so that what is cut off at the border makes no spike
    tapered, asked = frames * window, valid & (window > 0.5)
    footprint = torch.fft.rfft2(torch.fft.ifft2(beyond.to(frames)).real ** 2)
    half = beyond[:, : footprint.shape[1]]

    def reaching(variance: Tensor) -> Tensor:
        """Return what noise of this variance in the pixels has beyond the cut-off."""
        return torch.fft.irfft2(torch.fft.rfft2(variance) * footprint, s=frames.shape[1:]).clamp(min=0)

    photons, uneven = reaching(tapered.clamp(min=0) * window), reaching((_UNEVEN * frames) ** 2)
    log_odds = math.log(2 * frames.numel() / _CHANCE)
    for _ in range(_ROUNDS):
        counts, known = asked & ~found, valid & ~found
        spoilt, seen = ~known.all(2).all(1), tapered
        if bool(spoilt.any()):
            seen = tapered.clone()
            seen[spoilt] = fill_with_least_power(tapered[spoilt], known[spoilt], beyond)
        residual = torch.fft.irfft2(torch.fft.rfft2(seen) * half, s=frames.shape[1:])
        residual = torch.where(known, residual, 0.0)
        square = residual**2
        least = torch.addcmul(uneven, _per_electron(frames, square / share, counts), photons)
        limit = (2 * log_odds * torch.maximum(_spread(square, counts), least)).sqrt()
        more = counts & _peaks(residual, limit)  # a dark pixel has bright side lobes, by which it is found
        if not bool(more.any()):
            break
        found = found | (valid & (_largest(more.to(frames), _GROWN) > 0))
        if int(found.sum()) > max((2 * _GROWN + 1) ** 2, _MOST * int(valid.sum())):
            return torch.zeros_like(valid)
    return found


def _largest(values: Tensor, near: int) -> Tensor:
    """Return the largest of values (T, H, W) among `near` pixels on either side."""
    return max_pool2d(values[:, None], 2 * near + 1, 1, near)[:, 0]


def _peaks(residual: Tensor, limit: Tensor) -> Tensor:
    """Return where frames (T, H, W) have their largest values beyond the limit, each alone in its surroundings."""
    is_large = residual >= _BESIDE * residual.amax((1, 2), keepdim=True)
    return (residual == _largest(residual, _NEAR)) & is_large & (residual > limit)


def _spread(square: Tensor, valid: Tensor) -> Tensor:
    """Return the variance (H, W) of normal deviates around each pixel, by the median of their squares (T, H, W)."""
    known = torch.where(valid, square, math.nan)
    # of an even number, midway between the two in the middle
    known = (known.nanmedian(0).values - (-known).nanmedian(0).values) / 2
    known = torch.where(known.isnan(), known.nanmedian(), known)
    near = [min(_AROUND, side - 1) for side in known.shape]
    around = pad(known[None], (near[1], near[1], near[0], near[0]), mode="reflect")[0]
    for axis in (0, 1):  # one after the other, which needs less memory than both at once
        around = around.unfold(axis, 2 * near[axis] + 1, 1).median(-1).values
    return torch.maximum(around, known.median()) / _MEDIAN


def _per_electron(frames: Tensor, square: Tensor, valid: Tensor) -> Tensor:
    """Return the variance of the noise over the light, at most 1: less if frames are not in electrons."""
    n = valid.sum((1, 2)).clamp(min=1)
    variance, light = ((((part * valid).sum((1, 2)) / n).median()) for part in (square, frames))
    return torch.where(light > 0, variance / light, 0.0).clamp(0, 1)
