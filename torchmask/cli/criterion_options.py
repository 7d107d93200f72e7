"""Options of the criterion that a mask is judged by: with turbulence in the holes, or without; and the criterion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Self

from torchmask.cli.band_options import BandOptions, band_of_instrument
from torchmask.cli.instrument_used import instrument_used
from torchmask.cli.options import DEFAULT_PHOTONS, InstrumentOptions, pixel_angle
from torchmask.design.conditions import ExposureConditions
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.space import ANY_WAVELENGTH
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require_r0
from torchmask.optics.band import warn_of_few_wavelengths
from torchmask.optics.passband import Passband
from torchmask.spectra import NoisePSD, PowerLawPSD


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
    pixel_fill: float = 0.0
    """Sensitive fraction of the area of a pixel, 1 for pixels without gaps; 0: pixels are points."""
    sky: float | None = None
    """Electrons per pixel and frame from the sky; None: from --instrument, or else 0."""

    def needed_wavelength(self, given: float | None, quoted: Mapping[str, bool]) -> float | None:
        """Return the wavelength [m] that is given or the filter's; None if there is none and nothing depends on it.

        `quoted` says which options that hold only at a wavelength are given. Raises ValueError if one of them is, and
        no wavelength.
        """
        told = self.told_wavelength(given)
        needing = [name for name, is_given in quoted.items() if is_given] + ["--wavelengths"] * bool(self.wavelengths)
        if told is None and needing:
            raise ValueError(
                f"--wavelength is missing: give it in m, such as 550e-9, as {needing[0]} holds at a wavelength only; "
                "--instrument tells it too, and --filter with --criterion turbulent"
            )
        return told

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
                self._require_turbulence()
            return None
        if self.filter is not None:
            warn_of_few_wavelengths(Passband.find(self.filter), self.n_wavelengths, self.temperature)
        sky = self.sky
        if sky is None:
            known = self.known_instrument()
            sky = 0.0 if known is None else known.sky(area)
        speeds = tuple(self.wind)
        return ExposureConditions(
            exposure=self.exposure_time,
            wind=(speeds[0], speeds[1]) if len(speeds) == 2 else sum(speeds),
            **band,
            pixel_fill=self.pixel_fill,
            sky=sky,
        )

    def _require_turbulence(self) -> None:
        given = {
            "--exposure-time": self.exposure_time != 0,
            "--wind": bool(self.wind),
            "--filter": self.filter is not None,
            "--wavelengths": bool(self.wavelengths),
            "--pixel-fill": self.pixel_fill != 0,
            "--sky": self.sky is not None,
        }
        for name, is_given in given.items():
            if is_given:
                raise ValueError(f"{name} needs --criterion turbulent: the asymptotic one knows nothing of it")


def exposure_options(known: Instrument) -> dict[str, Any]:
    """Return the values of `ExposureOptions` that an instrument gives; its sky depends on the collecting area."""
    return band_of_instrument(known) | {
        "criterion": "turbulent",
        "exposure_time": known.exposure,
        "wind": (known.site.wind,),
        "pixel_fill": known.camera.pixel_fill,
    }


@dataclass(frozen=True, kw_only=True)
class CriterionOptions(ExposureOptions):
    """What the criterion knows of the observation."""

    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; the asymptotic criterion warns of wider holes."""
    outer_scale: float | None = None
    """Outer scale of the turbulence [m]; None: infinite, where `plan`, `table` and `simulate` take 20 m."""

    def turbulence(self, wavelength: float, area: float) -> dict[str, Any] | None:
        """Return the options as `TurbulentMSE` takes them, None for the asymptotic criterion.

        Raises ValueError as `conditions`, for turbulence without r0, an impossible r0, and an outer scale without
        turbulence.
        """
        require_r0("--r0", self.r0)
        conditions = self.conditions(wavelength, area)
        if conditions is None:
            if self.outer_scale is not None and self.instrument is None:
                raise ValueError("--outer-scale needs --criterion turbulent: the asymptotic one knows nothing of it")
            return None
        if self.r0 is None:
            raise ValueError("--criterion turbulent needs --r0, in m at the wavelength")
        return conditions.keywords(self.r0, *([] if self.outer_scale is None else [self.outer_scale]))


@dataclass(frozen=True)
class Observed:
    """An observation through holes of one open area, for which it makes the criterion."""

    grid: Grid
    """Frequencies of the criterion."""
    object_psd: PowerLawPSD
    noise_psd: NoisePSD
    n_frames: int
    area: float
    """Open area of the mask [m^2], to which photons and sky belong."""
    turbulence: dict[str, Any] | None
    """Keywords of `TurbulentMSE`; None: independent pistons."""

    def criterion(self) -> AsymptoticMSE:
        """Return the criterion for all masks of this area."""
        known = self.grid, self.object_psd, self.noise_psd, self.n_frames
        return AsymptoticMSE(*known) if self.turbulence is None else TurbulentMSE(*known, **self.turbulence)

    def through(self, area: float) -> Self:
        """Return the same through another open area [m^2]: the light of target and sky is in proportion to it."""
        factor = area / self.area
        return replace(
            self,
            object_psd=replace(self.object_psd, n_photons=factor * self.object_psd.n_photons),
            noise_psd=replace(self.noise_psd, n_photons=factor * self.noise_psd.n_photons),
            area=area,
            turbulence=self.turbulence and self.turbulence | {"sky": factor * self.turbulence["sky"]},
        )


@dataclass(frozen=True, kw_only=True)
class ObservationOptions(CriterionOptions):
    """The telescope, its light and its detector."""

    mask_diameter: float = 1.0
    """Diameter of the pupil and of a mask that covers it, D [m]."""
    wavelength: float | None = None
    """Wavelength of the observation [m], needed with --r0, --wavelengths and --pixel-scale-arcsec; None: the mean of
    the filter, which needs --criterion turbulent, or none, as errors with pixels of wavelength / (2 D) depend on no
    wavelength."""
    n_photons: float | None = None
    """Electrons per frame through holes of --fill-factor; None: from --instrument, or else 1e7."""
    n_frames: int = 20
    """Number of short exposures for the restoration."""
    readout_noise: float = 0.0
    """Read-out noise [electrons rms per pixel and frame]."""
    n_pixels: int = 128
    """Pixels per side of the detector's field, which sets the total read-out noise; the criterion has its own grid."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing at the shortest wavelength."""

    def observing_wavelength(self) -> float | None:
        """Return the wavelength [m]; None if none is told and nothing depends on it. ValueError if something does."""
        quoted = {"--r0": self.r0 is not None, "--pixel-scale-arcsec": self.pixel_scale_arcsec is not None}
        return self.needed_wavelength(self.wavelength, quoted)

    def observation(self, n_frequencies: int, exponent: float, knee: float, fill_factor: float) -> Observed:
        """Return the observation through holes of a fill factor N d^2 / D^2.

        Raises ValueError for a fill factor, a number of pixels or a pixel scale that cannot be, and as `turbulence` and
        `observing_wavelength`.
        """
        if not (math.isfinite(fill_factor) and fill_factor > 0):
            raise ValueError(f"--fill-factor is {fill_factor:g}: it must be finite and positive")
        if self.n_pixels < 1:
            raise ValueError(f"--n-pixels is {self.n_pixels}: it must be at least 1")
        wavelength = self.observing_wavelength()
        if wavelength is None:
            wavelength = ANY_WAVELENGTH
        else:
            self.require_its_wavelength(wavelength)
        area = math.pi / 4 * fill_factor * self.mask_diameter**2
        photons = self.n_photons
        if photons is None:
            known = self.known_instrument()
            photons = DEFAULT_PHOTONS if known is None else known.photons(area)
        turbulence = self.turbulence(wavelength, area)
        return Observed(
            self._grid(n_frequencies, wavelength, turbulence),
            PowerLawPSD(exponent, photons, knee),
            NoisePSD(photons, self.readout_noise, self.n_pixels**2),
            self.n_frames,
            area,
            turbulence,
        )

    def used_instrument(self, observed: Observed, central_obstruction: float) -> Instrument | None:
        """Return the instrument of an observation, with what was given beside its file; None without a file."""
        known = self.known_instrument()
        if known is None:
            return None
        names = ("mask_diameter", "r0", "outer_scale", "n_pixels", "readout_noise", "pixel_fill", "n_frames")
        given = {name: getattr(self, name) for name in (*names, "n_photons", "sky")} | {
            "central_obstruction": central_obstruction,
            "wind": math.hypot(*self.wind) if self.wind else None,
            "exposure": self.exposure_time,
            "pixel_scale": self.pixel_scale_arcsec,
            "exponent": observed.object_psd.exponent,
            "knee": observed.object_psd.knee,
        }
        return instrument_used(known, observed.area, given)

    def _grid(self, n_frequencies: int, wavelength: float, turbulence: dict[str, Any] | None) -> Grid:
        wavelengths = (turbulence or {}).get("wavelengths") or ()
        shortest = min((wavelength, *wavelengths))
        finest = Grid.nyquist(self.mask_diameter, shortest, n_frequencies)
        scale = pixel_angle(self.pixel_scale_arcsec)
        if scale is not None:
            finest = replace(finest, pixel_scale=scale)
            finest.require_sampling(self.mask_diameter)
        return replace(finest, wavelength=wavelength)


def observation_options(known: Instrument) -> dict[str, Any]:
    """Return the options of `design` and `rank` that an instrument sets; light and sky depend on the open area."""
    return exposure_options(known) | {
        "r0": known.site.r0,
        "outer_scale": known.site.outer_scale,
        "mask_diameter": known.telescope.diameter,
        "central_obstruction": known.telescope.central_obstruction,
        "spiders": known.telescope.spiders,
        "exponent": known.source.exponent,
        "knee": known.knee,
        "wavelength": known.mean_wavelength,
        "n_frames": known.frames,
        "readout_noise": known.camera.readout_noise,
        "n_pixels": known.camera.n_pixels,
        "pixel_scale_arcsec": known.pixel_scale / ARCSEC,
    }
