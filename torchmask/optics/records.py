"""Conversion of apertures to and from the names and numbers in files, from version 0.1 on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pupil import Aperture
from torchmask.optics.shapes import TelescopePupil, named_shape


def aperture_record(aperture: Aperture) -> dict[str, Any]:
    """Return an aperture as values for a file: the name of its shape, numbers in SI units, and a tensor of centres."""
    return {
        "shape": aperture.shape.name,
        **aperture.shape.parameters,
        "subaperture_diameter": aperture.subaperture_diameter,
        "mask_diameter": aperture.mask_diameter,
        "centers": aperture.centers.detach(),
    }


def read_mask(record: Mapping[str, Any]) -> SparseAperture:
    """Return the mask that an `aperture_record` describes. Its holes are discs by default; other keys are ignored.

    Raises
    ------
    ValueError, LookupError
        If the record does not describe a mask.
    """
    shape = named_shape(str(record.get("shape", "disc")), record)
    hole, mask = float(record["subaperture_diameter"]), float(record["mask_diameter"])
    return SparseAperture(record["centers"], hole, mask, shape)


def read_aperture(record: Mapping[str, Any]) -> Aperture:
    """Return the mask or full pupil that an `aperture_record` describes.

    A single hole at the origin that is round, or a telescope's pupil with vanes, is a full pupil of its own diameter,
    whatever mask_diameter says. In files of version 0.1 the obstruction is not part of the shape.

    Raises
    ------
    ValueError, LookupError
        If the record does not describe an aperture.
    """
    mask = read_mask(record)
    shape, diameter, dtype = mask.shape, mask.subaperture_diameter, mask.centers.dtype
    if not mask.is_full or bool(mask.centers.any()):
        return mask
    if isinstance(shape, TelescopePupil):
        width = shape.vane_width * diameter
        return FullAperture(diameter, shape.obstruction, width, shape.vane_angles, dtype=dtype)
    if not shape.is_round:
        return mask
    obstruction = shape.parameters.get("obstruction", float(record.get("central_obstruction", 0.0)))
    return FullAperture(diameter, obstruction, dtype=dtype)
