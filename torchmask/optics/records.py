"""Apertures as the names and numbers that files hold, from version 0.1 on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pupil import Aperture
from torchmask.optics.shapes import named_shape


def aperture_record(aperture: Aperture) -> dict[str, Any]:
    """What a file must hold of an aperture: the name of its shape, numbers in SI units, and the centres as a tensor."""
    return {
        "shape": aperture.shape.name,
        **aperture.shape.parameters,
        "subaperture_diameter": aperture.subaperture_diameter,
        "mask_diameter": aperture.mask_diameter,
        "centers": aperture.centers.detach(),
    }


def read_mask(record: Mapping[str, Any]) -> SparseAperture:
    """The mask that an `aperture_record` describes; without a shape its holes are discs, and other keys are ignored.

    Raises
    ------
    ValueError, LookupError
        If the record describes no mask.
    """
    shape = named_shape(str(record.get("shape", "disc")), record)
    hole, mask = float(record["subaperture_diameter"]), float(record["mask_diameter"])
    return SparseAperture(record["centers"], hole, mask, shape)


def read_aperture(record: Mapping[str, Any]) -> Aperture:
    """The mask or full pupil that an `aperture_record` describes.

    A single round hole at the origin is a full pupil of its own diameter, whatever mask_diameter says. Version 0.1 kept
    its obstruction apart from the shape.

    Raises
    ------
    ValueError, LookupError
        If the record describes no aperture.
    """
    mask = read_mask(record)
    if not (mask.is_full and mask.shape.is_round) or bool(mask.centers.any()):
        return mask
    obstruction = mask.shape.parameters.get("obstruction", float(record.get("central_obstruction", 0.0)))
    return FullAperture(mask.subaperture_diameter, obstruction, dtype=mask.centers.dtype)
