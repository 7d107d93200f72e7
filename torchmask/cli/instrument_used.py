"""The instrument of a run: that of a file, with what was given beside it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument

INSTRUMENT = "instrument.json"  # its name in the folder of a run
_DARK = 20.0  # [magnitudes per square arcsec], any sky to compare with
_PLACES = {  # part of the instrument and number in it, for each option that is one
    "mask_diameter": ("telescope", "diameter"),
    "central_obstruction": ("telescope", "central_obstruction"),
    "r0": ("site", "r0"),
    "outer_scale": ("site", "outer_scale"),
    "wind": ("site", "wind"),
    "n_pixels": ("camera", "n_pixels"),
    "pixel_fill": ("camera", "pixel_fill"),
    "readout_noise": ("camera", "readout_noise"),
    "exponent": ("source", "exponent"),
}


def instrument_used(known: Instrument, area: float, given: Mapping[str, Any]) -> Instrument:
    """Return an instrument with what was given beside its file, as far as it can say that; its band stays.

    Parameters
    ----------
    known : Instrument
        Instrument of the file.
    area : float
        Open area of the pupil [m^2], to which photons and sky belong.
    given : mapping
        Values of options: those in `_PLACES`, `exposure` [s] (0 changes nothing), `n_frames`, `pixel_scale` [arcsec],
        `knee`, `n_photons` (electrons per frame) and `sky` (electrons per pixel and frame). None changes nothing,
        nor do an infinite r0 or outer scale and a wind of 0, which no site has.

    Raises
    ------
    ValueError
        If there is no such instrument.
    """
    used = known
    for name, (part, number) in _PLACES.items():
        value = given.get(name)
        if value == math.inf or (name == "wind" and value == 0):
            continue
        if not _same(value, getattr(getattr(used, part), number)):
            used = replace(used, **{part: replace(getattr(used, part), **{number: value})})
    exposure = given["exposure"] or known.exposure
    if not (_same(exposure, known.exposure) and given["n_frames"] == known.frames):
        used = replace(used, exposure=exposure, n_frames=given["n_frames"], observing_time=None)
    if not _same(scale := given.get("pixel_scale"), used.pixel_scale / ARCSEC):
        used = replace(used, camera=replace(used.camera, pixel_scale=scale))
    if (knee := given.get("knee")) is not None and not _same(knee, used.knee):
        used = replace(used, source=replace(used.source, size=used.pixel_scale / ARCSEC / knee))
    if (photons := given.get("n_photons")) is not None:
        rate = photons / (used.telescope.throughput * area * used.exposure)
        used = replace(used, source=replace(used.source, magnitude=None, photon_rate=rate))
    if (sky := given.get("sky")) is not None:
        dark = replace(used, site=replace(used.site, sky=_DARK)).sky(area)
        magnitude = _DARK - 2.5 * math.log10(sky / dark) if sky > 0 else None
        used = replace(used, site=replace(used.site, sky=magnitude))
    return used


def _same(value: float | None, known: float) -> bool:
    """Return whether a value is not given, or differs from what is known by rounding only."""
    return value is None or math.isclose(value, known, rel_tol=1e-9)
