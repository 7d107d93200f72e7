"""What the lenses of holes with themselves, at baselines below a hole, have in common under turbulence.

All N of them lie at one baseline, so each pair of holes adds, at the frequencies below one hole, a function of the
separation of the two: products of fixed maps and of functions of the separation, which a spline knows.
"""

from __future__ import annotations

import math

import torch
from scipy.ndimage import spline_filter
from torch import Tensor

from torchmask.atmosphere.lens_coherence import shared_coherence
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.overlap import Geometry
from torchmask.design.spline_patches import cubic_basis

_STEPS = 8  # of the spline to a hole


class CentralLenses:
    """The sum over pairs of holes, for holes of one geometry under one turbulence, on baselines (P, 2) [m]."""

    def __init__(
        self,
        geometry: Geometry,
        seeing: Seeing,
        longest: float,
        baselines: Tensor,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        factors = shared_coherence(geometry.shape, geometry.diameter, seeing, longest)
        inside = baselines.norm(dim=-1) < geometry.reach
        lens = geometry.shape.otf(baselines[inside], geometry.diameter)
        maps = torch.zeros(len(factors.by_baseline.values), len(baselines), dtype=torch.float64)
        maps[:, inside] = lens**2 * factors.by_baseline(baselines[inside])
        self.maps: Tensor = maps.to(device, dtype)
        self.step: float = geometry.diameter / _STEPS
        self.half: int = math.ceil(longest / self.step) + 2
        axis = self.step * torch.arange(-self.half, self.half + 1, dtype=torch.float64)
        places = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).flatten(0, 1)
        values = factors.by_place(places).unflatten(-1, (len(axis), len(axis)))
        coefficients = torch.stack([torch.from_numpy(spline_filter(one.numpy(), order=3)) for one in values])
        self.coefficients: Tensor = coefficients.flatten(1).T.contiguous().to(device, dtype)

    def __call__(self, centers: Tensor) -> Tensor:
        """Twice the sum over pairs of holes (B, P) for masks with `centers` (B, N, 2) [m]."""
        i, j = torch.triu_indices(centers.shape[1], centers.shape[1], 1, device=centers.device)
        place = (centers[:, i] - centers[:, j]) / self.step + self.half
        last = 2 * self.half - 2
        start = place.detach().nan_to_num(0.0).floor().clamp(1, last)
        basis = cubic_basis(place - start)  # (B, pairs, 2, 4)
        index = start.long()[..., None] + torch.arange(-1, 3, device=centers.device)
        flat = index[..., 1, :, None] * (2 * self.half + 1) + index[..., 0, None, :]
        weights = basis[..., 1, :, None] * basis[..., 0, None, :]
        found = (self.coefficients[flat] * weights[..., None]).sum((1, 2, 3))
        return 2 * found @ self.maps
