"""Filters of instruments: the bands of wavelengths that they let through."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Band(NamedTuple):
    """A filter's effective wavelength and its width [m]."""

    wavelength: float
    width: float


# Source: table of the aperture-masking filters in AMICAL (Soulain et al. 2020, SPIE 11446, 1144611), after STScI's
# NIRISS documentation.
FILTERS = {
    ("NIRISS", "F277W"): Band(2.776e-6, 0.715e-6),
    ("NIRISS", "F380M"): Band(3.828e-6, 0.205e-6),
    ("NIRISS", "F430M"): Band(4.286e-6, 0.202e-6),
    ("NIRISS", "F480M"): Band(4.817e-6, 0.298e-6),
}


def band_of_header(header: Mapping[str, Any]) -> Band | None:
    """The band that the FITS cards INSTRUME and FILTER name; None if it is not in `FILTERS`.

    Examples
    --------
    >>> band_of_header({"INSTRUME": "NIRISS", "FILTER": "F480M"})
    Band(wavelength=4.817e-06, width=2.98e-07)
    """
    instrument, name = (str(header.get(card, "")).strip().upper() for card in ("INSTRUME", "FILTER"))
    return FILTERS.get((instrument, name))
