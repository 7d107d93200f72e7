"""Writing drawings of masks for the workshop, as DXF and SVG, and reading DXF.

Drawings are in millimetres on the plate, `scale` millimetres for each metre of the pupil: 1000 is full size, and a mask
for a re-imaged pupil of 10 mm on an 8 m telescope has scale 10 / 8. As in the pupil, x is to the right and y up.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from torch import Tensor

from torchmask.io import atomic_write, extra
from torchmask.numbers import WIDEST
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.overlaps import require_apart
from torchmask.optics.shape_base import Array, Circle, Contour, Corners, Shape
from torchmask.optics.shapes import outlined_shape
from torchmask.plain import require_type

LIFE_SIZE = 1000.0  # [mm on the plate for a metre of the pupil]
_SCALE = "torchmask mm per m"
_BEYOND = 0.1  # of its diameter: holes of some real masks reach 0.05 beyond their nominal pupil
_NANOMETRE = 1e-6  # [mm], tolerance for rounding
_UNITS = {0: 1.0, 1: 25.4, 2: 304.8, 4: 1.0, 5: 10.0, 6: 1e3, 9: 0.0254, 10: 914.4, 13: 1e-3, 14: 100.0}
"""Millimetres in the units of length of a plate, by their number in DXF ($INSUNITS); 0 is a drawing without units."""


def save_dxf(
    path: str | Path, aperture: SparseAperture, scale: float = LIFE_SIZE, *, allow_overlap: bool = False
) -> None:
    """Write a DXF drawing, with holes as circles or closed polylines on layer HOLES and the rim on layer OUTLINE.

    Parameters
    ----------
    path : str or Path
        Name of the new file.
    aperture : SparseAperture
        One mask.
    scale : float
        Millimetres on the plate for one metre of the pupil; stored in the drawing for `load_mask`.
    allow_overlap : bool
        Whether holes may overlap, which are one hole on the plate.

    Raises
    ------
    ValueError
        If `path` exists, its folder does not, the aperture is a population of masks, its holes overlap by more than a
        millionth of its diameter and `allow_overlap` is not given, or `scale` is not finite and positive.
    """
    with extra("design"):
        import ezdxf
        import ezdxf.units

    centers = require_one_mask(aperture).double() * require_scale(scale)
    require_apart(aperture, allow_overlap)
    drawing = ezdxf.new("R2010", units=ezdxf.units.MM)  # pyright: ignore[reportPrivateImportUsage]
    drawing.header.custom_vars.append(_SCALE, repr(float(scale)))
    for layer in ("HOLES", "OUTLINE"):
        drawing.layers.add(layer)
    plate = drawing.modelspace()
    plate.add_circle((0, 0), aperture.mask_diameter * scale / 2, dxfattribs={"layer": "OUTLINE"})
    for x, y in centers.tolist():
        for contour in aperture.shape.outline(aperture.subaperture_diameter * scale):
            if isinstance(contour, Circle):
                plate.add_circle((x, y), contour.radius, dxfattribs={"layer": "HOLES"})
            else:
                plate.add_lwpolyline((contour.points + [x, y]).tolist(), close=True, dxfattribs={"layer": "HOLES"})
    text = io.StringIO()
    drawing.write(text)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode(drawing.output_encoding))


def save_svg(
    path: str | Path, aperture: SparseAperture, scale: float = LIFE_SIZE, *, allow_overlap: bool = False
) -> None:
    """Write an SVG drawing in true size, with the rim and the holes as hairlines. Its unit is the millimetre.

    SVG's y axis points down, so y is written with its sign reversed, and the picture shows y up. Arguments and errors
    are those of `save_dxf`.
    """
    centers = require_one_mask(aperture).double() * require_scale(scale)
    require_apart(aperture, allow_overlap)
    width = 1.02 * scale * max(aperture.mask_diameter, 2 * aperture.reach)
    svg = ElementTree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        width=f"{width}mm",
        height=f"{width}mm",
        viewBox=f"{-width / 2} {-width / 2} {width} {width}",
    )
    ElementTree.SubElement(svg, "title").text = f"Aperture mask of {aperture.n_subapertures} holes"
    ElementTree.SubElement(svg, "desc").text = f"Millimetres on the plate, {scale!r} for each metre of the pupil."
    style = {"fill": "none", "stroke": "black", "stroke-width": f"{width / 2000}"}
    radius = f"{aperture.mask_diameter * scale / 2}"
    ElementTree.SubElement(svg, "circle", {"id": "outline", "cx": "0", "cy": "0", "r": radius, **style})
    holes = ElementTree.SubElement(svg, "g", {"id": "holes", **style})
    for x, y in centers.tolist():
        for contour in aperture.shape.outline(aperture.subaperture_diameter * scale):
            if isinstance(contour, Circle):
                ElementTree.SubElement(holes, "circle", {"cx": f"{x}", "cy": f"{-y}", "r": f"{contour.radius}"})
            else:
                points = " ".join(f"{x + dx},{-(y + dy)}" for dx, dy in contour.points.tolist())
                ElementTree.SubElement(holes, "polygon", points=points)
    with atomic_write(path) as file:
        ElementTree.ElementTree(svg).write(file, encoding="utf-8", xml_declaration=True)


def load_dxf(path: Path) -> SparseAperture:
    """Read a mask, float64, from a drawing written by `save_dxf`, including changes made in a CAD program.

    Such a program may have converted it to other units of length, and moved it as a whole: centres count from the
    middle of the rim. A drawing without units is in millimetres.

    Raises
    ------
    ValueError
        If the file is damaged, its unit is none of a plate, or it does not show a mask of known, equal holes.
    """
    with extra("design"):
        import ezdxf
        import ezdxf.units

    try:
        drawing = ezdxf.readfile(path)  # pyright: ignore[reportPrivateImportUsage]
    except (ezdxf.DXFError, StopIteration) as error:  # pyright: ignore[reportPrivateImportUsage]
        raise ValueError(str(error) or "the drawing ends too early") from error
    noted = drawing.header.custom_vars.get(_SCALE)
    if noted is None:
        raise ValueError(f"the drawing does not give its scale: set its custom property {_SCALE!r}")
    scale = require_scale(float(noted))
    unit = _UNITS.get(drawing.units)
    if unit is None:
        raise ValueError(
            f"the drawing is in {ezdxf.units.unit_name(drawing.units)}: set its unit, $INSUNITS, to one of a plate, "
            "such as 4 for mm or 1 for inches"
        )
    plate = drawing.modelspace()
    rims = list(plate.query('CIRCLE[layer=="OUTLINE"]'))
    if len(rims) != 1:
        raise ValueError(f"layer OUTLINE holds {len(rims)} circles: one is needed, the rim of the mask")
    outlines = _drawn_holes(plate, unit)
    if not outlines:
        raise ValueError("layer HOLES is empty: a mask has at least one hole")
    holes = [outlined_shape(tuple(outline), _NANOMETRE) for _, outline in outlines]
    shape, diameter = holes[0]
    if not all(_alike(holes[0], hole) for hole in holes):
        kinds = ", ".join(sorted({str(hole[0]) for hole in holes}))
        raise ValueError(f"its holes differ by more than 1 nm or 1e-6 ({kinds}): all must be equal")
    middle, _ = _measured(rims[0], unit)
    centers = torch.tensor(np.stack([center - middle for center, _ in outlines])) / scale
    return SparseAperture(centers, diameter / scale, 2 * unit * rims[0].dxf.radius / scale, shape)


def _drawn_holes(plate: Any, unit: float) -> list[tuple[Array, list[Contour]]]:
    """Return centre [mm] and outline of each hole, drawn in units of so many mm.

    Contours with the same centre belong to one hole.
    """
    holes: list[tuple[Array, list[Contour]]] = []
    for entity in plate.query('CIRCLE LWPOLYLINE[layer=="HOLES"]'):
        center, contour = _measured(entity, unit)
        same = [outline for other, outline in holes if np.abs(center - other).max() < _NANOMETRE]
        if same:
            same[0].append(contour)
        else:
            holes.append((center, [contour]))
    return holes


def _measured(entity: Any, unit: float) -> tuple[Array, Contour]:
    """Return the centre [mm] of a circle or polyline drawn in units of so many mm, and its contour relative to it."""
    if entity.dxftype() == "CIRCLE":
        return unit * np.array([entity.dxf.center.x, entity.dxf.center.y]), Circle(unit * entity.dxf.radius)
    corners = unit * np.array([corner[:2] for corner in entity.vertices()])
    return corners.mean(0), Corners(corners - corners.mean(0))


def _alike(hole: tuple[Shape, float], other: tuple[Shape, float]) -> bool:
    numbers, others = ([diameter, *shape.parameters.values()] for shape, diameter in (hole, other))
    return hole[0].name == other[0].name and np.allclose(numbers, others, rtol=0, atol=_NANOMETRE)


def require_one_mask(aperture: SparseAperture) -> Tensor:
    """Return the centres (N, 2) of one mask, on the CPU.

    Raises TypeError or ValueError for anything else, a diameter that no mask has, and holes far outside it.
    """
    require_type("aperture", aperture, SparseAperture)
    if aperture.centers.ndim != 2:
        raise ValueError(
            f"centers has shape {tuple(aperture.centers.shape)}: a file holds one mask, (n_subapertures, 2)"
        )
    if aperture.mask_diameter > WIDEST:
        raise ValueError(f"mask_diameter is {aperture.mask_diameter:g} m: give lengths in m, not in mm")
    beyond = aperture.reach - aperture.mask_diameter / 2
    if not beyond <= _BEYOND * aperture.mask_diameter:
        raise ValueError(
            f"holes reach {beyond:.4g} m beyond the rim of a mask_diameter of {aperture.mask_diameter:.4g} m: correct "
            "it, or the centers, which are in m from the middle of the mask"
        )
    return aperture.centers.detach().cpu()


def require_scale(scale: float) -> float:
    """Return `scale` [mm on the plate for a metre of the pupil]; raises ValueError unless finite and positive."""
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(
            f"scale is {scale}: it must be finite and positive, in mm on the plate for a metre of the pupil"
        )
    return scale
