"""Observing conditions: sky, transparency, exposure time and band."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchmask.optics.band import Band


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """Conditions under which exposures are taken. The defaults are monochromatic snapshots on a black sky.

    sky : float
        Sky background [electrons per pixel and frame].
    transparency_scatter : float
        Standard deviation of the logarithm of the transmission, which is log-normal with mean 1 and drawn for each
        frame. It scales the light of the object, not the sky.
    exposure_time : float
        Duration of a frame [s], during which the wind moves the turbulence.
    band : Band, optional
        Wavelengths and their shares of the light. Turbulence has the same path differences at all of them. By default
        all light has the wavelength of the grid.

    Raises
    ------
    ValueError
        If a number is negative or not finite.

    Examples
    --------
    >>> Conditions(sky=12.5, exposure_time=2e-3).sky
    12.5
    """

    sky: float = 0.0
    transparency_scatter: float = 0.0
    exposure_time: float = 0.0
    band: Band | None = None

    def __post_init__(self) -> None:
        for name, unit in (
            ("sky", "electrons per pixel and frame"),
            ("transparency_scatter", "of the logarithm of the transmission"),
            ("exposure_time", "in s"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} is {value}: it must be finite and at least 0, {unit}")
