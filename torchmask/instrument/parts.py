"""What an observation is made of: telescope, source, site and camera, in the units that teams speak."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from torchmask.optics.pixel import SquarePixel


def require(name: str, value: float | None, unit: str, zero: bool = False, most: float = math.inf) -> None:
    """Raise ValueError unless the number is None, or finite, positive (or `zero`) and no more than `most`."""
    if value is None or (math.isfinite(value) and (value > 0 or (zero and value == 0)) and value <= most):
        return
    least = "at least 0" if zero else "positive"
    raise ValueError(
        f"{name} is {value}: it must be finite and {least}{f', at most {most:g}' * (most < math.inf)}{unit}"
    )


@dataclass(frozen=True, kw_only=True)
class Telescope:
    """What collects the light, before a mask covers it.

    Raises ValueError for what no telescope has.

    Examples
    --------
    >>> Telescope(diameter=8.2, central_obstruction=1.1, throughput=0.3).diameter
    8.2
    """

    diameter: float
    """Of the pupil, and of the mask that covers it [m]."""
    central_obstruction: float = 0.0
    """Diameter of the disc in the middle that is blocked [m]."""
    throughput: float = 1.0
    """Electrons for each photon that reaches the open pupil inside the band: of mirrors, lenses and detector, as far as
    the curve of the filter does not hold them."""

    def __post_init__(self) -> None:
        require("telescope.diameter", self.diameter, ", in m")
        require("telescope.throughput", self.throughput, "", most=1.0)
        if not 0 <= self.central_obstruction < self.diameter:
            raise ValueError(
                f"telescope.central_obstruction is {self.central_obstruction}: it must be at least 0 and less than the "
                f"diameter, {self.diameter:g} m"
            )


@dataclass(frozen=True, kw_only=True)
class Source:
    """The target: its light above the air, by a magnitude or a rate, and the statistics of its image.

    Raises ValueError unless one of `magnitude` and `photon_rate` is given, and for numbers out of range.

    Examples
    --------
    >>> Source(magnitude=6.5, temperature=5772.0).system
    'AB'
    """

    magnitude: float | None = None
    """Of the whole target in the band, as the site lets it through."""
    system: Literal["AB", "Vega"] = "AB"
    """Of that magnitude; Vega is known for bessell and twomass filters."""
    photon_rate: float | None = None
    """In place of a magnitude: photons per second and square metre that the band passes."""
    temperature: float | None = None
    """Of the black body whose light it is [K], 5772 for sunlight; None: as many photons at each wavelength."""
    size: float | None = None
    """Of the target across [arcsec], below whose inverse its power spectrum is flat; None: 64 pixels."""
    exponent: float = 1.5
    """Of the power law by which its power falls with the frequency."""

    def __post_init__(self) -> None:
        if (self.magnitude is None) == (self.photon_rate is None):
            raise ValueError("source: give its magnitude, or its photon_rate [1 / (s m^2)], and not both")
        if self.magnitude is not None and not math.isfinite(self.magnitude):
            raise ValueError(f"source.magnitude is {self.magnitude}: it must be finite")
        require("source.photon_rate", self.photon_rate, ", in photons / (s m^2)")
        require("source.temperature", self.temperature, ", in K")
        require("source.size", self.size, ", in arcsec")
        require("source.exponent", self.exponent, "", zero=True)


@dataclass(frozen=True, kw_only=True)
class Site:
    """The air above the telescope.

    Raises ValueError for impossible numbers.

    Examples
    --------
    >>> Site(r0=0.1, wind=10.0, sky=21.0).outer_scale
    20.0
    """

    r0: float
    """Fried parameter of the turbulence at the wavelength of the observation [m]."""
    wind: float
    """Its speed, all directions being equally likely [m/s]."""
    outer_scale: float = 20.0
    """Of the turbulence [m]."""
    sky: float | None = None
    """Brightness of the sky in the band, magnitudes per square arcsec of the source's system; None: black."""

    def __post_init__(self) -> None:
        for name, unit in (("r0", "m"), ("wind", "m/s"), ("outer_scale", "m")):
            require(f"site.{name}", getattr(self, name), f", in {unit}")
        if self.sky is not None and not math.isfinite(self.sky):
            raise ValueError(f"site.sky is {self.sky}: it must be finite, in magnitudes per square arcsec")


@dataclass(frozen=True, kw_only=True)
class Camera:
    """The detector.

    Raises ValueError for impossible numbers.

    Examples
    --------
    >>> Camera(n_pixels=256, readout_noise=1.5).readout_time
    0.0
    """

    n_pixels: int = 128
    """Of the field that is read out, per side: the read-out noise counts them all."""
    pixel_scale: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing at the shortest wavelength."""
    pixel_fill: float | None = None
    """Part of the area of its pitch in which a pixel is sensitive, 1 for gapless pixels; None: pixels are points."""
    readout_noise: float = 0.0
    """Electrons rms per pixel and frame."""
    readout_time: float = 0.0
    """From the end of one exposure to the start of the next [s]."""

    def __post_init__(self) -> None:
        if self.n_pixels != int(self.n_pixels) or self.n_pixels < 2:
            raise ValueError(f"camera.n_pixels is {self.n_pixels}: it must be a whole number of at least 2")
        require("camera.pixel_scale", self.pixel_scale, ", in arcsec")
        require("camera.readout_noise", self.readout_noise, ", in electrons rms", zero=True)
        require("camera.readout_time", self.readout_time, ", in s", zero=True)
        if self.pixel_fill is not None:
            SquarePixel(self.pixel_fill)
