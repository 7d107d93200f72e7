"""Options of the criterion that a mask is designed by: with turbulence in the holes, or without."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from torchmask.cli.options import BandOptions
from torchmask.optics.pixel import SquarePixel


@dataclass(frozen=True, kw_only=True)
class CriterionOptions(BandOptions):
    """What the criterion knows of the observation."""

    criterion: Literal["asymptotic", "turbulent"] = "asymptotic"
    """Whether turbulence only shifts the phase of each hole, or is of von Karman's kind within and between holes; the
    latter needs --r0, and the options below describe it further."""
    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; the asymptotic criterion warns of wider holes."""
    outer_scale: float | None = None
    """Outer scale of the turbulence [m]; None: infinite."""
    exposure_time: float = 0.0
    """Duration of a frame [s]; it needs a wind."""
    wind: tuple[float, ...] = ()
    """Wind speed [m/s], all directions being equally likely, or two numbers: towards +x and towards +y."""
    pixel_fill_factor: float = 0.0
    """Sensitive part of the area of a square pixel, at most 1; 0: pixels are points."""
    sky: float = 0.0
    """Electrons per pixel and frame from the sky."""

    def turbulence(self, wavelength: float) -> dict[str, Any] | None:
        """The options as `TurbulentMSE` takes them, None for the asymptotic criterion.

        Raises ValueError for turbulence without r0, a wind of more than two numbers, and options of turbulence that the
        asymptotic criterion would not look at.
        """
        if len(self.wind) > 2:
            raise ValueError(f"--wind has {len(self.wind)} numbers: give a speed, or a speed towards +x and +y, in m/s")
        band = self.band(wavelength)
        if self.criterion == "asymptotic":
            given = {
                "--outer-scale": self.outer_scale is not None,
                "--exposure-time": self.exposure_time != 0,
                "--wind": bool(self.wind),
                "--filter or --wavelengths": band["wavelengths"] is not None,
                "--pixel-fill-factor": self.pixel_fill_factor != 0,
                "--sky": self.sky != 0,
            }
            for name, is_given in given.items():
                if is_given:
                    raise ValueError(
                        f"{name} needs --criterion turbulent and --r0: the asymptotic one knows nothing of it"
                    )
            return None
        if self.r0 is None:
            raise ValueError("--criterion turbulent needs --r0, in m at the wavelength")
        wind = self.wind[0] if len(self.wind) == 1 else self.wind or 0.0
        scale = {} if self.outer_scale is None else {"outer_scale": self.outer_scale}
        pixel = SquarePixel(self.pixel_fill_factor) if self.pixel_fill_factor else None
        exposure = {"exposure": self.exposure_time, "wind": wind}
        return {"r0": self.r0, **scale, **exposure, **band, "pixel": pixel, "sky": self.sky}
