"""E|OTF|^2 of masks under turbulence on the frequency plane, differentiable in the places of the holes.

At a frequency near the baseline of two holes the pupil overlaps its copy in one lens, midway between the holes.
E|OTF|^2 is the sum over all pairs of lenses of the coherence between them: of each lens with itself, which depends on
the frequency and the distance from the baseline and is a sum of products of both
(`torchmask.atmosphere.lens_coherence`), and of lenses of different pairs of holes whose baselines nearly agree
(`torchmask.design.lens_pairs`, `torchmask.design.central_lenses`).
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.atmosphere.lens_coherence import lens_coherence
from torchmask.atmosphere.seeing import Seeing
from torchmask.design.central_lenses import CentralLenses
from torchmask.design.lens_pairs import Lenses, LensPairs
from torchmask.design.overlap import Geometry, PatchPlan, cached_plan
from torchmask.design.spline_patches import SplinePatches

_CHUNK = 2**22  # numbers of patches in work at a time: few enough for memory, enough to amortise launches


class MaskTransfer:
    """E|OTF|^2 of any masks with the holes of one geometry, on one grid, under one turbulence.

    Its tables take a second to make, and hold for any number and places of holes.
    """

    geometry: Geometry
    seeing: Seeing

    def __init__(
        self, geometry: Geometry, seeing: Seeing, longest: float, dtype: torch.dtype, device: torch.device
    ) -> None:
        self.geometry, self.seeing = geometry, seeing
        plan = cached_plan(geometry, 1, dtype, device)
        sides = geometry.grid[1], geometry.grid[0]
        self.pixel: Tensor = torch.tensor([geometry.period / side for side in sides], dtype=torch.float64)
        self.splines: SplinePatches = SplinePatches(
            (float(plan.reach[0]), float(plan.reach[1])), (len(plan.column), len(plan.row))
        )
        coherence = lens_coherence(geometry.shape, geometry.diameter, seeing, longest)
        x, y = self.splines.lattice()
        places = torch.stack(torch.meshgrid(x * self.pixel[0], y * self.pixel[1], indexing="xy"), -1)
        lens = geometry.shape.otf(places, geometry.diameter)
        by_place = coherence.by_place(places.flatten(0, 1)).unflatten(-1, lens.shape)
        self.rank: int = len(by_place)
        self.squares: Tensor = self.splines.slices(lens**2 * by_place).to(device, dtype)
        self.lenses: Tensor = self.splines.slices(lens[None]).to(device, dtype)
        baselines = half_plane(geometry)
        self.by_baseline: Tensor = coherence.by_baseline(baselines).to(device, dtype)
        self.pairs: LensPairs = LensPairs(geometry, seeing, longest, self.pixel.to(device, dtype))
        self.central: CentralLenses = CentralLenses(geometry, seeing, longest, baselines, dtype, device)
        self.far: Tensor = self.pairs.far(baselines.to(device)).to(dtype)

    def __call__(self, centers: Tensor) -> Tensor:
        """N^2 E|OTF|^2 (B, H // 2 + 1, W) of masks with `centers` (B, N, 2) [m]."""
        n = centers.shape[1]
        plan = cached_plan(self.geometry, n, centers.dtype, centers.device)
        pixels = len(plan.first) * len(plan.row) * len(plan.column) * (self.rank + 4)
        parts = [self._transfer(chunk, plan) for chunk in centers.split(max(1, _CHUNK // pixels))]
        return torch.cat(parts).unflatten(1, (-1, self.geometry.grid[1]))

    def _transfer(self, centers: Tensor, plan: PatchPlan) -> Tensor:
        n, size = centers.shape[1], (len(plan.row), len(plan.column))
        first, second = (centers.index_select(1, index) for index in (plan.first, plan.second))
        nu = (first - second) / self.geometry.period
        nu = nu - nu.detach().round()
        sign = torch.copysign(plan.one, nu[..., 1:]).detach()
        baseline = nu * sign * plan.size  # [pixels], of the two opposite ones that with nu_y >= 0
        corner = (baseline.detach() - plan.reach).ceil()
        weights = self.splines.weights(corner - baseline)
        multiplicity = torch.ones_like(baseline[:1, :, 0])
        multiplicity[:, 0] = n / 2  # every patch counts twice in the end, at nu and at -nu
        own = (weights * multiplicity[..., None]) @ self.squares
        own = own.unflatten(-1, (self.rank, -1)).transpose(1, 2).flatten(2)  # (B, R, pairs rows columns)
        index = patch_index(corner, plan)
        plane = own.new_zeros(len(centers), self.rank, plan.n_plane)
        plane = plane.scatter_add(2, index.flatten(1)[:, None].expand(own.shape), own)
        found = (folded(plane, plan) * self.by_baseline).sum(1) + self.central(centers)

        lenses = Lenses((weights @ self.lenses).unflatten(-1, size), baseline, corner, sign, (first + second) / 2)
        pairs = self.pairs(lenses, centers, plan)
        if pairs is None:
            return found
        mask, corners, values = pairs
        flat = patch_index(corners, plan) + mask[:, None, None] * plan.n_plane
        plane = values.new_zeros(len(centers) * plan.n_plane).scatter_add(0, flat.flatten(), values.flatten())
        return found + folded(plane.unflatten(0, (-1, plan.n_plane)), plan) * self.far


def half_plane(geometry: Geometry) -> Tensor:
    """Baselines (P, 2) [m] of the half-plane of frequencies, nu_y >= 0."""
    rows, columns = geometry.grid
    nu_y = torch.arange(rows // 2 + 1, dtype=torch.float64) / rows
    nu_x = torch.fft.fftfreq(columns, dtype=torch.float64)
    return torch.stack(torch.meshgrid(nu_x, nu_y, indexing="xy"), -1).flatten(0, 1) * geometry.period


def patch_index(corner: Tensor, plan: PatchPlan) -> Tensor:
    """Where the pixels of patches with the first pixel `corner` (..., 2) lie in the plane, (..., rows, columns)."""
    columns = int(plan.size[0])
    pixel = corner.nan_to_num(0.0).long()  # NaN, of an optimiser that diverged, must not become an index
    index_x = (pixel[..., :1] + plan.column).remainder(columns)
    index_y = plan.row + pixel[..., 1:] * columns
    return index_y[..., :, None] + index_x[..., None, :]


def folded(plane: Tensor, plan: PatchPlan) -> Tensor:
    """The half-plane of planes (..., n_plane), with what lies beyond its border reflected into it."""
    half = plane[..., plan.half]
    return half.index_add(half.ndim - 1, plan.mirrored, plane[..., plan.outside])
