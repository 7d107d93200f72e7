"""Interpretation of FITS headers: pixel scale, wavelength, exposure time, gain, read-out noise and units.

An option given by the caller takes precedence over the header; if both are missing, the error names both.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from torchmask.grid import ARCSEC
from torchmask.io import extra
from torchmask.numbers import require_wavelength
from torchmask.optics.band import FILTERS, filter_of_header
from torchmask.optics.pixel import PixelResponse, square_pixel
from torchmask.optics.sky import celestial_cards, pixel_matrix
from torchmask.optics.sky_scale import MATRIX, difference, is_same, side_of, stated_side

# Sensitive fraction of a pixel's area, by INSTRUME. NIRISS and NIRCam have H2RG detectors of Teledyne (Goudfrooij et
# al., PASP 136, 2024, doi:10.1088/1538-3873/ad1c98), whose pixels of HgCdTe fill their pitch (Beletic, Laser Focus
# World, October 2007). Charge that spreads to neighbours blurs a little more, by a share that depends on the light.
PIXEL_FILL = {"NIRISS": 1.0, "NIRCAM": 1.0}

_PIXEL_SIDES = ("PIXELSCL", "PIXSCALE")  # [arcsec]

_ABOUT = ("OBJECT", "TARGNAME", "TARG_RA", "TARG_DEC", "RA", "DEC", "TELESCOP", "INSTRUME", "FILTER", "DATE-OBS")
_ABOUT += ("TIME-OBS", "MJD-OBS", "MJD-AVG", "OBSERVER")


def missing(path: Any, keywords: str, option: str) -> ValueError:
    """Return the error for a number that neither the header nor the caller supplies."""
    return ValueError(f"{path} has no {keywords}: give {option}")


def number(header: Any, names: tuple[str, ...], path: Any) -> float | None:
    """Return the first of these cards that is present, as a number of at least 0; None if there is none.

    Raises ValueError if the card is not such a number.
    """
    if (name := first_card(header, names)) is not None:
        value = header[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or value < 0:
            raise ValueError(f"{path}: {name} is {value!r}, which is not a positive number")
        return float(value)
    return None


def first_card(header: Any, names: tuple[str, ...]) -> str | None:
    """Return the first of these names that the header has a value for, or None."""
    return next((name for name in names if header.get(name) is not None), None)


def pixel_scale(header: Any, path: Any, given: float | None, fallback: float | None = None) -> float:
    """Return the pixel scale [rad]: PIXELSCL or PIXSCALE [arcsec], else the square root of a pixel's area by the WCS.

    Without either it is `fallback`. Warns if both are there and differ by more than 1 %.

    Raises ValueError if that is None too, or if pixels differ from squares by more than 2 %.
    """
    if given is not None:
        return given
    matrix = pixel_matrix(header)
    if arcsec := number(header, _PIXEL_SIDES, path):
        side = arcsec * ARCSEC if matrix is None else side_of(matrix)
        if not is_same(side, arcsec * ARCSEC):
            warnings.warn(
                f"{path}: {first_card(header, _PIXEL_SIDES)} is {arcsec:.5g} arcsec, which is taken, but {MATRIX} says "
                f"{difference(arcsec * ARCSEC, side)}: correct the wrong one, or give the pixel scale, which sky "
                "coordinates get too",
                stacklevel=3,
            )
        return arcsec * ARCSEC
    if matrix is None and fallback is not None:
        return fallback
    if matrix is None:
        raise missing(path, "PIXELSCL, CDELT or CD matrix in an angle", "pixel_scale [rad]")
    sides = np.linalg.norm(matrix, axis=0)
    if sides.max() / sides.min() > 1.02:
        raise ValueError(f"{path}: pixels of {sides[0] / ARCSEC:.4g} x {sides[1] / ARCSEC:.4g} arcsec are not square")
    return side_of(matrix)


def stated_scales(header: Any) -> dict[str, float | None]:
    """Return what a header says of the pixel scale [rad], by the cards that say it; None where they say nothing."""
    name = first_card(header, _PIXEL_SIDES)
    value = header[name] if name else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value > 0):
        return {MATRIX: stated_side(header)}
    return {str(name): value * ARCSEC, MATRIX: stated_side(header)}


def wavelength(header: Any, path: Any, given: float | None, fallback: float | None = None) -> float:
    """Return the wavelength [m]: WAVELEN or WAVELNTH, else that of a known INSTRUME and FILTER, else `fallback`.

    Raises ValueError if there is none of these, or the card cannot be in metres. See `FILTERS` for the known filters.
    """
    if given is not None:
        return given
    names = ("WAVELEN", "WAVELNTH")
    value = number(header, names, path)
    if value is not None:
        try:
            require_wavelength(f"{path}: {first_card(header, names)}", value)
        except ValueError as error:
            raise ValueError(f"{error}; correct it, or give wavelength [m]") from error
        return value
    band = filter_of_header(header)
    if band is not None:
        return band.wavelength
    if fallback is not None:
        return fallback
    instrument, name = (str(header.get(card, "")).strip().upper() for card in ("INSTRUME", "FILTER"))
    known = ", ".join(" ".join(names) for names in FILTERS)
    what = f" (FILTER is {name!r} of INSTRUME {instrument!r}; known: {known})" if name else ""
    raise missing(path, "WAVELEN, nor a FILTER that is known", f"wavelength [m]{what}")


def pixel_response(header: Any) -> PixelResponse | None:
    """Return the response of the pixels of a known INSTRUME, see `PIXEL_FILL`; None, that is points, for others."""
    return square_pixel(PIXEL_FILL.get(str(header.get("INSTRUME", "")).strip().upper(), 0.0))


def exposure_seconds(header: Any, path: Any, is_cube: bool, given: float | None) -> float | None:
    """Return the exposure time of a frame [s]: EFFINTTM (of one integration) for a cube, XPOSURE, EXPTIME, EFFEXPTM."""
    if given is not None:
        return given
    return number(header, ("EFFINTTM",) * is_cube + ("XPOSURE", "EXPTIME", "EFFEXPTM"), path)


def saturation(header: Any, path: Any, electrons_per_unit: float, given: float | None) -> float | None:
    """Return the value in the file at which a pixel saturates: the lower of SATURATE and FULLWELL [electrons].

    None if the header has neither.
    """
    if given is not None:
        return given
    level, well = number(header, ("SATURATE",), path), number(header, ("FULLWELL",), path)
    levels = ([level] if level else []) + ([well / electrons_per_unit] if well else [])
    return min(levels, default=None)


def closed_shutter(header: Any) -> str | None:
    """Return the header's statement that no light fell on the detector (dark, bias, closed shutter), or None."""
    for name in ("IMAGETYP", "OBSTYPE", "IMAGE_TYPE", "EXP_TYPE", "ESO DPR TYPE"):
        words = re.split(r"[^a-z]+", str(header.get(name, "")).lower())
        if {"dark", "bias", "zero"} & set(words):
            return f"{name} is {header[name]!r}"
    if str(header.get("SHUTTER", "")).strip().lower() in ("closed", "close", "shut"):
        return f"SHUTTER is {header['SHUTTER']!r}"
    return None


def electrons_per_unit(
    header: Any, path: Any, is_cube: bool, unit: str | None, gain: float | None, exposure_time: float | None
) -> float:
    """Return the number of electrons in a frame for one unit of the file.

    `unit`, or else BUNIT, may be electrons or photons; adu, DN or counts (times the gain); any of these per second
    (times the exposure time of a frame); or MJy/sr (by JWST's PHOTMJSR). Without either it is adu if a gain is known.

    Raises ValueError if the unit is missing or unknown, a number for its conversion is missing, or a gain is given for
    electrons or photons.
    """
    with extra("data"):
        from astropy import units

    text = unit or str(header.get("BUNIT", "")).strip()
    given, gain = gain, (number(header, ("EGAIN", "GAIN"), path) or None) if gain is None else gain
    if not text:
        if gain is not None:
            return gain
        raise missing(path, "BUNIT and no GAIN", "gain [electrons per adu]; if pixels are not in adu, give unit")

    def electrons(counted: Any) -> float:
        if counted in (units.electron, units.photon):
            if given is not None:
                raise ValueError(
                    f"gain is {given:g}, in electrons per adu, but the unit of {path} is {text}: leave it out, or give "
                    "unit as adu"
                )
            return 1.0
        if gain is None:
            raise missing(path, f"GAIN or EGAIN, which its unit {text} needs", "gain [electrons per adu]")
        return gain

    def seconds() -> float:
        time = exposure_seconds(header, path, is_cube, exposure_time)
        if not time:
            raise missing(path, f"XPOSURE or EXPTIME, which its unit {text} needs", "exposure_time [s]")
        return time

    measured = _parse_unit(text, path)
    radiance = units.MJy / units.sr
    if measured.is_equivalent(radiance):
        per_dn = number(header, ("PHOTMJSR",), path)
        if not per_dn:
            raise missing(path, f"PHOTMJSR, which its unit {text} needs", "unit, such as '250 electron'")
        return measured.to(radiance) / per_dn * seconds() * electrons(units.DN)
    for counted in _counted_units():
        if measured.is_equivalent(counted):
            return measured.to(counted) * electrons(counted)
        if measured.is_equivalent(counted / units.s):
            return measured.to(counted / units.s) * seconds() * electrons(counted)
    raise _unknown_unit(text, path)


def counts_time(header: Any, path: Any, unit: str | None) -> bool:
    """Return whether pixels grow with the exposure time: `unit`, or else BUNIT, is not per second, or there is none.

    Raises ValueError if the unit is unknown.
    """
    text = unit or str(header.get("BUNIT", "")).strip()
    return not text or any(_parse_unit(text, path).is_equivalent(counted) for counted in _counted_units())


def _counted_units() -> tuple[Any, ...]:
    with extra("data"):
        from astropy import units

    return units.electron, units.photon, units.adu, units.DN, units.count


def _parse_unit(text: str, path: Any) -> Any:
    with extra("data"):
        from astropy import units

    plain = re.sub(r"(electron|count|photon|adu)s\b", r"\1", text.lower())
    plain = re.sub(r"\be-(?=\W|$)", "electron", plain)
    plain = re.sub(r"/\s*sec\w*", "/s", plain)
    for candidate in (text, plain):
        try:
            return units.Unit(candidate)
        except (ValueError, TypeError):
            continue
    raise _unknown_unit(text, path)


def _unknown_unit(text: str, path: Any) -> ValueError:
    return ValueError(
        f"{path}: unit {text!r} is unknown: give unit as electron, photon, adu, DN or count, any of them per s, or "
        "MJy/sr"
    )


def kept_cards(header: Any) -> dict[str, Any]:
    """Return the cards to keep with an observation: sky coordinates, target, telescope, filter and date."""
    return celestial_cards(header) | {name: header[name] for name in _ABOUT if name in header}


def common_cards(headers: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the cards of the first header, with the sky coordinates of the first that has any."""
    first = headers[0]
    placed = next((header for header in headers if pixel_matrix(header) is not None), first)
    own = celestial_cards(first)
    return celestial_cards(placed) | {name: value for name, value in first.items() if name not in own}


def shift_cards(cards: dict[str, Any], x: int, y: int) -> dict[str, Any]:
    """Return the cards for an image that begins at pixel (x, y), counted from 0, of the original one."""
    moved = dict(cards)
    for name, offset in (("CRPIX1", x), ("CRPIX2", y)):
        if name in cards:
            moved[name] = float(cards[name]) - offset
    return moved
