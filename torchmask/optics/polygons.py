"""Holes with straight sides: convex, point-symmetric polygons such as hexagons and squares."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchmask.optics.shape_base import (
    Array,
    Contour,
    Corners,
    Patches,
    Pullback,
    Shape,
    half_plane_coverage,
    no_pullback,
)
from torchmask.optics.strips import StripArea, require_strips


@dataclass(frozen=True)
class Polygon(Shape):
    """A convex, point-symmetric polygon: the intersection of strips around its centre.

    A subclass defines its strips and inherits everything else. If it is not symmetric about the normal of its first
    side, it must also define `mirrored`.

    Parameters
    ----------
    orientation : float
        Angle from +x to the normal of the first side [rad].

    Raises
    ------
    ValueError
        If `orientation` is not finite, or the strips enclose no polygon: fewer than two, angles that do not ascend from
        0 to less than pi, or a width that is not finite and positive.
    """

    orientation: float = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.orientation):
            raise ValueError(f"orientation is {self.orientation}: it must be a finite angle in rad")
        require_strips(type(self).__name__, self.strips())

    @abstractmethod
    def strips(self) -> Sequence[tuple[float, float]]:
        """Return for each of S strips the angle of its normal from the first one's [rad] and its width in diameters.

        Angles ascend from 0 to less than pi. Each strip contributes two sides.
        """

    @property
    def plural(self) -> str:
        return f"{self.name}s (flat to flat)"

    def turned(self, angle: float) -> Self:
        return replace(self, orientation=self.orientation + angle)

    def mirrored(self) -> Self:
        return replace(self, orientation=-self.orientation)

    @property
    def askew(self) -> float:
        # The result puts the middle of the widest gap between the normals along y.
        angles = [angle for angle, _ in self.strips()]
        following = [*angles[1:], angles[0] + math.pi]
        gap, first = max((after - angle, angle) for angle, after in zip(angles, following, strict=True))
        return math.pi / 2 - self.orientation - first - gap / 2

    def _normals(self) -> list[tuple[float, float]]:
        """Return the outward normals of the 2 S sides, counterclockwise from the first."""
        angles = [self.orientation + angle for angle, _ in self.strips()]
        half = [(_snapped(math.cos(angle)), _snapped(math.sin(angle))) for angle in angles]
        return half + [(-x, -y) for x, y in half]

    def _distances(self, diameter: float) -> list[float]:
        """Return the distances of the 2 S sides from the centre [m]."""
        return 2 * [width * (diameter / 2) for _, width in self.strips()]

    def _corners(self, diameter: float) -> list[tuple[float, float]]:
        """Return the 2 S corners [m], counterclockwise; the first two are the ends of the first side."""
        sides = list(zip(self._normals(), self._distances(diameter), strict=True))
        corners = []
        for ((a, b), before), ((c, d), distance) in zip([sides[-1], *sides[:-1]], sides, strict=True):
            sine = a * d - b * c  # sine of the angle between the two normals (a, b) and (c, d)
            corners.append(((before * d - distance * b) / sine, (distance * a - before * c) / sine))
        return corners

    def _sides(self, diameter: float) -> tuple[Array, Array]:
        """Return midpoints (2 S, 2) and lengths (2 S,) of the sides [m], in order from the first."""
        corners = np.array(self._corners(diameter))
        ends = np.roll(corners, -1, axis=0)
        return (corners + ends) / 2, np.linalg.norm(ends - corners, axis=-1)

    def area(self, diameter: float) -> float:
        corners = self._corners(diameter)
        ends = [*corners[1:], corners[0]]
        return sum(a * d - b * c for (a, b), (c, d) in zip(corners, ends, strict=True)) / 2

    def outer_diameter(self, diameter: float) -> float:
        return diameter * 2 * max(math.hypot(x, y) for x, y in self._corners(1.0))

    def outline(self, diameter: float) -> tuple[Contour, ...]:
        return (Corners(np.array(self._corners(diameter))),)

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        # A shape with parameters other than its orientation must override this method.
        if len(outline) != 1 or not isinstance(outline[0], Corners) or [f.name for f in fields(cls)] != ["orientation"]:
            return None
        points, strips = outline[0].points, cls().strips()
        if len(points) != 2 * len(strips):
            return None
        x, y = (points[0] + points[1]) / 2
        shape, diameter = cls(math.atan2(y, x)), 2 * math.hypot(x, y) / strips[0][1]
        return (shape, diameter) if np.abs(shape._corners(diameter) - points).max() < tolerance else None

    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        normals = offsets.new_tensor(self._normals())
        inwards = offsets.new_tensor(self._distances(diameter)) - (offsets[..., None, :] * normals).sum(
            -1
        )  # (..., 2 S)
        return half_plane_coverage(inwards, normals, cell).prod(-1)

    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        # Two shifted copies overlap in a polygon with the same normals but narrower strips, centred between them.
        angles, widths = zip(*self.strips(), strict=True)
        across = (shift[..., None, :] / diameter * shift.new_tensor(self._normals()[: len(widths)])).sum(-1)
        half_widths = ((shift.new_tensor(widths) - across.abs()) / 2).clamp(min=0)
        return StripArea.apply(half_widths, angles) / self.area(1.0)  # type: ignore[no-any-return]

    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        """Return a product of Gauss rules on each of the triangles between the centre and a side."""
        nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + 2)
        nodes, weights = (nodes + 1) / 2, weights / 2  # on [0, 1]
        corner = np.array(self._corners(diameter))
        end = np.roll(corner, -1, axis=0)
        triangle = (corner[:, 0] * end[:, 1] - corner[:, 1] * end[:, 0]) / 2 / self.area(diameter)
        side = corner[:, None] + nodes[:, None] * (end - corner)[:, None]  # (2 S, nodes, 2)
        points = nodes[:, None, None, None] * side
        weight = (2 * nodes * weights)[:, None, None] * triangle[:, None] * weights
        return torch.from_numpy(points.reshape(-1, 2)), torch.from_numpy(weight.reshape(-1))

    def amplitude(self, frequency: Array, diameter: float) -> Array:
        # Green's theorem gives one term for each pair of opposite sides, of midpoint m, length l and normal n:
        # sin(2 pi f m) / (pi |f|^2) times l (f n) sinc(l f t), t along the side.
        n_strips = len(self.strips())
        normal, (middle, length) = np.array(self._normals())[:n_strips], self._sides(diameter)
        middle, length = middle[:n_strips], length[:n_strips]
        along = frequency @ np.stack([-normal[:, 1], normal[:, 0]])
        squared = (frequency**2).sum(-1)[..., None]
        wave = np.sin(2 * np.pi * frequency @ middle.T) * (frequency @ normal.T) / np.where(squared > 0, squared, 1)
        transform = (wave * length * np.sinc(length * along)).sum(-1) / np.pi
        return np.where(squared[..., 0] > 0, transform / self.area(diameter), 1.0)

    def separation(self, difference: Tensor) -> Tensor:
        across = difference @ difference.new_tensor(self._normals()).T / difference.new_tensor(self._distances(2.0))
        # `max`, not `amax`: among equal values it takes one, so that the gradient of coincident holes is not zero
        return across.max(-1).values

    def clearance(self, centers: Tensor, diameter: float, disc_diameter: float) -> Tensor:
        corners = centers[..., None, :] + centers.new_tensor(self._corners(diameter))
        return disc_diameter / 2 - torch.linalg.vector_norm(corners, dim=-1).amax(-1)

    def center_radius(self, diameter: float, disc_diameter: float) -> float:
        # A hole whose side faces the rim has its centre farthest out.
        middle, length = self._sides(diameter)
        rim = np.sqrt(np.clip(disc_diameter**2 / 4 - length**2 / 4, 0, None))
        return float(np.linalg.norm(rim[:, None] * np.array(self._normals()) - middle, axis=-1).max())

    def chords(self, height: Array, diameter: float) -> tuple[Array, Array]:
        left, right = np.full_like(height, -np.inf), np.full_like(height, np.inf)
        for angle, width in self.strips():
            middle, half = -np.tan(self.orientation + angle) * height, width * diameter / 2
            half = half / abs(math.cos(self.orientation + angle))
            left, right = np.maximum(left, middle - half), np.minimum(right, middle + half)
        empty = left >= right
        return np.where(empty, 0, left), np.where(empty, 0, right)


@dataclass(frozen=True)
class Hexagon(Polygon):
    """A regular hexagon, such as a segment of a large mirror.

    Examples
    --------
    >>> Hexagon(orientation=0.2).outer_diameter(1.0)  # corner to corner
    1.1547...
    """

    name: ClassVar[str] = "hexagon"

    def strips(self) -> Sequence[tuple[float, float]]:
        return [(k * math.pi / 3, 1.0) for k in range(3)]

    def patches(self, dtype: torch.dtype, device: torch.device) -> Patches:
        return partial(_hexagon_patches, normals=torch.tensor(self._normals()[:3], dtype=dtype, device=device))


@dataclass(frozen=True)
class Square(Polygon):
    """A square, such as a mirror of a micromirror array.

    Examples
    --------
    >>> round(float(Square().otf(torch.tensor([0.25, 0.5]), 1.0)), 12)  # product of two triangle functions, 3/4 and 1/2
    0.375
    """

    name: ClassVar[str] = "square"

    def strips(self) -> Sequence[tuple[float, float]]:
        return [(0.0, 1.0), (math.pi / 2, 1.0)]


def _snapped(cosine: float) -> float:
    """Round a cosine that should be 0 to exactly 0, so that sides along an axis, and their gradients, are exact."""
    return 0.0 if abs(cosine) < 1e-15 else cosine


def _hexagon_patches(x: Tensor, y: Tensor, differentiate: bool, normals: Tensor) -> tuple[Tensor, Pullback]:
    """Compute the `Patches` of a regular hexagon whose sides have the unit normals `normals` (3, 2), 60 degrees apart.

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
        return otf.square_(), no_pullback

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
