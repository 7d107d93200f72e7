"""Geometry of a mask from the power of a star's fringes, which does not depend on the pistons of turbulence."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.geometry import MaskGeometry

_FINENESS = 4  # oversampling of the frequencies relative to those of the frames
_TURNS = 181  # number of rotations tried over 180 degrees: the other half looks the same
_SCALES = (0.95, 0.96, 0.97, 0.98, 0.99, 1.0, 1.01, 1.02, 1.03, 1.04, 1.05)
_ALIKE = 0.05  # difference in the mean logarithm of the power below which the smaller rotation is preferred


class FirstLook(NamedTuple):
    """The geometry, to about a degree and a percent, and whether a mirrored mask would look different."""

    geometry: MaskGeometry
    mirror_seen: bool


def mean_power(frames: Tensor, centers: Tensor, grid: Grid) -> Tensor:
    """Return the power |DFT|^2, averaged over frames (T, H, W), at the B baselines of `centers` (..., N, 2) [m]."""
    fine = tuple(_FINENESS * side for side in frames.shape[-2:])
    power = (torch.fft.fft2(frames, s=fine).abs() ** 2).mean(0)
    power = torch.cat([power, power[:1]])
    power = torch.cat([power, power[:, :1]], 1)  # periodic, with the seam on both sides
    n = centers.shape[-2]
    i, j = torch.triu_indices(n, n, 1).unbind()
    nu = (centers[..., i, :] - centers[..., j, :]) / grid.period
    places = 2 * (nu - nu.floor()) - 1  # (x, y) in [-1, 1], the convention of grid_sample
    places = places.reshape(1, -1, 1, 2).to(power)
    sampled = torch.nn.functional.grid_sample(power[None, None], places, align_corners=True)
    return sampled.flatten().view(nu.shape[:-1])


def first_look(frames: Tensor, centers: Tensor, grid: Grid) -> FirstLook:
    """Return rotation, mirror and magnification with the most power at the baselines in a star's frames (T, H, W).

    Among geometries that explain the power equally well, as for a symmetric mask, it is the one nearest to the given.
    """
    turns = [math.pi * (k / (_TURNS - 1) - 0.5) for k in range(_TURNS)]
    tried = [
        MaskGeometry(turn, scale, scale, mirrored=mirrored)
        for mirrored in (False, True)
        for scale in _SCALES
        for turn in sorted(turns, key=abs)
    ]
    moved = torch.stack([centers @ geometry.matrix.to(centers).T for geometry in tried])
    power = mean_power(frames, moved, grid)
    scores = power.clamp(min=torch.finfo(power.dtype).tiny).log().mean(-1)
    good = (scores > scores.max() - _ALIKE).nonzero().flatten().tolist()
    mirrors = {tried[index].mirrored for index in good}
    mirrored = mirrors == {True}
    nearest = min(abs(tried[index].rotation) for index in good if tried[index].mirrored == mirrored)
    close = [
        index
        for index in good
        if tried[index].mirrored == mirrored and abs(tried[index].rotation) <= nearest + math.radians(5)
    ]
    best = max(close, key=lambda index: float(scores[index]))
    return FirstLook(tried[best], len(mirrors) == 1)
