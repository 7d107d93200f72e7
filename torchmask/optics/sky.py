"""Directions on the sky, from the cards of a FITS header."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np

from torchmask.io import extra

_CELESTIAL = re.compile(
    r"WCSAXES|CRPIX[12]|CRVAL[12]|CTYPE[12]|CUNIT[12]|CDELT[12]|CROTA[12]|CD[12]_[12]|PC[12]_[12]|P[VS][12]_\d+"
    r"|LONPOLE|LATPOLE|RADESYS|EQUINOX|[AB]P?_(ORDER|DMAX|\d+_\d+)"
)


def pixel_matrix(header: Any) -> np.ndarray | None:
    """Return the matrix (2, 2) that converts pixels (x, y) to (east, north) [rad], or None if the header has none.

    It is read from CD, PC and CDELT, or CROTA and CDELT. Sky axes in reverse order, DEC before RA, are swapped.
    """
    with extra("data"):
        from astropy.io.fits import Header
        from astropy.wcs import WCS

    if not any(name in header for name in ("CD1_1", "CD1_2", "CDELT1")):
        return None
    cards = Header()
    for name, value in celestial_cards(header).items():
        cards[name] = value
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # astropy warns when it corrects old-fashioned cards
            wcs = WCS(cards, naxis=2)
            if not all(str(unit) for unit in wcs.wcs.cunit):  # plain pixel coordinates, not the sky
                return None
            scale = [unit.to("rad") for unit in wcs.wcs.cunit]
            matrix = np.diag(scale) @ wcs.pixel_scale_matrix
            if wcs.wcs.lng > wcs.wcs.lat >= 0:
                matrix = matrix[::-1].copy()
    except (ValueError, TypeError, AttributeError, MemoryError):  # senseless cards, units that are not angles
        return None
    return matrix if np.isfinite(matrix).all() and np.linalg.det(matrix) != 0 else None


def celestial_cards(header: Any) -> dict[str, Any]:
    """Return the cards of a header's two sky axes."""
    cards = {name: header[name] for name in header if _CELESTIAL.fullmatch(name)}
    if "WCSAXES" in cards:
        cards["WCSAXES"] = 2  # without a cube's third axis
    return cards
