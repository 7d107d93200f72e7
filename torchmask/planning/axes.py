"""The axes of a plan: numbers and sizes of holes, exposures and bands, and what of them is possible."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.optics.pupil import Aperture


def or_default(given: Sequence[float] | None, factors: Sequence[float], unit: float) -> tuple[float, ...]:
    """Return what is given, or else `factors` times the unit."""
    return tuple(factor * unit for factor in factors) if given is None else tuple(given)


def positive(name: str, values: tuple[float, ...], unit: str) -> tuple[float, ...]:
    """Return the values in rising order; ValueError unless they are different, finite and positive."""
    if not values or not all(math.isfinite(value) and value > 0 for value in values) or len(set(values)) < len(values):
        raise ValueError(f"{name} are {values}: at least one is needed, none twice, all finite and positive, in {unit}")
    return tuple(sorted(float(value) for value in values))


def whole(values: Sequence[int]) -> tuple[int, ...]:
    """Return numbers of holes in rising order; ValueError unless they are different, whole and at least 2."""
    if (
        not values
        or not all(float(value).is_integer() and value >= 2 for value in values)
        or len(set(values)) < len(values)
    ):
        raise ValueError(f"n_subapertures are {tuple(values)}: at least one is needed, none twice, whole, at least 2")
    return tuple(sorted(int(value) for value in values))


def bands_of(instrument: Instrument, widths: Sequence[float]) -> list[Instrument]:
    """Return the instrument with each band, on one grid: errors on different pixels cannot be compared."""
    scale = instrument.with_width(max(widths)).pixel_scale / ARCSEC
    known = replace(instrument, camera=replace(instrument.camera, pixel_scale=scale))
    return [known.with_width(width) for width in widths]


def at_exposures(instrument: Instrument, lengths: Sequence[float], left_out: list[str]) -> list[Instrument]:
    """Return the instrument at each exposure for which there is time."""
    found = []
    for exposure in lengths:
        try:
            found.append(instrument.with_exposure(exposure))
        except ValueError as error:
            left_out.append(str(error))
    return found


def sampled(bands: Sequence[Instrument], aperture: Aperture | None, left_out: list[str]) -> list[Instrument]:
    """Return the bands, from narrow to wide, in which pixels sample the image of the aperture, or of the telescope;
    ValueError if there is none."""
    found: list[Instrument] = []
    for instrument in bands:
        diameter = instrument.telescope.diameter  # which some real masks reach beyond
        extent = diameter if aperture is None else min(diameter, float(aperture.extent))
        try:
            replace(instrument.grid(), wavelength=instrument.band.shortest).require_sampling(extent)
        except ValueError as error:
            if not found:  # wider ones are undersampled even more
                raise
            assert instrument.width is not None  # a filter has no others beside it
            left_out.append(f"a band of {1e9 * instrument.width:.4g} nm is left out: {error}")
        else:
            found.append(instrument)
    return found
