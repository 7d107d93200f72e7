"""The parts of an observation: telescope, source, site and camera, in the units that instrument teams use."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Literal, get_args

from torchmask.numbers import require, require_diameter, require_r0, require_within, whole_number
from torchmask.optics.aperture import FullAperture
from torchmask.optics.detector import Detector
from torchmask.optics.pixel import PixelResponse, square_pixel

System = Literal["AB", "Vega"]


@dataclass(frozen=True, kw_only=True)
class Telescope:
    """A telescope without a mask.

    Raises ValueError if a number is out of range.

    Examples
    --------
    >>> Telescope(diameter=8.2, central_obstruction=1.1, throughput=0.3).diameter
    8.2
    """

    diameter: float
    """Diameter of the pupil, and of a mask that covers it [m]."""
    central_obstruction: float = 0.0
    """Diameter of the central obstruction [m]."""
    vane_width: float = 0.0
    """Width of the vanes that hold the secondary mirror [m]."""
    vane_angles: tuple[float, ...] = ()
    """Direction of each vane from the centre to the rim, counterclockwise from +x [degrees]."""
    throughput: float = 1.0
    """Electrons for each photon that enters the open pupil inside the band: efficiency of mirrors, lenses and detector,
    as far as the curve of the filter does not include it."""

    def __post_init__(self) -> None:
        require_diameter("telescope.diameter", self.diameter)
        require("telescope.throughput", self.throughput, "", most=1.0)
        if not 0 <= self.central_obstruction < self.diameter:
            raise ValueError(
                f"telescope.central_obstruction is {self.central_obstruction}: it must be at least 0 and less than the "
                f"diameter, {self.diameter:g} m"
            )
        require("telescope.vane_width", self.vane_width, ", in m", zero=True, most=self.diameter)
        for angle in self.vane_angles:
            if not math.isfinite(angle):
                raise ValueError(f"telescope.vane_angles hold {angle}: they must be finite, in degrees")
        if bool(self.vane_width) != bool(self.vane_angles):
            raise ValueError(
                f"telescope.vane_width is {self.vane_width:g} m and vane_angles are {list(self.vane_angles)} degrees: "
                "vanes need both, a width and angles"
            )
        self.pupil()  # raises for vanes that leave no opening

    def pupil(self) -> FullAperture:
        """Return the open pupil, with its obstruction and vanes."""
        angles = [math.radians(angle) for angle in self.vane_angles]
        return FullAperture(self.diameter, self.central_obstruction / self.diameter, self.vane_width, angles)

    @property
    def spiders(self) -> tuple[tuple[float, float, float, float, float], ...]:
        """Vanes as bars for `MaskRules`: from x y in the centre to x y on the rim, and width [m]."""
        ends = [(math.cos(math.radians(angle)), math.sin(math.radians(angle))) for angle in self.vane_angles]
        radius = self.diameter / 2
        return tuple((0.0, 0.0, radius * x, radius * y, self.vane_width) for x, y in ends)


@dataclass(frozen=True, kw_only=True)
class Source:
    """The target: its brightness, by a magnitude or a rate, and the statistics of its image.

    Raises ValueError unless exactly one of `magnitude` and `photon_rate` is given, and if a number is out of range.

    Examples
    --------
    >>> Source(magnitude=6.5, temperature=5772.0).system
    'AB'
    """

    magnitude: float | None = None
    """Magnitude of the whole target in the band, as seen from the site."""
    system: System = "AB"
    """Magnitude system; Vega is known for bessell and twomass filters."""
    photon_rate: float | None = None
    """Photons per second and square metre that the band passes, instead of a magnitude."""
    temperature: float | None = None
    """Temperature of a black-body spectrum [K], 5772 for sunlight; None: equally many photons at each wavelength."""
    size: float | None = None
    """Diameter of the target [arcsec]; its power spectrum is flat below one over it. None: 64 pixels."""
    exponent: float = 1.5
    """Exponent of the power law by which that spectrum falls beyond."""

    def __post_init__(self) -> None:
        if (self.magnitude is None) == (self.photon_rate is None):
            raise ValueError("source: give magnitude or photon_rate [1 / (s m^2)], and not both")
        if self.system not in get_args(System):
            raise ValueError(f"source.system is {self.system!r}: known systems are {' and '.join(get_args(System))}")
        require_within(
            *("source.magnitude", self.magnitude, -27.0, 40.0, ""),
            "brighter than the Sun to fainter than any telescope sees",
        )
        require(
            "source.photon_rate", self.photon_rate, ", in photons / (s m^2), 1e22 being those of the Sun", most=1e22
        )
        require("source.temperature", self.temperature, ", in K")
        require("source.size", self.size, ", in arcsec")
        require("source.exponent", self.exponent, "", zero=True)

    def warn_of_size(self, pixel: float, field: float) -> None:
        """Warn of a target narrower than a pixel or wider than the field [arcsec], most often in another unit."""
        if self.size is None or pixel <= self.size <= field:
            return
        shown = f"less than a pixel, {pixel:.3g}" if self.size < pixel else f"more than the field, {field:.3g}"
        warnings.warn(
            f"source.size is {self.size:g} arcsec, which is {shown} arcsec: give the diameter of the target in arcsec "
            "(1e-6 rad are 0.206), or another camera.n_pixels or camera.pixel_scale",
            stacklevel=1,  # one place in all, as `warn_of_few_wavelengths`
        )


@dataclass(frozen=True, kw_only=True)
class Site:
    """Turbulence, wind and sky above the telescope.

    Raises ValueError if a number is out of range.

    Examples
    --------
    >>> Site(r0=0.1, wind=10.0, sky=21.0).outer_scale
    20.0
    """

    r0: float
    """Fried parameter of the turbulence at the wavelength of the observation [m]."""
    wind: float
    """Speed of the wind, whose direction is random [m/s]."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence [m]."""
    sky: float | None = None
    """Brightness of the sky in the band [magnitudes per square arcsec], in the system of the source; None: black."""

    def __post_init__(self) -> None:
        require_r0("site.r0", self.r0)
        require_within("site.wind", self.wind, 0.01, 200.0, " m/s", "calm air to the fastest jet streams")
        require_within("site.outer_scale", self.outer_scale, 0.1, 1e5, " m", "beyond, it makes no difference")
        require_within(
            *("site.sky", self.sky, -5.0, 30.0, " magnitudes per square arcsec"),
            "the thermal infrared to darker than any sky",
        )


@dataclass(frozen=True, kw_only=True)
class Camera:
    """The detector.

    Raises ValueError if a number is out of range.

    Examples
    --------
    >>> Camera(n_pixels=256, readout_noise=1.5).readout_time
    0.0
    """

    n_pixels: int = 128
    """Pixels per side of the field that is read out, all of which add read-out noise."""
    pixel_scale: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing at the shortest wavelength."""
    pixel_fill: float = 0.0
    """Sensitive fraction of the area of a pixel, 1 for pixels without gaps; 0: pixels are points."""
    readout_noise: float = 0.0
    """Read-out noise [electrons rms per pixel and frame]."""
    readout_time: float = 0.0
    """Time from the end of one exposure to the start of the next [s]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_pixels", whole_number("camera.n_pixels", self.n_pixels, least=2))
        require("camera.pixel_scale", self.pixel_scale, ", in arcsec")
        require("camera.readout_noise", self.readout_noise, ", in electrons rms", zero=True)
        require("camera.readout_time", self.readout_time, ", in s", zero=True)
        require("camera.pixel_fill", self.pixel_fill, "", zero=True, most=1.0)

    @property
    def pixel(self) -> PixelResponse | None:
        """Blur by the pixels, None if they are points."""
        return square_pixel(self.pixel_fill)

    def detector(self) -> Detector:
        """Return the pixels and the noise of the camera, for a simulation."""
        return Detector(self.readout_noise, pixel=self.pixel)
