"""The instrument of an observation, and what follows from it for the frames: photons, sky, pixels, number, noise.

It is one frozen record, in the units that instrument teams use, which every command shares and writes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from torchmask.atmosphere.seeing import Seeing
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.io import extra, from_json, read_json, to_json, write_json
from torchmask.numbers import THROUGH_AIR, require, require_wavelength, require_within, whole_number
from torchmask.optics.band import MOST_WAVELENGTHS, Band, warn_of_few_wavelengths
from torchmask.optics.passband import VEGA_IN_AB, Passband
from torchmask.spectra import NYQUIST, NoisePSD, PowerLawPSD

_FORMAT = "torchmask instrument, version 1"


@dataclass(frozen=True, kw_only=True)
class Instrument:
    """Complete description of an observation, which determines photons, frames and noise for any mask on the telescope.

    Raises ValueError if a number is out of range, the band is given twice or not at all, or the observing time is
    shorter than one frame; the message says what is possible. Warns if `n_wavelengths` is too small for the band, or
    the target for a pixel or too large for the field.

    Examples
    --------
    >>> instrument = Instrument(
    ...     telescope=Telescope(diameter=1.0, throughput=0.3),
    ...     source=Source(magnitude=4.0),
    ...     site=Site(r0=0.1, wind=10.0),
    ...     filter="bessell-V",
    ...     exposure=5e-3,
    ...     observing_time=1.0,
    ...     camera=Camera(readout_time=5e-3),
    ... )
    >>> instrument.frames, round(instrument.photons(area=0.1))  # holes of 0.1 m^2 altogether
    (100, 33597)
    """

    telescope: Telescope
    """Telescope that collects the light."""
    source: Source
    """Target of the observation."""
    site: Site
    """Turbulence, wind and sky."""
    camera: Camera = field(default_factory=Camera)
    """Detector."""
    wavelength: float | None = None
    """Wavelength of the observation, at which r0 is given [m]; None: the mean of the filter."""
    filter: str | None = None
    """Name of the filter (bessell-V, twomass-Ks, ...), or a text file with columns wavelength [m] and transmission."""
    width: float | None = None
    """Width of a top-hat band around the wavelength, instead of a filter [m]."""
    n_wavelengths: int = 5
    """Number of wavelengths that represent the band."""
    exposure: float
    """Exposure time of a frame [s]."""
    observing_time: float | None = None
    """Total time in which frames are taken one after the other [s]."""
    n_frames: int | None = None
    """Number of frames, instead of the observing time."""

    def __post_init__(self) -> None:
        require_wavelength("wavelength", self.wavelength, *THROUGH_AIR)
        require("width", self.width, ", in m")
        require_within("exposure", self.exposure, 1e-6, 1e5, " s", "the fastest shutters to a day")
        require("observing_time", self.observing_time, ", in s")
        mistakes = []
        if (self.width, self.filter).count(None) != 1:
            mistakes.append("the band is missing or given twice: give filter, or wavelength and width [m]")
        elif self.wavelength is None and self.filter is None:
            mistakes.append("wavelength is missing: give it in m, such as 550e-9")
        if (self.observing_time, self.n_frames).count(None) != 1:
            mistakes.append("give observing_time [s] or n_frames, and not both")
        if mistakes:
            raise ValueError("; ".join(mistakes))
        if self.n_frames is not None:
            object.__setattr__(self, "n_frames", whole_number("n_frames", self.n_frames))
        number = whole_number("n_wavelengths", self.n_wavelengths, most=MOST_WAVELENGTHS)
        object.__setattr__(self, "n_wavelengths", number)
        self._check_time()
        self._check_band()
        self.source.warn_of_size(self.pixel_scale / ARCSEC, self.field_of_view / ARCSEC)

    def _check_time(self) -> None:
        if self.observing_time is not None and self.frames < 1:
            raise ValueError(
                f"observing_time is {self.observing_time:g} s, but one frame takes {self._cadence:g} s: observe for at "
                f"least that, or expose for {self._longest_exposure}"
            )

    def _check_band(self) -> None:
        first, last = self.passband.wavelengths[0], self.passband.wavelengths[-1]
        if not first < self.mean_wavelength < last:
            raise ValueError(
                f"wavelength is {self.mean_wavelength:.4g} m, and filter {self.filter} passes {first:.4g} to "
                f"{last:.4g} m: leave the wavelength out, or give one in between"
            )
        if self.source.system == "Vega" and self.filter not in VEGA_IN_AB:
            raise ValueError(
                f"magnitudes of Vega are known for the filters {', '.join(VEGA_IN_AB)}: give the AB magnitude in "
                f"{self.filter or 'the band'}"
            )
        warn_of_few_wavelengths(self.passband, self.n_wavelengths, self.source.temperature)

    @property
    def passband(self) -> Passband:
        """Transmission of the band."""
        if self.filter is not None:
            return Passband.find(self.filter)
        assert self.wavelength is not None
        assert self.width is not None
        return Passband.top_hat(self.wavelength, self.width)

    @property
    def band(self) -> Band:
        """Wavelengths that represent the band, with the source's share of light at each."""
        return Band.from_filter(self.passband, self.n_wavelengths, self.source.temperature)

    @property
    def mean_wavelength(self) -> float:
        """Wavelength at which r0 is given [m]."""
        return self.passband.mean_wavelength if self.wavelength is None else self.wavelength

    @property
    def _cadence(self) -> float:
        return self.exposure + self.camera.readout_time

    @property
    def _longest_exposure(self) -> str:
        """What of the observing time is left beside one read-out."""
        assert self.observing_time is not None
        longest = self.observing_time - self.camera.readout_time
        return f"at most {longest:g} s" if longest > 0 else "any time with a faster read-out"

    @property
    def frames(self) -> int:
        """Number of frames."""
        if self.observing_time is None:
            assert self.n_frames is not None
            return self.n_frames
        return math.floor(self.observing_time / self._cadence * (1 + 1e-9))

    def frames_that_differ(self, diameter: float) -> float:
        """Return how many frames show turbulence of their own, as the wind crosses an opening of a `diameter` [m].

        Raises ValueError unless the diameter is finite and positive.
        """
        require("diameter", diameter, ", in m")
        return min(self.frames, 1 + (self.frames - 1) * self._cadence * self.site.wind / diameter)

    @property
    def pixel_scale(self) -> float:
        """Angle on the sky of one pixel [rad]."""
        if self.camera.pixel_scale is not None:
            return self.camera.pixel_scale * ARCSEC
        return Grid.nyquist(self.telescope.diameter, self.band.shortest, 2).pixel_scale

    @property
    def field_of_view(self) -> float:
        """Angle on the sky of one side of the field [rad]."""
        return self.camera.n_pixels * self.pixel_scale

    def grid(self, n_pixels: int | None = None) -> Grid:
        """Return the grid of the camera, or one of equal pixels with `n_pixels` a side, at the wavelength of r0."""
        return Grid(self.camera.n_pixels if n_pixels is None else n_pixels, self.pixel_scale, self.mean_wavelength)

    @property
    def seeing(self) -> Seeing:
        """Turbulence during an exposure."""
        return Seeing(self.site.r0, self.site.outer_scale, self.exposure, self.site.wind)

    def _rate(self, magnitude: float) -> float:
        """Return the electrons per second and square metre of the pupil for a magnitude."""
        offset = VEGA_IN_AB[self.filter] if self.source.system == "Vega" and self.filter is not None else 0.0
        return self.telescope.throughput * self.passband.ab_photons * 10 ** (-0.4 * (magnitude + offset))

    def photons(self, area: float) -> float:
        """Return the electrons per frame from the target through an open area of the pupil [m^2]."""
        require("area", area, ", in m^2")
        source = self.source
        if source.magnitude is not None:
            rate = self._rate(source.magnitude)
        else:
            assert source.photon_rate is not None
            rate = self.telescope.throughput * source.photon_rate
        return rate * area * self.exposure

    def sky(self, area: float) -> float:
        """Return the electrons per pixel and frame from the sky through an open area of the pupil [m^2]."""
        require("area", area, ", in m^2")
        if self.site.sky is None:
            return 0.0
        return self._rate(self.site.sky) * area * self.exposure * (self.pixel_scale / ARCSEC) ** 2

    def equivalent_photons(self, area: float) -> float:
        """Return the electrons per frame that would tell as much of the target without sky and read-out noise.

        That is photons^2 / variance, through an open `area` of the pupil [m^2]; the variance [electrons^2] is that of a
        whole frame, which photons, sky and read-out make.
        """
        photons, camera = self.photons(area), self.camera
        return photons**2 / (photons + camera.n_pixels**2 * (self.sky(area) + camera.readout_noise**2))

    def noise_psd(self, area: float) -> NoisePSD:
        """Return the PSD of the target's photon noise and the camera's read-out noise, without that of the sky."""
        return NoisePSD(self.photons(area), self.camera.readout_noise, self.camera.n_pixels**2)

    @property
    def knee(self) -> float:
        """The frequency below which the power spectrum of the target is flat [cycles/pixel]: all if it is a point."""
        size = self.source.size
        return PowerLawPSD.knee if size is None else min(NYQUIST, self.pixel_scale / (size * ARCSEC))

    def object_psd(self, area: float) -> PowerLawPSD:
        """Return the power spectrum of the target."""
        return PowerLawPSD(self.source.exponent, self.photons(area), self.knee)

    def with_exposure(self, exposure: float) -> Instrument:
        """Return the same instrument with another exposure time [s], which may change the number of frames."""
        return replace(self, exposure=exposure)

    def with_width(self, width: float) -> Instrument:
        """Return the same instrument with another width of the band [m], to which a photon rate is proportional.

        Raises ValueError if the band is that of a filter.
        """
        if self.width is None:
            raise ValueError(f"the band is the filter {self.filter}: give wavelength and width [m] to vary the width")
        source, rate = self.source, self.source.photon_rate
        if rate is not None:
            source = replace(source, photon_rate=rate * width / self.width)
        return replace(self, source=source, width=width)

    def describe(self, area: float) -> str:
        """Return a Markdown table of what follows for an open area of the pupil [m^2]."""
        seeing, telescope = self.seeing, self.telescope
        rows = [
            ("quantity", "value"),
            ("---", "---"),
            ("wavelength", f"{1e9 * self.mean_wavelength:.4g} nm"),
            ("collecting area", f"{area:.4g} m^2"),
            ("photons per frame", f"{self.photons(area):.4g} electrons"),
            ("sky", f"{self.sky(area):.4g} electrons per pixel and frame"),
            ("read-out noise of a frame", f"{self.camera.readout_noise * self.camera.n_pixels:.4g} electrons rms"),
            ("frames", f"{self.frames}"),
            ("pixel", f"{self.pixel_scale / ARCSEC:.4g} arcsec"),
            ("D / r0", f"{telescope.diameter / self.site.r0:.4g}"),
            ("exposure / tau0", f"{self.exposure / seeing.tau0:.4g} (tau0 = {1e3 * seeing.tau0:.4g} ms)"),
        ]
        return "\n".join(f"| {' | '.join(row)} |" for row in rows)

    def save(self, path: str | Path, replace: bool = False) -> None:
        """Write a JSON file that `load` reads back exactly: a new one, or in place of one that exists (`replace`).

        Raises ValueError as `write_json` does.
        """
        write_json(path, {"format": _FORMAT} | to_json(self), replace=replace)

    @classmethod
    def load(cls, path: str | Path) -> Instrument:
        """Read a JSON file that `save` wrote, or a YAML file (.yaml, .yml) with the same keys.

        Raises
        ------
        ValueError
            If the file is missing or damaged, a key is unknown or missing, or a number is out of range.
        """
        values = _read_yaml(Path(path)) if Path(path).suffix.lower() in (".yaml", ".yml") else read_json(path)
        try:
            if isinstance(values, dict):
                made = values.get("format", _FORMAT)
                if made != _FORMAT:
                    raise ValueError(f"it is {made!r}, not {_FORMAT!r}")
                values = {key: value for key, value in values.items() if key != "format"}
            return from_json(cls, values, "instrument.")
        except ValueError as error:
            raise ValueError(f"{path} cannot be read as an instrument: {error}") from error


def _read_yaml(path: Path) -> Any:
    with extra("experiments"):
        import yaml

    if not path.is_file():
        raise ValueError(f"there is no file {path} (needed: a JSON or YAML file)")
    try:
        return yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
