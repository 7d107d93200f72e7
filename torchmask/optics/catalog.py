"""Aperture masks that exist or are published designs: hole coordinates, hole sizes and their sources.

The data are in `masks.json` beside this file. Centres are (x, y) in the frame of the source, x to the right and y up,
in metres on the primary mirror; `mirrored` reverses x, because sources differ in the side from which they look. Golay
arrays have no size of their own: their unit is the pitch of a hexagonal lattice, on which their coordinates are integer
multiples of (1/2, sqrt(3)/6) and therefore exact.
"""

from __future__ import annotations

import difflib
import json
import math
import re
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchmask.optics.shapes import Shape, named_shape


@dataclass(frozen=True)
class CatalogEntry:
    """One mask of the catalogue, as its source gives it.

    name : canonical name, see `names`
    unit : "m", "lattice" (the pitch of a hexagonal lattice) or "outer radius"
    centers : (x, y) of each hole, in `unit`
    shape : shape of the holes
    hole_diameter : diameter of a hole, flat to flat for hexagons [m]; None if no source gives it
    pupil_diameter : diameter of the telescope or of its stop [m]; None for arrays without a size of their own
    central_obstruction : diameter of the pupil's central obstruction [m]; None if not given
    source : source of the centres
    hole_source : source of the hole diameter
    note : remarks for the user
    """

    name: str
    unit: str
    centers: tuple[tuple[float, float], ...]
    shape: Shape
    hole_diameter: float | None
    pupil_diameter: float | None
    central_obstruction: float | None
    source: str
    hole_source: str
    note: str

    @property
    def n_subapertures(self) -> int:
        """Number of holes."""
        return len(self.centers)

    @property
    def as_built(self) -> bool:
        """Whether positions and hole diameter are known in metres."""
        return self.hole_diameter is not None and self.pupil_diameter is not None


def names() -> list[str]:
    """Return the canonical names of all masks of the catalogue.

    Examples
    --------
    >>> names()[:3]
    ['golay3', 'golay6', 'golay9']
    """
    return list(_entries())


def entry(name: str) -> CatalogEntry:
    """Return the entry called `name`, ignoring case, spaces and punctuation ("Golay-6" is "golay6").

    Raises
    ------
    ValueError
        If no mask has this name; the message lists the known ones.

    Examples
    --------
    >>> mask = entry("JWST NIRISS AMI 7")
    >>> mask.n_subapertures, mask.shape, mask.hole_diameter
    (7, Hexagon(orientation=0.5235987755982988), 0.8)
    """
    known = _lookup()
    key = _plain(name)
    if key in known:
        return _entries()[known[key]]
    close = difflib.get_close_matches(key, known, n=1)
    hint = f"did you mean {known[close[0]]!r}? " if close else ""
    raise ValueError(f"no mask is called {name!r}: {hint}known masks are {', '.join(names())}")


def layout(
    name: str, mask_diameter: float | None = None, fill_factor: float | None = None, mirrored: bool = False
) -> dict[str, Any]:
    """Return the arguments of `SparseAperture` for a mask of the catalogue; see `SparseAperture.from_catalog`."""
    mask = entry(name)
    for label, value, unit in (
        ("mask_diameter", mask_diameter, ", in m"),
        ("fill_factor", fill_factor, ", N d^2 / D^2"),
    ):
        if value is not None and not (math.isfinite(value) and value > 0):
            raise ValueError(f"{label} is {value}: it must be finite and positive{unit}")
    centers = np.array(mask.centers)
    if mask_diameter is not None and fill_factor is not None:
        hole = mask_diameter * math.sqrt(fill_factor / mask.n_subapertures)
        centers = _fit(centers, mask_diameter, mask.shape.outer_diameter(hole))
    elif mask.pupil_diameter is None:
        raise ValueError(
            f"{mask.name} has no size of its own: give both mask_diameter [m] and fill_factor (N d^2 / D^2)"
        )
    else:
        scale = 1.0 if mask_diameter is None else mask_diameter / mask.pupil_diameter
        mask_diameter = scale * mask.pupil_diameter
        centers = scale * centers
        if fill_factor is not None:
            hole = mask_diameter * math.sqrt(fill_factor / mask.n_subapertures)
        elif mask.hole_diameter is not None:
            hole = scale * mask.hole_diameter
        else:
            raise ValueError(f"no source gives the hole diameter of {mask.name}: give fill_factor (N d^2 / D^2)")
    if mirrored:
        centers = centers * [-1.0, 1.0]
    return {
        "centers": centers,
        "subaperture_diameter": hole,
        "mask_diameter": mask_diameter,
        "shape": mask.shape.mirrored() if mirrored else mask.shape,
    }


def smallest_enclosing_circle(points: ArrayLike) -> tuple[NDArray[np.float64], float]:
    """Return centre (2,) and radius of the smallest circle around `points` (N, 2), exact up to rounding.

    The construction is incremental: a point outside the circle of those before it lies on the circle that includes it
    (E. Welzl, LNCS 555, 359, 1991).

    Examples
    --------
    >>> center, radius = smallest_enclosing_circle([[0, 0], [2, 0], [1, 0.5]])
    >>> center.tolist(), radius
    ([1.0, 0.0], 1.0)
    """
    points = np.asarray(points, dtype=np.float64)
    center, radius = points[0], 0.0

    def outside(point: NDArray[np.float64]) -> bool:
        return math.dist(point, center) > radius * (1 + 1e-13)

    for i, p in enumerate(points):
        if not outside(p):
            continue
        center, radius = p, 0.0
        for j, q in enumerate(points[:i]):
            if not outside(q):
                continue
            center, radius = (p + q) / 2, math.dist(p, q) / 2
            for r in points[:j]:
                if outside(r):
                    center = _circumcenter(p, q, r)
                    radius = max(math.dist(center, corner) for corner in (p, q, r))
    return center, radius


def _circumcenter(p: NDArray[np.float64], q: NDArray[np.float64], r: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the point at equal distances from three points that are not collinear."""
    a, b = q - p, r - p
    return p + np.linalg.solve(2 * np.stack([a, b]), [a @ a, b @ b])


def _fit(centers: NDArray[np.float64], mask_diameter: float, outer_diameter: float) -> NDArray[np.float64]:
    """Centre the smallest enclosing circle on the origin and let the outermost holes touch the mask's edge."""
    middle, radius = smallest_enclosing_circle(centers)
    room = (mask_diameter - outer_diameter) / 2
    if room <= 0:
        raise ValueError(
            f"holes of {outer_diameter:.4g} m leave no room in a mask of {mask_diameter:.4g} m: lower fill_factor"
        )
    return (centers - middle) * (room / radius)


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


@cache
def _lookup() -> dict[str, str]:
    """Return the canonical name for every known spelling."""
    known = {_plain(name): name for name in _entries()}
    for name, record in _data()["masks"].items():
        known.update({_plain(alias): name for alias in record.get("aliases", [])})
    return known


@cache
def _data() -> dict[str, Any]:
    return json.loads(files("torchmask.optics").joinpath("masks.json").read_text(encoding="utf-8"))


@cache
def _entries() -> dict[str, CatalogEntry]:
    return {name: _read(name, record) for name, record in _data()["masks"].items()}


def _read(name: str, record: dict[str, Any]) -> CatalogEntry:
    centers = np.array(record["centers"], dtype=np.float64)
    if record["unit"] == "lattice":
        centers = centers * [1 / 2, math.sqrt(3) / 6]
    hole = record.get("hole_diameter")
    if "corner_to_corner" in record:
        hole = record["corner_to_corner"] * math.sqrt(3) / 2
    return CatalogEntry(
        name=name,
        unit=record["unit"],
        centers=tuple((x, y) for x, y in centers.tolist()),
        shape=named_shape(
            record.get("shape", "disc"), {"orientation": math.radians(record.get("orientation_degrees", 0))}
        ),
        hole_diameter=hole,
        pupil_diameter=record.get("pupil_diameter"),
        central_obstruction=record.get("central_obstruction"),
        source=_expand(record["source"]),
        hole_source=_expand(record.get("hole_source", "")),
        note=record.get("note", ""),
    )


def _expand(source: str) -> str:
    """Replace the short names of sources by full references."""
    table = _data()["sources"]
    keys = "|".join(sorted(table, key=len, reverse=True))
    return re.sub(rf"(?<![\w-])({keys})(?![\w-])", lambda match: table[match[1]], source)
