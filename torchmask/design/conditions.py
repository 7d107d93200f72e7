"""What `TurbulentMSE` knows of an exposure besides the turbulence itself, as numbers that a file can hold."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from torchmask.instrument.instrument import Instrument
from torchmask.optics.pixel import square_pixel


@dataclass(frozen=True, kw_only=True)
class ExposureConditions:
    """Exposure time, wind, band, pixels and sky of an exposure.

    Examples
    --------
    >>> ExposureConditions(exposure=2e-3, wind=10.0).keywords(r0=0.15)["wind"]
    10.0
    """

    exposure: float = 0.0
    """Exposure time of a frame [s]."""
    wind: float | tuple[float, float] = 0.0
    """Speed of the wind, all directions being equally likely, or its velocity [m/s]."""
    wavelengths: tuple[float, ...] | None = None
    """Wavelengths that represent a broad band [m]; None: one wavelength."""
    weights: tuple[float, ...] | None = None
    """Relative amount of light at each of them; None: equal."""
    pixel_fill: float = 0.0
    """Sensitive fraction of the area of a pixel, 1 for pixels without gaps; 0: pixels are points."""
    sky: float = 0.0
    """Electrons per pixel and frame."""

    @classmethod
    def of_instrument(cls, instrument: Instrument, area: float) -> ExposureConditions:
        """Return the conditions of an instrument, with the sky of an open area [m^2]."""
        band = instrument.band
        return cls(
            exposure=instrument.exposure,
            wind=instrument.site.wind,
            wavelengths=band.wavelengths,
            weights=band.shares,
            pixel_fill=instrument.camera.pixel_fill,
            sky=instrument.sky(area),
        )

    def keywords(self, r0: float, outer_scale: float = math.inf) -> dict[str, Any]:
        """Return the keywords of `TurbulentMSE` for turbulence of these lengths [m]."""
        return {
            "r0": r0,
            "outer_scale": outer_scale,
            "exposure": self.exposure,
            "wind": self.wind,
            "wavelengths": self.wavelengths,
            "weights": self.weights,
            "pixel": square_pixel(self.pixel_fill),
            "sky": self.sky,
        }

    def with_light(self, factor: float) -> ExposureConditions:
        """Return the same with `factor` times the light of the sky."""
        return replace(self, sky=factor * self.sky)
