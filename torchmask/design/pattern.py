"""The pattern of a mask apart from its size, to be laid into any pupil."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.shapes import Disc, Shape


@dataclass(frozen=True)
class Pattern:
    """Where the holes of a mask lie, and the mask as built.

    name : by which it is called in rankings and errors
    centers : (N, 2) in any unit
    shape : of the holes
    built : the mask as built, of any diameter; None if it has no size of its own
    unbuilt : why it has none

    Raises ValueError for anything but one mask of at least two holes: a single one has no pattern.
    """

    name: str
    centers: np.ndarray
    shape: Shape
    built: SparseAperture | None
    unbuilt: str = "it has no size of its own"

    def __post_init__(self) -> None:
        if self.centers.ndim != 2 or len(self.centers) < 2:
            shape = self.centers.shape
            raise ValueError(
                f"{self.name} has centers of shape {shape}: one mask of at least two holes is needed, (N, 2)"
            )

    @classmethod
    def from_catalog(cls, name: str) -> Pattern:
        """Return a mask of the catalogue. Raises ValueError for an unknown name."""
        entry = catalog.entry(name)
        built = SparseAperture.from_catalog(entry.name) if entry.as_built else None
        unbuilt = cls.unbuilt if entry.pupil_diameter is None else "no source gives the diameter of its holes"
        return cls(entry.name, np.array(entry.centers), entry.shape, built, unbuilt)

    @classmethod
    def of(cls, name: str, aperture: SparseAperture) -> Pattern:
        """Return the pattern of a mask, such as one from a file."""
        return cls(name, aperture.centers.detach().cpu().numpy(), aperture.shape, aperture)

    def scaled(self, mask_diameter: float) -> SparseAperture | None:
        """Return the mask as built, scaled to a mask diameter [m]; None if it has no size of its own."""
        if self.built is None:
            return None
        scale = mask_diameter / self.built.mask_diameter
        hole = scale * self.built.subaperture_diameter
        return SparseAperture(scale * self.built.centers, hole, mask_diameter, self.shape)

    def largest_fill_factor(self) -> float:
        """Return the largest N d^2 / D^2, in the area of round holes, at which the holes do not overlap.

        With gap m between the closest centres and radius R of their enclosing circle, holes of size d and outer size
        c d fit if d <= m s and c d + 2 R s <= D for some scale s.
        """
        _, radius = catalog.smallest_enclosing_circle(self.centers)
        first, second = np.triu_indices(len(self.centers), 1)
        gap = float(self.shape.separation(torch.from_numpy(self.centers[first] - self.centers[second])).min())
        relative = gap / (2 * radius + self.shape.outer_diameter(gap))
        return len(self.centers) * relative**2 * self._area_over_disc

    def afresh(self, mask_diameter: float, fill_factor: float, rim_margin: float = 0.0) -> SparseAperture:
        """Return the pattern fitted into a disc [m] with holes of the area of round ones with N d^2 / D^2.

        Its smallest enclosing circle is centred, and its outermost holes are the margin [m] off the rim. Raises
        ValueError if its holes would overlap, and says how large a fill factor it can carry.
        """
        if not (math.isfinite(fill_factor) and fill_factor > 0):
            raise ValueError(f"fill_factor is {fill_factor}: it must be finite and positive")
        inner = mask_diameter - 2 * rim_margin
        if not inner > 0:
            raise ValueError(f"rim_margin is {rim_margin} m: it leaves nothing of a mask of {mask_diameter:g} m")
        most = self.largest_fill_factor() * (inner / mask_diameter) ** 2
        if fill_factor > most:
            raise ValueError(f"its holes would overlap: it carries a fill factor of at most {most:.4g}")
        hole = mask_diameter * math.sqrt(fill_factor / self._area_over_disc / len(self.centers))
        middle, radius = catalog.smallest_enclosing_circle(self.centers)
        room = (inner - self.shape.outer_diameter(hole)) / 2
        centers = torch.from_numpy((self.centers - middle) * (room / radius))
        return SparseAperture(centers, hole, mask_diameter, self.shape)

    @property
    def _area_over_disc(self) -> float:
        return self.shape.area(1.0) / Disc().area(1.0)
