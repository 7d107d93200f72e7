"""Fast evaluation of MSE_a, in which every baseline is one small patch of pixels.

The sum over ordered pairs of sub-apertures of |OTF(nu - baseline)|^2 is even in nu. Half the frequency plane is
therefore enough (rows nu_y >= 0, with a few more on either side): each unordered pair has one patch there, the patches
are added to the plane, and pixels on the border of the half-plane or beyond it are reflected back. A patch is a
rectangle of pixels in which the squared distance to its baseline is an outer sum, so only one function of it remains.

Autograd is not used here. The gradient is computed right after the value, while the patches are in the cache: it has
the size of the centres, and nothing else needs to be stored for a backward pass.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmask.design.early_gradient import EarlyGradient, vmap_population
from torchmask.memory import AtATime
from torchmask.optics.shape_base import Patches, Shape

_CHUNK = AtATime(processor=2**18, gpu=2**24)  # pixels of patches


class Geometry(NamedTuple):
    """Properties of an aperture and a grid that the sum over baselines needs besides the centres."""

    grid: tuple[int, int]  # rows and columns of the frequency plane
    period: float  # length in the pupil of one cycle per pixel [m]
    shape: Shape
    diameter: float  # diameter of a sub-aperture [m]
    reach: float  # radius of the support of a sub-aperture's OTF [m], at most half the period


class PatchPlan(NamedTuple):
    """Indices that depend only on the geometry and the number of sub-apertures.

    The plane is flattened, and has `above` rows before those of the half-plane and some after them.
    """

    patches: Patches
    one: Tensor
    first: Tensor  # (pairs,) sub-apertures of each pair; the zero baseline is pair 0
    second: Tensor
    size: Tensor  # (2,) columns, rows
    reach: Tensor  # (2,) reach in pixels, x and y
    x: Tensor  # (Kx,) pixels of a patch, in units of the diameter of a sub-aperture
    y: Tensor  # (Ky,)
    column: Tensor  # (Kx,) whole pixels
    row: Tensor  # (Ky,) whole pixels, where they start in the plane
    n_plane: int
    half: slice  # the half-plane, in the plane
    outside: Tensor  # rows of the plane on the border of the half-plane and beyond it
    mirrored: Tensor  # rows of the half-plane to which those are reflected


def make_plan(geometry: Geometry, n: int, dtype: torch.dtype, device: torch.device) -> PatchPlan:
    (rows, columns), period = geometry.grid, geometry.period
    zero = torch.zeros(1, dtype=torch.long, device=device)
    first, second = (torch.cat([zero, i]) for i in torch.triu_indices(n, n, 1, device=device))
    # rounded up to a number that float32 holds exactly, so that every index below follows from the same one
    reach_x, reach_y = (math.ceil(1024 * geometry.reach * size / period) / 1024 for size in (columns, rows))
    column = torch.arange(int(2 * reach_x) + 1, device=device)
    row = torch.arange(int(2 * reach_y) + 1, device=device)
    height, above, below = rows // 2 + 1, int(reach_y), int(reach_y) + 1
    lowest = rows - rows // 2  # the first row at nu_y >= 1/2
    outside = torch.cat([torch.arange(*ends, device=device) for ends in ((-above, 1), (lowest, height + below))])
    mirrored = torch.where(outside <= 0, -outside, rows - outside).clamp(0, height - 1)
    every = torch.arange(columns, device=device)
    return PatchPlan(
        geometry.shape.patches(dtype, device),
        torch.ones((), dtype=dtype, device=device),
        first,
        second,
        torch.tensor([columns, rows], dtype=dtype, device=device),
        torch.tensor([reach_x, reach_y], dtype=dtype, device=device),
        column * torch.tensor(period / (columns * geometry.diameter), dtype=dtype, device=device),
        row * torch.tensor(period / (rows * geometry.diameter), dtype=dtype, device=device),
        column,
        (row + above) * columns,
        (above + height + below) * columns,
        slice(above * columns, (above + height) * columns),
        ((outside + above)[:, None] * columns + every).flatten(),
        (mirrored[:, None] * columns + -every % columns).flatten(),
    )


cached_plan = lru_cache(maxsize=32)(make_plan)


def baseline_mse(centers: Tensor, weight: Tensor, ratio: Tensor, geometry: Geometry) -> Tensor:
    """Return MSE_a (B,) of masks with `centers` (B, N, 2) [m], differentiable once in them.

    `weight` and `ratio` (layers, H // 2 + 1, W) hold the PSDs: MSE_a is the sum of weight / (transfer + ratio) over the
    half-plane, with transfer = N^2 |h|^2 + sum_{m != n} |h(nu - nu_m + nu_n)|^2 and h the OTF over N.
    """
    differentiate = centers.requires_grad and torch.is_grad_enabled()
    return _BaselineMSE.apply(centers, weight, ratio, geometry, differentiate)[0]  # type: ignore[no-any-return]


class _BaselineMSE(EarlyGradient):
    """`baseline_mse` and, if requested, its gradient."""

    @staticmethod
    def forward(
        centers: Tensor, weight: Tensor, ratio: Tensor, geometry: Geometry, differentiate: bool
    ) -> tuple[Tensor, Tensor]:
        plan_of = make_plan if torch.compiler.is_compiling() else cached_plan
        plan = plan_of(geometry, centers.shape[-2], centers.dtype, centers.device)
        pixels = len(plan.first) * len(plan.row) * len(plan.column)
        masks = max(1, _CHUNK.on(centers.device) // pixels)
        n_chunks = math.ceil(len(centers) / masks)
        chunks = centers.split(math.ceil(len(centers) / n_chunks)) if n_chunks > 1 else (centers,)
        parts = [_mse_and_gradient(chunk, weight, ratio, geometry, plan, differentiate) for chunk in chunks]
        return torch.cat([value for value, _ in parts]), torch.cat([gradient for _, gradient in parts])

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> Any:
        return vmap_population(_BaselineMSE, in_dims, *arguments)


def _mse_and_gradient(
    centers: Tensor, weight: Tensor, ratio: Tensor, geometry: Geometry, plan: PatchPlan, differentiate: bool
) -> tuple[Tensor, Tensor]:
    """Return MSE_a (B,) and its gradient in the centres (B, N, 2), or one of shape (0, N, 2) if not requested."""
    (rows, columns), period = geometry.grid, geometry.period
    # baselines in cycles/pixel, the nearest image on the torus, and of the two opposite ones that with nu_y >= 0
    nu = (centers.index_select(1, plan.first) - centers.index_select(1, plan.second)).mul_(1 / period)
    nu.sub_(nu.round())
    sign = torch.copysign(plan.one, nu[..., 1:])
    baseline = nu.mul_(sign).mul_(plan.size)
    corner = (baseline - plan.reach).ceil_()  # first pixel within reach
    offset = corner - baseline
    x = torch.add(plan.x, offset[..., :1], alpha=period / (columns * geometry.diameter))[..., None, :]
    y = torch.add(plan.y, offset[..., 1:], alpha=period / (rows * geometry.diameter))[..., :, None]
    patches, pullback = plan.patches(x, y, differentiate=differentiate)
    n = centers.shape[1]
    patches[:, 0].mul_(n * n / 2)  # every patch counts twice in the end, at nu and at -nu

    pixel = corner.nan_to_num_(0.0).long()  # NaN, of an optimiser that diverged, must not become an index
    index_x = (pixel[..., :1] + plan.column).remainder_(columns)
    index_y = torch.add(plan.row, pixel[..., 1:], alpha=columns)
    index = (index_y[..., :, None] + index_x[..., None, :]).flatten(1)
    plane = centers.new_zeros(len(centers), plan.n_plane)
    plane.scatter_add_(1, index, patches.flatten(1))
    half = plane[:, plan.half]
    half.index_add_(1, plan.mirrored, plane.index_select(1, plan.outside))

    inverse = torch.add(ratio.flatten(1), half[:, None], alpha=1 / n**2).reciprocal_()
    error = inverse * weight.flatten(1)
    value = error.sum((1, 2))  # not a matmul, which autocast and TF32 would round
    if not differentiate:
        return value, centers.new_empty(0, *centers.shape[1:])
    slope = error.mul_(inverse).sum(1)  # minus the derivative of MSE_a in the transfer
    half.copy_(slope)
    plane[:, : plan.half.start].zero_()
    plane[:, plan.half.stop :].zero_()
    plane.index_add_(1, plan.outside, slope.index_select(1, plan.mirrored))
    torch.gather(plane, 1, index, out=patches.view_as(index))
    by_baseline = pullback(patches).mul_(sign).mul_(1 / (n**2 * geometry.diameter))
    gradient = torch.zeros_like(centers)
    gradient.index_add_(1, plan.first, by_baseline)
    gradient.index_add_(1, plan.second, by_baseline, alpha=-1)
    return value, gradient
