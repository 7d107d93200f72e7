"""Round holes: discs and annuli."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar, Self

import numpy as np
import torch
from numpy.polynomial import Chebyshev, Polynomial
from scipy.special import j1
from torch import Tensor

from torchmask.optics.shape_base import (
    Array,
    Circle,
    Contour,
    Patches,
    Pullback,
    Shape,
    half_plane_coverage,
    safe_length,
    vector,
)


@dataclass(frozen=True)
class Disc(Shape):
    """A clear disc.

    Examples
    --------
    >>> round(Disc().area(0.2), 6)
    0.031416
    >>> float(Disc().otf(torch.tensor([0.0, 0.1]), 0.2))  # at half the cut-off
    0.391...
    """

    name: ClassVar[str] = "disc"
    is_round: ClassVar[bool] = True
    has_noll_modes: ClassVar[bool] = True

    def turned(self, angle: float) -> Self:
        return self

    def mirrored(self) -> Self:
        return self

    def area(self, diameter: float) -> float:
        return math.pi / 4 * diameter**2

    def outer_diameter(self, diameter: float) -> float:
        return diameter

    def outline(self, diameter: float) -> tuple[Contour, ...]:
        return (Circle(diameter / 2),)

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        return (cls(), 2 * outline[0].radius) if len(outline) == 1 and isinstance(outline[0], Circle) else None

    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        # A sample at the centre, or so near that its squared distance underflows, has no direction. Any will do; this
        # one keeps the gradient finite.
        central = (offsets.abs() < math.sqrt(torch.finfo(offsets.dtype).tiny)).all(-1, keepdim=True)
        direction = torch.where(central, vector(offsets, 1.0, 0.0), offsets)
        length = torch.linalg.vector_norm(direction, dim=-1, keepdim=True)
        r = torch.where(central, 0, length)[..., 0]
        return half_plane_coverage(diameter / 2 - r, direction / length, cell)

    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        return disc_otf(_distance(shift) / diameter)

    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        return _ring_quadrature(degree, diameter, 0.0)

    def amplitude(self, frequency: Array, diameter: float) -> Array:
        x = np.pi * diameter * np.linalg.norm(frequency, axis=-1)
        return np.where(x > 1e-6, 2 * j1(x) / np.where(x > 1e-6, x, 1), 1)

    def separation(self, difference: Tensor) -> Tensor:
        return safe_length(difference)

    def clearance(self, centers: Tensor, diameter: float, disc_diameter: float) -> Tensor:
        return self.center_radius(diameter, disc_diameter) - torch.linalg.vector_norm(centers, dim=-1)

    def center_radius(self, diameter: float, disc_diameter: float) -> float:
        return (disc_diameter - diameter) / 2

    def chords(self, height: Array, diameter: float) -> tuple[Array, Array]:
        half = np.sqrt(np.clip((diameter / 2) ** 2 - height**2, 0, None))
        return -half, half

    def patches(self, dtype: torch.dtype, device: torch.device) -> Patches:
        return partial(disc_patches, constants=disc_constants(dtype, device))


@dataclass(frozen=True)
class Annulus(Disc):
    """A disc with a round central obstruction, such as a telescope's secondary mirror.

    Gaps between holes and distances to the rim are those of the disc.

    Parameters
    ----------
    obstruction : float
        Diameter of the obstruction over that of the disc, above 0 and below 1.

    Raises
    ------
    ValueError
        If `obstruction` is out of range.
    """

    name: ClassVar[str] = "annulus"
    has_noll_modes: ClassVar[bool] = False

    obstruction: float

    def __post_init__(self) -> None:
        if not 0 < self.obstruction < 1:
            raise ValueError(
                f"obstruction is {self.obstruction}: it must be a fraction of the diameter, above 0 and below 1; for "
                "none, take a Disc"
            )

    @property
    def plural(self) -> str:
        return "annuli"

    @property
    def fineness(self) -> float:
        return 1 - self.obstruction

    def area(self, diameter: float) -> float:
        return super().area(diameter) * (1 - self.obstruction**2)

    def outline(self, diameter: float) -> tuple[Contour, ...]:
        return (*super().outline(diameter), Circle(self.obstruction * diameter / 2))

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        match outline:
            case (Circle(outer), Circle(inner)):
                return cls(inner / outer), 2 * outer
        return None

    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        return super().coverage(offsets, cell, diameter) - super().coverage(offsets, cell, self.obstruction * diameter)

    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        # The overlap of two discs, less that of each disc with the other's obstruction, plus that of the obstructions,
        # which has been subtracted twice (E. L. O'Neill, J. Opt. Soc. Am. 46, 285, 1956).
        distance, inner = 2 * _distance(shift) / diameter, self.obstruction
        overlap = (
            _CircleOverlap.apply(distance, 1.0, 1.0)
            - 2 * _CircleOverlap.apply(distance, 1.0, inner)
            + _CircleOverlap.apply(distance, inner, inner)
        )
        return overlap / (math.pi * (1 - inner**2))  # type: ignore[no-any-return]

    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        return _ring_quadrature(degree, diameter, self.obstruction)

    def amplitude(self, frequency: Array, diameter: float) -> Array:
        blocked = self.obstruction**2 * super().amplitude(frequency, self.obstruction * diameter)
        return (super().amplitude(frequency, diameter) - blocked) / (1 - self.obstruction**2)

    patches = Shape.patches


def disc_otf(x: Tensor) -> Tensor:
    """Return the OTF of a clear disc at `x` >= 0 times its cut-off: (2/pi)(acos x - x sqrt(1 - x^2)), 0 beyond 1.

    The result has the shape, dtype and device of `x`. The derivative is -(4/pi) sqrt(1 - x^2) (Goodman, Introduction to
    Fourier Optics, section 6.3).
    """
    return _CircleOverlap.apply(2 * x, 1.0, 1.0) / math.pi  # type: ignore[no-any-return]


class _CircleOverlap(torch.autograd.Function):
    """Area common to two discs of radii `one` >= `other` whose centres are `distance` >= 0 apart.

    Its derivative is minus the length of the common chord; autograd would give NaN where the circles touch or are
    concentric.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(distance: Tensor, one: float, other: float) -> Tensor:
        if one == other:
            return 2 * _CircleOverlap._segment(distance, one, other)
        return _CircleOverlap._segment(distance, one, other) + _CircleOverlap._segment(distance, other, one)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        distance, ctx.one, ctx.other = inputs
        ctx.save_for_backward(distance)
        ctx.save_for_forward(distance)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None, None]:
        return _CircleOverlap.jvp(ctx, *grad), None, None

    @staticmethod
    def jvp(ctx: Any, *change: Tensor) -> Tensor:
        (distance,) = ctx.saved_tensors
        return -2 * ctx.one * _CircleOverlap._half_angle(distance, ctx.one, ctx.other)[1] * change[0]

    @staticmethod
    def _segment(distance: Tensor, radius: float, rest: float) -> Tensor:
        """Return the area between the common chord and the arc of one circle beyond it."""
        cosine, sine = _CircleOverlap._half_angle(distance, radius, rest)
        return radius**2 * (torch.arccos(cosine) - sine * cosine)

    @staticmethod
    def _half_angle(distance: Tensor, radius: float, rest: float) -> tuple[Tensor, Tensor]:
        """Return cosine and sine of half the angle that the common chord subtends at the centre of one circle."""
        distance = distance.clamp(min=1e-18)
        cosine = ((distance**2 + (radius**2 - rest**2)) / (2 * radius * distance)).clamp(-1, 1)
        squared = (1 - cosine) * (1 + cosine)
        # where the circles touch, the slope of the root is infinite on one side and zero on the other, which is taken
        return cosine, torch.where(squared > 0, squared, 1).sqrt() * (squared > 0)


def _distance(shift: Tensor) -> Tensor:
    """Return the length along the last axis, with gradient 0 at zero."""
    x, y = shift.unbind(-1)
    squared = x * x + y * y
    return torch.where(squared > 0, squared, 1).sqrt() * (squared > 0)


def _ring_quadrature(degree: int, diameter: float, obstruction: float) -> tuple[Tensor, Tensor]:
    """Return a product of Gauss nodes in the squared radius and uniform angles."""
    nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + 2)
    nodes, weights = (nodes + 1) / 2, weights / 2  # on [0, 1]
    inner = obstruction**2
    radius = np.sqrt(inner + (1 - inner) * nodes)  # uniform in area
    angle = 2 * math.pi / (degree + 1) * np.arange(degree + 1)
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    weight = np.broadcast_to(weights[:, None] / (degree + 1), points.shape[:-1])
    return torch.from_numpy(points.reshape(-1, 2) * (diameter / 2)), torch.from_numpy(weight.reshape(-1).copy())


def _disc_series(degree: int) -> list[float]:
    """Return the coefficients of S in OTF = v^(3/2) S(v), v = 1 - x, x in [0, 1] the distance in units of the cut-off.

    OTF = (4/pi) integral_x^1 sqrt(1 - t^2) dt; expanding sqrt(1 - w/2) under the integral, w = 1 - t, gives the
    power series 4 sqrt(2)/pi sum_k binom(1/2, k) (-1/2)^k v^k / (k + 3/2), which is economised on [0, 1].
    """
    terms, binomial = [], 4 * math.sqrt(2) / math.pi
    for k in range(60):
        terms.append(binomial / (k + 1.5))
        binomial *= (k - 0.5) / (2 * (k + 1))
    return Chebyshev.interpolate(Polynomial(terms), degree, domain=[0, 1]).convert(kind=Polynomial).coef.tolist()


# With them OTF^2 has relative errors of 3e-13 and 5e-8 (float32) even at the edge, where the textbook form,
# acos x - x sqrt(1 - x^2), cancels.
_DISC_SERIES = {torch.float64: _disc_series(12), torch.float32: _disc_series(6)}


def disc_constants(dtype: torch.dtype, device: torch.device) -> list[Tensor]:
    """Return the coefficients of S, followed by 1, as the scalar tensors that addcmul takes."""
    return list(torch.tensor([*_DISC_SERIES[dtype], 1.0], dtype=dtype, device=device).unbind())


def disc_patches(x: Tensor, y: Tensor, differentiate: bool, constants: list[Tensor]) -> tuple[Tensor, Pullback]:
    """Compute the `Patches` of a disc with the `disc_constants`."""
    # One allocation for all arrays, because the heap reuses a single block but would release several.
    work = x.new_empty(4 if differentiate else 3, *x.shape[:-2], y.shape[-2], x.shape[-1])
    v, inverse, a = work[0], work[1], work[2]
    *series, one = constants
    tiny = torch.finfo(x.dtype).tiny * 1e3  # keeps the inverse of distance 0 finite; x = y = 0 then multiplies it
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
