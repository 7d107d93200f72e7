"""The instrument of a run: that of a file, with what was given beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from torchmask.cli.options import InstrumentOptions
from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument

INSTRUMENT = "instrument.json"  # its name in the folder of a run
_DARK = 20.0  # [magnitudes per square arcsec], any sky to compare with
_PLACES = {  # part of the instrument, and the number in it that an option is
    "mask_diameter": ("telescope", "diameter"),
    "central_obstruction": ("telescope", "central_obstruction"),
    "vane_width": ("telescope", "vane_width"),
    "vane_angles": ("telescope", "vane_angles"),
    "r0": ("site", "r0"),
    "outer_scale": ("site", "outer_scale"),
    "wind": ("site", "wind"),
    "n_pixels": ("camera", "n_pixels"),
    "pixel_scale_arcsec": ("camera", "pixel_scale"),
    "pixel_fill": ("camera", "pixel_fill"),
    "readout_noise": ("camera", "readout_noise"),
    "temperature": ("source", "temperature"),
    "exponent": ("source", "exponent"),
}
_OWN = ("wavelength", "n_wavelengths", "filter", "width", "exposure", "n_frames")  # of no part
_NEEDED = ("wind", "exposure", "width")  # which no instrument is without: 0 of them changes nothing
_ALTERNATIVES = {"filter": "width", "width": "filter", "n_frames": "observing_time"}


def instrument_used(known: Instrument, given: Mapping[str, Any]) -> Instrument:
    """Return an instrument with what was given beside its file, from which light, pixels and frames then follow.

    What takes the place of another number of the file (`_ALTERNATIVES`) puts it out.

    Parameters
    ----------
    known : Instrument
        Instrument of the file.
    given : mapping
        Values of options: those of `_PLACES` and `_OWN`, of an instrument's names and units, and `knee` [cycles/pixel].
        None changes nothing, nor do an infinite r0 or outer scale and a wind, exposure or width of 0, which no
        instrument has.

    Raises
    ------
    ValueError
        If there is no such instrument.
    """
    told = {name: value for name, value in given.items() if value is not None and value != math.inf}
    told = {name: value for name, value in told.items() if value != 0 or name not in _NEEDED}
    changes: dict[str, Any] = {_ALTERNATIVES[name]: None for name in _ALTERNATIVES if name in told}
    changes |= {name: told[name] for name in _OWN if name in told}
    parts: dict[str, dict[str, Any]] = {}
    for name, (part, number) in _PLACES.items():
        if name in told:
            parts.setdefault(part, {})[number] = told[name]
    changes |= {part: replace(getattr(known, part), **numbers) for part, numbers in parts.items()}
    used = replace(known, **changes)
    return with_size(used, used.pixel_scale / ARCSEC / told["knee"]) if "knee" in told else used


def with_size(used: Instrument, size: float) -> Instrument:
    """Return the same instrument with a target of another size [arcsec]."""
    return replace(used, source=replace(used.source, size=size))


def with_light(used: Instrument, area: float, n_photons: float | None, sky: float | None) -> Instrument:
    """Return the same instrument with a source and a sky that send this light through an open area [m^2].

    Light is in electrons per frame from the source, and per pixel and frame from the sky. None changes nothing. Raises
    ValueError if no source or sky sends it.
    """
    if n_photons is not None:
        rate = n_photons / (used.telescope.throughput * area * used.exposure)
        used = replace(used, source=replace(used.source, magnitude=None, photon_rate=rate))
    if sky is not None:
        dark = replace(used, site=replace(used.site, sky=_DARK)).sky(area)
        magnitude = _DARK - 2.5 * math.log10(sky / dark) if sky > 0 else None
        used = replace(used, site=replace(used.site, sky=magnitude))
    return used


@dataclass(frozen=True, kw_only=True)
class UsedInstrumentOptions(InstrumentOptions):
    """An instrument that other options of the command describe too."""

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, for `instrument_used`."""
        return {}

    def used_instrument(self) -> Instrument | None:
        """Return the instrument of the file with what was given beside it, but for its light; None without a file.

        Raises ValueError if there is no such instrument.
        """
        known = self.known_instrument()
        return None if known is None else instrument_used(known, self.beside_file())
