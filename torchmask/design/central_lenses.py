"""Coherence under turbulence of the lenses of holes with themselves, at baselines shorter than a hole.

All N of them lie at one baseline, so each pair of holes adds, at the frequencies below one hole, a function of the
separation of the two: products of fixed maps and of functions of the separation, which a spline knows.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.atmosphere.lens_coherence import shared_coherence
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.overlap import Geometry
from torchmask.design.spline_table import SplineTable
from torchmask.optics.band import Band

_STEPS = 8  # of the spline to a hole


class CentralLenses:
    """The sum over pairs of holes, for holes of one geometry under one turbulence, on baselines (P, 2) [m]."""

    def __init__(
        self,
        geometry: Geometry,
        seeing: Seeing,
        band: Band,
        reference: float,
        longest: float,
        baselines: Tensor,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        factors = shared_coherence(geometry.shape, geometry.diameter, seeing, longest)
        scales = [reference / wavelength for wavelength in band.wavelengths]
        inside = baselines.norm(dim=-1) < geometry.reach * max(scales)
        lens = sum(
            share * geometry.shape.otf(baselines[inside] / scale, geometry.diameter)
            for scale, share in zip(scales, band.shares, strict=True)
        )
        maps = torch.zeros(len(factors.by_baseline.values), len(baselines), dtype=torch.float64)
        maps[:, inside] = lens**2 * factors.by_baseline(baselines[inside])
        self.maps: Tensor = maps.to(device, dtype)
        self.table: SplineTable = SplineTable(factors.by_place, longest, geometry.diameter / _STEPS, dtype, device)

    def __call__(self, centers: Tensor) -> Tensor:
        """Return twice the sum over pairs of holes (B, P) for masks with `centers` (B, N, 2) [m]."""
        i, j = torch.triu_indices(centers.shape[1], centers.shape[1], 1, device=centers.device)
        return 2 * self.table(centers[:, i] - centers[:, j]).sum(1) @ self.maps
