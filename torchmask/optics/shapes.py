"""The known shapes of holes, found by their name in a file or by their outline in a drawing.

A new subclass of `Shape` or `Polygon` that has a name is known as soon as it is defined.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from torchmask.optics.polygons import Hexagon, Polygon, Square
from torchmask.optics.round import Annulus, Disc
from torchmask.optics.shape_base import Circle, Contour, Corners, Shape
from torchmask.optics.telescope_pupil import TelescopePupil

__all__ = [
    "Annulus",
    "Circle",
    "Contour",
    "Corners",
    "Disc",
    "Hexagon",
    "Polygon",
    "Shape",
    "Square",
    "TelescopePupil",
    "named_shape",
    "outlined_shape",
]


def named_shape(name: str, parameters: Mapping[str, Any]) -> Shape:
    """Return the shape called `name` with its parameters from `parameters`, whose other entries are ignored.

    Raises
    ------
    ValueError
        If no shape has this name, or a parameter is missing or invalid.

    Examples
    --------
    >>> named_shape("hexagon", {"orientation": 0.2, "subaperture_diameter": 0.1})
    Hexagon(orientation=0.2)
    """
    if name not in Shape.known:
        raise ValueError(f"shape is {name!r}: known shapes are {', '.join(Shape.known)}")
    kind = Shape.known[name]
    needed = [field.name for field in fields(kind)]
    given = {key: _as_parameter(parameters[key]) for key in needed if key in parameters}
    try:
        return kind(**given)
    except TypeError as error:
        raise ValueError(f"shape {name!r} needs {', '.join(needed)}: {error}") from error


def _as_parameter(value: Any) -> float | tuple[float, ...]:
    """Return a number, or several as a tuple, from whatever a file holds."""
    return tuple(float(one) for one in value) if np.ndim(value) and not isinstance(value, str) else float(value)


def outlined_shape(outline: tuple[Contour, ...], tolerance: float) -> tuple[Shape, float]:
    """Return the known shape and its diameter [m] that match an outline about the centre, up to `tolerance` [m].

    Raises
    ------
    ValueError
        If no known shape has this outline.
    """
    for kind in Shape.known.values():
        found = kind.from_outline(outline, tolerance)
        if found is not None:
            return found
    parts = " and ".join("a circle" if isinstance(c, Circle) else f"{len(c.points)} corners" for c in outline)
    raise ValueError(f"a hole with an outline of {parts} is none of the known shapes: {', '.join(Shape.known)}")
