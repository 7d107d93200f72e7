"""MSE_a at the cost of the support of its terms: every baseline is one small patch of pixels.

The sum over ordered pairs of sub-apertures of |OTF(nu - baseline)|^2 is even in nu. So half the frequency plane is
enough (rows nu_y >= 0, a few more on either side), each unordered pair leaves one patch there, the patches are
scattered into the plane, and what falls on the border of the half-plane or beyond it is reflected back. A patch is a
rectangle of pixels: the squared distance to its baseline is an outer sum, and one function of it is left to compute.

Nothing here is differentiated by autograd. The gradient is made right after the value, while the patches are in the
cache: it has the size of the centres, and nothing else needs to be kept for a backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import torch
from numpy.polynomial import Chebyshev, Polynomial
from torch import Tensor

# pixels of patches in work at a time: what a cache holds, and what amortises the launches of kernels
_CHUNK = {"cpu": 2**18, "cuda": 2**24}

Pullback = Callable[[Tensor], Tensor]


class Geometry(NamedTuple):
    """What the sum over baselines needs to know of an aperture and a grid, besides the centres."""

    grid: tuple[int, int]  # rows and columns of the frequency plane
    period: float  # length in the pupil of one cycle per pixel [m]
    shape: str
    diameter: float  # of a sub-aperture [m]
    orientation: float
    reach: float  # radius of the support of a sub-aperture's OTF [m], at most half the period


def _disc_series(degree: int) -> list[float]:
    """Coefficients of S in OTF = v^(3/2) S(v), v = 1 - x, x in [0, 1] the distance in units of the cut-off.

    OTF = (4/pi) integral_x^1 sqrt(1 - t^2) dt; expanding sqrt(1 - w/2) under the integral, w = 1 - t, gives the
    power series 4 sqrt(2)/pi sum_k binom(1/2, k) (-1/2)^k v^k / (k + 3/2), which is economised on [0, 1].
    """
    terms, binomial = [], 4 * math.sqrt(2) / math.pi
    for k in range(60):
        terms.append(binomial / (k + 1.5))
        binomial *= (k - 0.5) / (2 * (k + 1))
    return Chebyshev.interpolate(Polynomial(terms), degree, domain=[0, 1]).convert(kind=Polynomial).coef.tolist()


# OTF^2 has relative errors of 3e-13 and 5e-8 (float32) even at the edge, where the textbook form loses its
# digits: acos x - x sqrt(1 - x^2) is a small difference there.
_DISC_SERIES = {torch.float64: _disc_series(12), torch.float32: _disc_series(6)}


def disc_constants(dtype: torch.dtype, device: torch.device) -> list[Tensor]:
    """The coefficients of S and then 1, as the scalar tensors that addcmul takes."""
    return list(torch.tensor([*_DISC_SERIES[dtype], 1.0], dtype=dtype, device=device).unbind())


def disc_patches(x: Tensor, y: Tensor, constants: list[Tensor], differentiate: bool) -> tuple[Tensor, Pullback]:
    """OTF^2 of a disc at the pixels x (..., 1, K) by y (..., K, 1), in units of the cut-off: (..., K, K).

    `constants` are the `disc_constants`. The pullback takes the derivatives of a loss by the patches, (..., K, K), to
    those by the common shift of each patch's (x, y), (..., 2); it may be called once, and only if `differentiate`.
    """
    # All arrays in one allocation: the heap keeps one block for the next call where it would return several.
    work = x.new_empty(4 if differentiate else 3, *x.shape[:-2], y.shape[-2], x.shape[-1])
    v, inverse, a = work[0], work[1], work[2]
    *series, one = constants
    tiny = torch.finfo(x.dtype).tiny * 1e3  # gives distance 0 a finite inverse, which x = y = 0 then multiplies
    torch.add(x * x, y * y + tiny, out=v)
    torch.rsqrt(v, out=inverse)  # twice as fast as sqrt
    torch.addcmul(one, v, inverse, value=-1, out=v)
    v.clamp_(min=0)  # 1 - distance, and 0 outside
    torch.addcmul(series[-2], v, series[-1], out=a)
    for c in series[-3::-1]:
        torch.addcmul(c, v, a, out=a)
    a.mul_(v)
    value = work[-1]
    torch.mul(a, a, out=value)
    value.mul_(v)

    def pullback(grad: Tensor) -> Tensor:
        # d OTF^2 / d distance = -(8 / pi) a v sqrt(2 - v); the gradient points along (x, y)
        slope = inverse.mul_(a).mul_(v)
        torch.sub(2 * one, v, out=v)
        torch.rsqrt(v, out=a)
        slope.mul_(a.mul_(v)).mul_(grad)
        along_x, along_y = slope.sum(-2).mul_(x[..., 0, :]).sum(-1), slope.sum(-1).mul_(y[..., 0]).sum(-1)
        return torch.stack([along_x, along_y], dim=-1).mul_(-8 / math.pi)

    return value, pullback


def hexagon_patches(x: Tensor, y: Tensor, normals: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]:
    """OTF^2 of a regular hexagon, as `disc_patches`, x and y in units of its flat-to-flat width.

    `normals` (3, 2) are the unit normals of its sides, 60 degrees apart.

    The overlap of two hexagons is a hexagon of half-widths w_k = (1 - |n_k . shift|) / 2 along the normals n_k of the
    sides. Of the three |n_k . shift| the largest is the sum of the others, M = p + m, p >= m: its area is then
    (1 - p) (1 - M) if p >= 1/2 and 3/4 - M + p m otherwise. Its sides have lengths l_k = min(w_i + w_j - w_k, 2 w_i,
    2 w_j), and the area grows with w_k by 2 l_k.
    """
    along = [x * normals[k, 0] + y * normals[k, 1] for k in range(3)]
    t0, t1, t2 = (t.abs() for t in along)
    largest = torch.maximum(torch.maximum(t0, t1), t2)
    least = torch.minimum(torch.minimum(t0, t1), t2)
    middle = largest - least
    inner = torch.addcmul(0.75 - largest, middle, least)
    outer = (1 - middle).mul_((1 - largest).clamp_(min=0))
    otf = torch.where(middle < 0.5, inner, outer).mul_(4 / 3)
    if not differentiate:
        return otf.square_(), _no_pullback

    def pullback(grad: Tensor) -> Tensor:
        half = [(1 - t).clamp_(min=0).mul_(0.5) for t in (t0, t1, t2)]
        weight = otf * grad
        total = grad.new_zeros(*grad.shape[:-2], 2)
        for k in range(3):
            w, wi, wj = half[k], half[k - 1], half[k - 2]
            side = torch.minimum(wi + wj - w, 2 * torch.minimum(wi, wj)).clamp_(min=0)
            moved = side.mul_(torch.sign(along[k])).mul_(weight).sum((-2, -1))
            total += moved[..., None] * normals[k]
        return total.mul_(-8 / 3)

    return otf.square(), pullback


def _no_pullback(grad: Tensor) -> Tensor:
    raise RuntimeError("the patches were made without what their derivatives need")


class _Plan(NamedTuple):
    """Index arithmetic that depends on the geometry and the number of sub-apertures alone.

    The plane has `above` rows before those of the half-plane and some below, and is flat.
    """

    patches: Callable[..., tuple[Tensor, Pullback]]  # (x, y, differentiate)
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
    half: slice  # of the plane: the half-plane
    outside: Tensor  # of the plane: rows on the border of the half-plane and beyond it
    mirrored: Tensor  # of the half-plane: where those are reflected to


def _make_plan(geometry: Geometry, n: int, dtype: torch.dtype, device: torch.device) -> _Plan:
    (rows, columns), period = geometry.grid, geometry.period
    if geometry.shape == "disc":
        patches = partial(disc_patches, constants=disc_constants(dtype, device))
    else:
        angles = [geometry.orientation + k * math.pi / 3 for k in range(3)]
        normals = torch.tensor([[math.cos(t), math.sin(t)] for t in angles], dtype=dtype, device=device)
        patches = partial(hexagon_patches, normals=normals)
    zero = torch.zeros(1, dtype=torch.long, device=device)
    first, second = (torch.cat([zero, i]) for i in torch.triu_indices(n, n, 1, device=device))
    # rounded up to a number that float32 holds exactly, so that every index below follows from the same one
    reach_x, reach_y = (math.ceil(1024 * geometry.reach * size / period) / 1024 for size in (columns, rows))
    column = torch.arange(int(2 * reach_x) + 1, device=device)
    row = torch.arange(int(2 * reach_y) + 1, device=device)
    height, above, below = rows // 2 + 1, int(reach_y), int(reach_y) + 1
    lowest = rows - rows // 2  # the first row at nu_y >= 1/2
    outside = torch.cat([torch.arange(-above, 1), torch.arange(lowest, height + below)]).to(device)
    mirrored = torch.where(outside <= 0, -outside, rows - outside).clamp(0, height - 1)
    every = torch.arange(columns, device=device)
    return _Plan(
        patches,
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


_cached_plan = lru_cache(maxsize=32)(_make_plan)


class BaselineMSE(torch.autograd.Function):
    """MSE_a (B,) of masks with `centers` (B, N, 2) [m], differentiable once in them.

    `weight` and `ratio` (layers, H // 2 + 1, W) hold the PSDs: MSE_a is the sum of weight / (transfer + ratio) over the
    half-plane, with transfer = N^2 |h|^2 + sum_{m != n} |h(nu - nu_m + nu_n)|^2 and h the OTF over N.
    """

    @staticmethod
    def forward(ctx: Any, centers: Tensor, weight: Tensor, ratio: Tensor, geometry: Geometry) -> Tensor:
        plan_of = _make_plan if torch.compiler.is_compiling() else _cached_plan
        plan = plan_of(geometry, centers.shape[-2], centers.dtype, centers.device)
        differentiate = ctx.needs_input_grad[0]
        pixels = len(plan.first) * len(plan.row) * len(plan.column)
        masks = max(1, _CHUNK.get(centers.device.type, 2**24) // pixels)
        n_chunks = math.ceil(len(centers) / masks)
        chunks = centers.split(math.ceil(len(centers) / n_chunks)) if n_chunks > 1 else (centers,)
        parts = [_mse_and_gradient(chunk, weight, ratio, geometry, plan, differentiate) for chunk in chunks]
        if differentiate:
            ctx.save_for_backward(centers, torch.cat([gradient for _, gradient in parts if gradient is not None]))
        return torch.cat([value for value, _ in parts])

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None, None, None]:
        centers, gradient = ctx.saved_tensors
        return grad[0][:, None, None] * _DifferentiatedOnce.apply(gradient, centers), None, None, None


class _DifferentiatedOnce(torch.autograd.Function):
    """A gradient that says so when it is differentiated: torch would take it for a constant, and Hessians for 0."""

    @staticmethod
    def forward(ctx: Any, gradient: Tensor, centers: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, Tensor]:
        raise RuntimeError("MSE_a has a first derivative only: take differences of its gradient for a Hessian")


def _mse_and_gradient(
    centers: Tensor, weight: Tensor, ratio: Tensor, geometry: Geometry, plan: _Plan, differentiate: bool
) -> tuple[Tensor, Tensor | None]:
    """MSE_a (B,) and, if asked for, its gradient by the centres (B, N, 2)."""
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
        return value, None
    slope = error.mul_(inverse).sum(1)  # of MSE_a by the transfer, but for its sign
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
