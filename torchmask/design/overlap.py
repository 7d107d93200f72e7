"""Squared OTF of one sub-aperture on a patch of pixels, with its derivatives: what a baseline adds to MSE_a.

A patch is a rectangle of pixels, so the squared distance to the baseline is an outer sum, and one function of it is
left to compute. The functions here return the patches and a pullback: given the derivatives of a loss by the values
of the patches, it returns those by the shift of each patch. They are written for speed: few passes over the
patches, in place, with no table, and no branch. They differentiate nothing themselves (`torch.no_grad`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from numpy.polynomial import Chebyshev, Polynomial
from torch import Tensor

Pullback = Callable[[Tensor], Tensor]


def _disc_series(degree: int) -> list[float]:
    """Coefficients of S in OTF = v^(3/2) S(v), v = 1 - x, x in [0, 1] the distance in units of the cut-off.

    OTF = (4/pi) integral_x^1 sqrt(1 - t^2) dt; expanding sqrt(1 - w/2) under the integral, w = 1 - t, gives the
    power series 4 sqrt(2)/pi sum_k binom(1/2, k) (-1/2)^k v^k / (k + 3/2), which is economised on [0, 1].
    """
    terms, binomial = [], 4 * math.sqrt(2) / math.pi
    for k in range(60):
        terms.append(binomial / (k + 1.5))
        binomial *= (k - 0.5) / (2 * (k + 1))
    return list(Chebyshev.interpolate(Polynomial(terms), degree, domain=[0, 1]).convert(kind=Polynomial).coef)


# Relative errors 5e-15 and 3e-8, up to the edge of the support, where the textbook form loses all digits.
_DISC_SERIES = {
    torch.float64: torch.tensor(_disc_series(14), dtype=torch.float64),
    torch.float32: torch.tensor(_disc_series(6), dtype=torch.float32),
}


def disc_patches(x: Tensor, y: Tensor, differentiate: bool) -> tuple[Tensor, Pullback]:
    """OTF^2 of a disc at the pixels x (..., 1, K) by y (..., K, 1), in units of the cut-off: (..., K, K).

    The pullback takes (..., K, K) to (..., 2), derivatives by the patch's common shift of (x, y); it may be called
    once, and only with `differentiate`.
    """
    tiny = torch.finfo(x.dtype).tiny * 1e3  # the distance 0 gets a finite inverse, which x = y = 0 then multiplies
    squared = x * x + (y * y + tiny)
    inverse = torch.rsqrt(squared)
    coefficients = _DISC_SERIES[x.dtype].to(x.device).unbind()
    # v = 1 - distance, 0 outside; rsqrt is twice as fast as sqrt
    v = torch.addcmul(torch.ones_like(coefficients[0]), squared, inverse, value=-1, out=squared).clamp_(min=0)
    a = torch.addcmul(coefficients[-2], coefficients[-1], v)
    for c in coefficients[-3::-1]:
        torch.addcmul(c, a, v, out=a)
    a *= v
    if not differentiate:
        return a.square_().mul_(v), _no_pullback
    value = a.square().mul_(v)

    def pullback(grad: Tensor) -> Tensor:
        # d OTF^2 / d distance = -(8 / pi) a v sqrt(2 - v); the gradient points along (x, y)
        slope = torch.rsub(v, 2).sqrt_().mul_(v).mul_(a).mul_(inverse).mul_(grad)
        along = torch.stack([(slope.sum(-2) * x[..., 0, :]).sum(-1), (slope.sum(-1) * y[..., 0]).sum(-1)], dim=-1)
        return along.mul_(-8 / math.pi)

    return value, pullback


def hexagon_patches(x: Tensor, y: Tensor, orientation: float, differentiate: bool) -> tuple[Tensor, Pullback]:
    """OTF^2 of a regular hexagon, as `disc_patches`, x and y in units of its flat-to-flat width.

    The overlap of two hexagons is a hexagon of half-widths w_k = (1 - |n_k . shift|) / 2 along the normals n_k of the
    sides. Of the three |n_k . shift| the largest is the sum of the others, M = p + m, p >= m: its area is then
    (1 - p) (1 - M) if p >= 1/2 and 3/4 - M + p m otherwise. Its sides have lengths l_k = min(w_i + w_j - w_k, 2 w_i,
    2 w_j), and moving one of them changes the area by its length.
    """
    angles = [orientation + k * math.pi / 3 for k in range(3)]
    normals = [(math.cos(t), math.sin(t)) for t in angles]
    along = [x * cosine + y * sine for cosine, sine in normals]
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
            total += moved[..., None] * total.new_tensor(normals[k])
        return total.mul_(-8 / 3)

    return otf.square(), pullback


def _no_pullback(grad: Tensor) -> Tensor:
    raise RuntimeError("the patches were made without their derivatives")
