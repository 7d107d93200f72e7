"""Sky coordinates at the scale of the pixels: a header says how the sky lies, and the pixel scale how fine it is."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from torchmask.grid import ARCSEC
from torchmask.optics.sky import pixel_matrix

SAME_SCALE = 0.01  # relative difference of two statements of the pixel scale that is no contradiction
MATRIX = "the CD matrix or CDELT"

_SCALES = re.compile(r"CD[12]_[12]|CDELT[12]")


def side_of(matrix: np.ndarray) -> float:
    """Return the side of a square pixel of the same area [rad], from the matrix of a pixel on the sky [rad]."""
    return math.sqrt(abs(np.linalg.det(matrix)))


def stated_side(header: Any) -> float | None:
    """Return the side of a pixel [rad] by the sky coordinates of a header, or None if it has none."""
    matrix = pixel_matrix(header) if header else None
    return None if matrix is None else side_of(matrix)


def is_same(one: float, other: float) -> bool:
    """Return whether two pixel scales differ by no more than statements of one may, which is 1 %."""
    return abs(one / other - 1) <= SAME_SCALE


def matrix_at(header: Any, pixel_scale: float) -> np.ndarray | None:
    """Return the matrix (2, 2) from pixels to the sky [rad], at this scale if that of the header contradicts it."""
    matrix = pixel_matrix(header)
    if matrix is None or is_same(side_of(matrix), pixel_scale):
        return matrix
    return matrix * (pixel_scale / side_of(matrix))


def cards_at(cards: Mapping[str, Any], pixel_scale: float) -> dict[str, Any]:
    """Return cards whose sky coordinates keep their orientation and get this pixel scale [rad].

    >>> cards = {"CDELT1": -0.25, "CDELT2": 0.25, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}
    >>> round(cards_at(cards, 0.5 * ARCSEC)["CDELT1"], 12)
    -0.5
    """
    side = stated_side(cards)
    if side is None or math.isclose(side, pixel_scale, rel_tol=1e-9):  # rounding changes no digit of a header
        return dict(cards)
    ratio = pixel_scale / side
    scales = {name: value * ratio for name, value in cards.items() if _SCALES.fullmatch(name)}
    return dict(cards) | scales


def difference(taken: float, other: float) -> str:
    """Return another pixel scale [rad] in words, and by how much it differs from the one that is taken."""
    excess = 100 * (other / taken - 1)
    return f"{other / ARCSEC:.5g} arcsec, {abs(excess):.1f} % {'more' if excess > 0 else 'less'}"


def warn_of_other_scales(
    path: Any, given: float, stated: Mapping[str, float | None], also: str = "", stacklevel: int = 3
) -> None:
    """Warn if the file states a pixel scale [rad] that contradicts the one that is given.

    `stated` has the file's own statements by their names, None where it makes none; `also` ends the name of the file.
    """
    others = [
        f"{name} says {difference(given, scale)}"
        for name, scale in stated.items()
        if scale is not None and not is_same(scale, given)
    ]
    if others:
        warnings.warn(
            f"{path}{also}: the pixel scale that is given, {given / ARCSEC:.5g} arcsec, is taken, for sky coordinates "
            f"too, but {' and '.join(others)}: see which is right",
            stacklevel=stacklevel,
        )
