"""Options of the criterion that a mask is judged by: with turbulence in the holes, or without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchmask.cli.options import BandOptions, InstrumentOptions
from torchmask.design.conditions import ExposureConditions
from torchmask.instrument.instrument import Instrument


@dataclass(frozen=True, kw_only=True)
class ExposureOptions(BandOptions, InstrumentOptions):
    """What the criterion knows of an exposure besides r0 and the outer scale."""

    criterion: Literal["asymptotic", "turbulent"] = "asymptotic"
    """Whether turbulence only shifts the phase of each hole, or is of von Karman's kind within and between holes; the
    latter is further described by the options below."""
    exposure_time: float = 0.0
    """Duration of a frame [s]; it needs a wind."""
    wind: tuple[float, ...] = ()
    """Wind speed [m/s], all directions being equally likely, or two numbers: towards +x and towards +y."""
    pixel_fill_factor: float = 0.0
    """Sensitive part of the area of a square pixel, at most 1; 0: pixels are points."""
    sky: float | None = None
    """Electrons per pixel and frame from the sky; None: from --instrument, or else 0."""

    def conditions(self, wavelength: float, area: float) -> ExposureConditions | None:
        """Return the conditions of an exposure through an open area [m^2], None for the asymptotic criterion.

        Raises ValueError for a wind of more than two numbers, two bands, and, unless an instrument says them, options
        that the asymptotic criterion would not look at.
        """
        if len(self.wind) > 2:
            raise ValueError(f"--wind has {len(self.wind)} numbers: give a speed, or a speed towards +x and +y, in m/s")
        band = self.band(wavelength)
        if self.criterion == "asymptotic":
            if self.instrument is None:
                self._require_turbulence(band["wavelengths"] is not None)
            return None
        sky = self.sky
        if sky is None:
            sky = 0.0 if self.instrument is None else Instrument.load(self.instrument).sky(area)
        speeds = tuple(self.wind)
        return ExposureConditions(
            exposure=self.exposure_time,
            wind=(speeds[0], speeds[1]) if len(speeds) == 2 else sum(speeds),
            **band,
            pixel_fill_factor=self.pixel_fill_factor,
            sky=sky,
        )

    def _require_turbulence(self, broad: bool) -> None:
        given = {
            "--exposure-time": self.exposure_time != 0,
            "--wind": bool(self.wind),
            "--filter or --wavelengths": broad,
            "--pixel-fill-factor": self.pixel_fill_factor != 0,
            "--sky": self.sky is not None,
        }
        for name, is_given in given.items():
            if is_given:
                raise ValueError(f"{name} needs --criterion turbulent: the asymptotic one knows nothing of it")


def exposure_options(known: Instrument) -> dict[str, Any]:
    """Return the values of `ExposureOptions` that an instrument gives; its sky depends on the collecting area."""
    band, filtered = known.band, known.filter is not None
    return {
        "criterion": "turbulent",
        "exposure_time": known.exposure,
        "wind": (known.site.wind,),
        "filter": known.filter,
        "temperature": known.source.temperature if filtered else None,
        "n_wavelengths": known.n_wavelengths,
        "wavelengths": () if filtered else band.wavelengths,
        "weights": () if filtered else band.shares,
        "pixel_fill_factor": known.camera.pixel_fill or 0.0,
    }


@dataclass(frozen=True, kw_only=True)
class CriterionOptions(ExposureOptions):
    """What the criterion knows of the observation."""

    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; the asymptotic criterion warns of wider holes."""
    outer_scale: float | None = None
    """Outer scale of the turbulence [m]; None: infinite."""

    def turbulence(self, wavelength: float, area: float) -> dict[str, Any] | None:
        """Return the options as `TurbulentMSE` takes them, None for the asymptotic criterion.

        Raises ValueError as `conditions`, for turbulence without r0, and for an outer scale without turbulence.
        """
        conditions = self.conditions(wavelength, area)
        if conditions is None:
            if self.outer_scale is not None and self.instrument is None:
                raise ValueError("--outer-scale needs --criterion turbulent: the asymptotic one knows nothing of it")
            return None
        if self.r0 is None:
            raise ValueError("--criterion turbulent needs --r0, in m at the wavelength")
        return conditions.keywords(self.r0, *([] if self.outer_scale is None else [self.outer_scale]))
