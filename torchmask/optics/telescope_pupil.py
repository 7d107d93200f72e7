"""The pupil of a telescope whose secondary mirror is held by straight vanes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np
import torch
from torch import Tensor

from torchmask.optics.round import Annulus, Disc
from torchmask.optics.shape_base import Array, Contour, Corners, half_plane_coverage
from torchmask.optics.vanes import Spider, edges, sector_quadrature, vane_transform, vaned_otf


@dataclass(frozen=True)
class TelescopePupil(Annulus):
    """A disc with a round central obstruction and straight vanes from it, or from the centre, to the rim.

    Parameters
    ----------
    obstruction : float
        Diameter of the obstruction over that of the disc, at least 0 and below 1.
    vane_width : float
        Width of each vane over the diameter of the disc.
    vane_angles : sequence of float
        Direction of each vane from the centre, counterclockwise from +x [rad].

    Raises ValueError if there is no such pupil, as `require_vanes` says.

    Examples
    --------
    >>> pupil = TelescopePupil(0.2, 0.01, (0.0, math.pi / 2, math.pi, -math.pi / 2))
    >>> round(pupil.area(1.0) / Annulus(0.2).area(1.0), 4)  # about 1 - 4 * 0.01 * 0.4 / 0.754
    0.9788
    """

    name: ClassVar[str] = "telescope pupil"
    is_round: ClassVar[bool] = False

    vane_width: float
    vane_angles: tuple[float, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "vane_angles", tuple(np.atleast_1d(self.vane_angles).tolist()))
        require_vanes(self.obstruction, self.vane_width, self.vane_angles)

    @property
    def spider(self) -> Spider:
        """Obstruction and vanes in units of the radius."""
        return Spider.of(self.obstruction, self.vane_width, self.vane_angles)

    @property
    def plural(self) -> str:
        return f"{self.name}s"

    @property
    def without_vanes(self) -> Disc:
        return Annulus(self.obstruction) if self.obstruction else Disc()

    def turned(self, angle: float) -> Self:
        return replace(self, vane_angles=tuple(own + angle for own in self.vane_angles))

    def mirrored(self) -> Self:
        return replace(self, vane_angles=tuple(math.pi - own for own in self.vane_angles))

    def area(self, diameter: float) -> float:
        return edges(self.spider).area * (diameter / 2) ** 2

    def outline(self, diameter: float) -> tuple[Contour, ...]:
        return (*self.without_vanes.outline(diameter), *_drawn_vanes(self.spider, diameter))

    @classmethod
    def from_outline(cls, outline: tuple[Contour, ...], tolerance: float) -> tuple[Self, float] | None:
        return None

    def coverage(self, offsets: Tensor, cell: Tensor, diameter: float) -> Tensor:
        ring = self.without_vanes.coverage(offsets, cell, diameter)
        along, across = (offsets.new_tensor(axis) for axis in self.spider.frames())
        ahead, aside = (offsets @ axis.T for axis in (along, across))  # (..., V)
        half = self.vane_width * diameter / 2
        strip = half_plane_coverage(half - aside, across, cell) - half_plane_coverage(-half - aside, across, cell)
        return ring * (1 - strip * half_plane_coverage(ahead, along, cell)).prod(-1)

    def otf(self, shift: Tensor, diameter: float) -> Tensor:
        return vaned_otf(shift * (2 / diameter), self.spider)

    def quadrature(self, degree: int, diameter: float) -> tuple[Tensor, Tensor]:
        points, weights = sector_quadrature(self.spider, degree)
        return torch.from_numpy(points * (diameter / 2)), torch.from_numpy(weights)

    def amplitude(self, frequency: Array, diameter: float) -> Array:
        vanes = vane_transform(self.spider, frequency * (diameter / 2)) * (diameter / 2) ** 2
        return (super().amplitude(frequency, diameter) * super().area(diameter) - vanes) / self.area(diameter)


def _drawn_vanes(spider: Spider, diameter: float) -> list[Corners]:
    """Return each vane as a rectangle from the centre to where both of its sides meet the rim."""
    half, end = spider.half_width, math.sqrt(1 - spider.half_width**2)
    corners = diameter / 2 * np.array([[0.0, -half], [end, -half], [end, half], [0.0, half]])
    return [Corners(corners @ np.stack(axes)) for axes in zip(*spider.frames(), strict=True)]


def require_vanes(obstruction: float, width: float, angles: tuple[float, ...]) -> None:
    """Raise ValueError if a telescope cannot have these vanes; the arguments are those of `TelescopePupil`.

    Numbers must be in range, neighbouring vanes must leave an opening between them, and vanes that are wider than the
    obstruction must not leave more than half a turn free, because one of them would then end in the open.
    """
    if not 0 <= obstruction < 1:
        raise ValueError(f"obstruction is {obstruction}: it must be a fraction of the diameter, at least 0 and below 1")
    if not 0 < width < 1:
        raise ValueError(f"vane_width is {width}: it must be a fraction of the diameter, above 0 and below 1")
    if not angles or not all(math.isfinite(angle) for angle in angles):
        raise ValueError(f"vane_angles are {angles}: at least one finite angle is needed, in rad")
    gaps = Spider.of(obstruction, width, angles).gaps()
    if math.sin(min(*gaps, math.pi) / 2) <= width:
        raise ValueError(
            f"vanes {math.degrees(min(gaps)):.4g} degrees apart, of a width of {width:.4g} of the diameter, leave no "
            "opening between them: make them thinner, or fewer"
        )
    if width > obstruction and max(gaps) > math.pi * (1 + 1e-9):
        raise ValueError(
            f"vanes of {width:.4g} of the diameter are wider than the central obstruction, of {obstruction:.4g}, and "
            "leave half of the pupil free: give the obstruction that holds them"
        )
