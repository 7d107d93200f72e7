"""Options of the criterion that a mask is judged by: with turbulence in the holes, or without; and the criterion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, Self

from torchmask.cli.band_options import BandOptions, band_of_instrument
from torchmask.cli.instrument_used import with_light
from torchmask.cli.options import DEFAULT_PHOTONS, pixel_angle
from torchmask.design.conditions import ExposureConditions
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.rules import MaskRules
from torchmask.design.space import ANY_WAVELENGTH
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require_r0
from torchmask.optics.band import warn_of_few_wavelengths
from torchmask.optics.passband import Passband
from torchmask.spectra import NoisePSD, PowerLawPSD

_DEFAULT_FRAMES = 20


@dataclass(frozen=True, kw_only=True)
class ExposureOptions(BandOptions):
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

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, for `instrument_used`."""
        return super().beside_file() | {
            "exposure": self.exposure_time,
            "wind": math.hypot(*self.wind) if self.wind else None,
            "pixel_fill": self.pixel_fill,
        }

    def needed_wavelength(self, given: float | None, quoted: Mapping[str, bool]) -> float | None:
        """Return the wavelength [m] that is given, the instrument's or the filter's; None if nothing depends on it.

        `quoted` says which options that hold only at a wavelength are given. Raises ValueError if one of them is, and
        no wavelength, and for another one than that of the instrument's file.
        """
        told = self.told_wavelength(given)
        if (used := self.used_instrument()) is not None:
            self.require_its_wavelength(used.mean_wavelength)
            return used.mean_wavelength
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
            used = self.used_instrument()
            sky = 0.0 if used is None else used.sky(area)
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
    """Return the values of `ExposureOptions` that an instrument gives; sky and band follow from it."""
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
class ObservationOptions(CriterionOptions, MaskRules):
    """The telescope, its light and its detector."""

    mask_diameter: float = 1.0
    """Diameter of the pupil and of a mask that covers it, D [m]."""
    wavelength: float | None = None
    """Wavelength of the observation [m], needed with --r0, --wavelengths and --pixel-scale-arcsec; None: from
    --instrument, or else the mean of the filter, which needs --criterion turbulent, or none, as errors with pixels of
    wavelength / (2 D) depend on no wavelength."""
    n_photons: float | None = None
    """Electrons per frame through holes of --fill-factor; None: from --instrument, or else 1e7."""
    n_frames: int | None = None
    """Number of short exposures for the restoration; None: from --instrument, or else 20."""
    readout_noise: float = 0.0
    """Read-out noise [electrons rms per pixel and frame]."""
    n_pixels: int = 128
    """Pixels per side of the detector's field, which sets the total read-out noise; the criterion has its own grid."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: from --instrument, or else the largest without aliasing at the
    shortest wavelength."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    knee: float | None = None
    """Frequency below which that spectrum is flat [cycles/pixel], one over the object's size in pixels; None: from
    --instrument, or else 1/64."""

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, for `instrument_used`."""
        names = ("mask_diameter", "central_obstruction", "r0", "outer_scale", "wavelength", "n_frames", "readout_noise")
        names = (*names, "n_pixels", "pixel_scale_arcsec", "exponent", "knee")
        given = {name: getattr(self, name) for name in names}
        return super().beside_file() | vanes_beside_file(self) | given

    def observing_wavelength(self) -> float | None:
        """Return the wavelength [m]; None if none is told and nothing depends on it.

        Raises ValueError if something does, and for another one than that of the instrument's file.
        """
        quoted = {"--r0": self.r0 is not None, "--pixel-scale-arcsec": self.pixel_scale_arcsec is not None}
        return self.needed_wavelength(self.wavelength, quoted)

    def rules(self) -> MaskRules:
        """Return the rules of the telescope and the workshop."""
        return rules_of(self, self.known_instrument(), self.used_instrument())

    def observation(self, n_frequencies: int, fill_factor: float) -> Observed:
        """Return the observation through holes of a fill factor N d^2 / D^2.

        Raises ValueError for a fill factor, a number of pixels or a pixel scale that cannot be, and as `turbulence` and
        `observing_wavelength`.
        """
        if not (math.isfinite(fill_factor) and fill_factor > 0):
            raise ValueError(f"--fill-factor is {fill_factor:g}: it must be finite and positive")
        if self.n_pixels < 1:
            raise ValueError(f"--n-pixels is {self.n_pixels}: it must be at least 1")
        wavelength = self.observing_wavelength() or ANY_WAVELENGTH
        used = self.used_instrument()
        area = math.pi / 4 * fill_factor * self.mask_diameter**2
        photons, knee, frames = DEFAULT_PHOTONS, PowerLawPSD.knee, _DEFAULT_FRAMES
        if used is not None:
            photons, knee, frames = used.photons(area), used.knee, used.frames
        photons = photons if self.n_photons is None else self.n_photons
        knee = knee if self.knee is None else self.knee
        turbulence = self.turbulence(wavelength, area)
        return Observed(
            self._grid(n_frequencies, wavelength, turbulence, used),
            PowerLawPSD(self.exponent, photons, knee),
            NoisePSD(photons, self.readout_noise, self.n_pixels**2),
            frames if self.n_frames is None else self.n_frames,
            area,
            turbulence,
        )

    def kept_instrument(self, observed: Observed) -> Instrument | None:
        """Return the instrument that makes an observation, for the folder of the run; None without a file."""
        used = self.used_instrument()
        return None if used is None else with_light(used, observed.area, self.n_photons, self.sky)

    def _grid(
        self, n_frequencies: int, wavelength: float, turbulence: dict[str, Any] | None, used: Instrument | None
    ) -> Grid:
        wavelengths = (turbulence or {}).get("wavelengths") or ()
        shortest = min((wavelength, *wavelengths))
        finest = Grid.nyquist(self.mask_diameter, shortest, n_frequencies)
        scale = pixel_angle(self.pixel_scale_arcsec)
        if scale is None and used is not None:
            scale = used.pixel_scale
        if scale is not None:
            finest = replace(finest, pixel_scale=scale)
            finest.require_sampling(self.mask_diameter)
        return replace(finest, wavelength=wavelength)


def vanes_beside_file(rules: MaskRules) -> dict[str, Any]:
    """Return that an instrument has no vanes, if no bars are left: what bars of one's own are, it cannot say."""
    return {} if rules.spiders else {"vane_width": 0.0, "vane_angles": ()}


def rules_of(options: MaskRules, known: Instrument | None, used: Instrument | None) -> MaskRules:
    """Return the rules among the options, in which the vanes of a file reach the rim of the instrument that is used."""
    rules = MaskRules(**{item.name: getattr(options, item.name) for item in fields(MaskRules)})
    if known is None or used is None or rules.spiders != known.telescope.spiders:
        return rules
    return replace(rules, spiders=used.telescope.spiders)


def observation_options(known: Instrument) -> dict[str, Any]:
    """Return the options of `design` and `rank` that an instrument sets; all others follow from it."""
    return exposure_options(known) | {
        "r0": known.site.r0,
        "outer_scale": known.site.outer_scale,
        "mask_diameter": known.telescope.diameter,
        "central_obstruction": known.telescope.central_obstruction,
        "spiders": known.telescope.spiders,
        "exponent": known.source.exponent,
        "readout_noise": known.camera.readout_noise,
        "n_pixels": known.camera.n_pixels,
    }
