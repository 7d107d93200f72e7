"""Raster of a search for companions of a star, and its detection limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.record import Brief

SIGNIFICANCE = 5.0  # in units of the scatter without a companion, above which a companion counts as detected
# times a limit: the contrast at which chance takes the significance below it in a tenth of all cases
MOSTLY = 1 + 1.2816 / SIGNIFICANCE
_ANNULUS, _REACH = 0.1, 0.025  # [arcsec] width of an annulus, and margin around it in which scatter is measured


def search_offsets(step: float, least: float = 0.1, most: float = 0.7) -> Tensor:
    """Return offsets (M, 2), (east, north) [rad], on a square raster between two separations.

    Parameters
    ----------
    step : float
        Step of the raster [arcsec].
    least, most : float
        Smallest and largest separation [arcsec].

    Examples
    --------
    >>> offsets = search_offsets(0.1, least=0.05, most=0.25)
    >>> offsets.shape, bool((offsets.norm(dim=1) < 0.25 * ARCSEC).all())
    (torch.Size([20, 2]), True)
    """
    n = math.ceil(most / step)
    line = torch.arange(-n, n + 1, dtype=torch.float64) * step * ARCSEC
    grid = torch.cartesian_prod(line, line)
    separation = torch.linalg.vector_norm(grid, dim=1) / ARCSEC
    return grid[(separation > least) & (separation < most)]


@dataclass(frozen=True, eq=False, repr=False)
class DetectionLimits(Brief):
    """Contrast of the faintest detectable companion in annuli around the star.

    A companion as bright as the limit is found about half of the time, and one of `MOSTLY` times that in nine of ten.

    separation : (A,) middle of each annulus [arcsec]
    contrast : (A,) limiting flux over that of the star
    errors : (A,) standard error of each contrast

    Examples
    --------
    >>> limits = DetectionLimits(np.array([0.1, 0.3]), np.array([0.02, 0.01]), np.array([0.002, 0.001]))
    >>> round(float(limits(torch.tensor([0.2 * ARCSEC, 0.0]))), 6)
    0.015
    """

    separation: np.ndarray
    contrast: np.ndarray
    errors: np.ndarray

    def __call__(self, offsets: Tensor) -> Tensor:
        """Return the limiting contrast at offsets (..., 2) [rad], interpolated linearly between annuli."""
        away = torch.linalg.vector_norm(offsets, dim=-1) / ARCSEC
        return torch.as_tensor(np.interp(away.numpy(), self.separation, self.contrast))


def detection_limits(offsets: Tensor, contrast: Tensor) -> DetectionLimits:
    """Return `SIGNIFICANCE` times the rms contrast in each annulus around a star without companion.

    Parameters
    ----------
    offsets : (M, 2) tensor
        Offsets [rad], from 0.1 arcsec on, with steps no larger than the width of the annuli, 0.1 arcsec.
    contrast : (M,) tensor
        Contrast that `search_companions` gives there for a single star.

    Returns
    -------
    DetectionLimits
        The error of a limit is that of an rms of n independent values, with n the number of squares as wide as the
        annulus that fit into it.

    Examples
    --------
    >>> offsets = search_offsets(0.05)
    >>> limits = detection_limits(offsets, torch.full((len(offsets),), 1e-3, dtype=torch.float64))
    >>> limits.separation.round(2), limits.contrast.round(4)
    (array([0.15, 0.25, 0.35, 0.45, 0.55, 0.65]), array([0.005, 0.005, 0.005, 0.005, 0.005, 0.005]))
    """
    away = torch.linalg.vector_norm(offsets, dim=1) / ARCSEC
    edges = torch.arange(_ANNULUS, float(away.max()) + _ANNULUS / 2, _ANNULUS, dtype=torch.float64)
    rings = [(away >= low - _REACH) & (away < low + _ANNULUS + _REACH) for low in edges[:-1]]
    rms = [SIGNIFICANCE * float(contrast[ring].square().mean().sqrt()) for ring in rings]
    middles = (edges[:-1] + _ANNULUS / 2).numpy()
    independent = 2 * math.pi * middles / _ANNULUS  # squares as wide as the annulus
    return DetectionLimits(middles, np.array(rms), np.array(rms) / np.sqrt(2 * independent))
