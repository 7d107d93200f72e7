"""`torchmask simulate`: draw short exposures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.cli.band_options import FilterOptions
from torchmask.cli.instrument_used import instrument_used
from torchmask.cli.obstacles import warn_of_blocked_holes
from torchmask.cli.options import (
    DEFAULT_PHOTONS,
    InstrumentOptions,
    MaskOptions,
    RunOptions,
    load_aperture,
    mask_file_wavelength,
    pixel_angle,
)
from torchmask.cli.report import log_observation
from torchmask.cli.run import new_run
from torchmask.cli.stacks import STACK
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require, require_r0, require_within
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band, warn_of_few_wavelengths
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.passband import Passband
from torchmask.optics.pixel import jittered, square_pixel
from torchmask.optics.pupil import Aperture
from torchmask.record import Record, fan_out
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.simulation.wavefronts import Turbulence

_DEFAULT_R0 = 0.15  # [m]
_MOST_PHOTONS = 1e15  # electrons per frame; the photon noise of more in a pixel is lost in the rounding of float64


@dataclass(frozen=True)
class TurbulenceOptions:
    """Layers, wind and timing of the turbulence."""

    profile: str | None = None
    """Profile of layers at the zenith: hv57, las_campanas or mauna_kea; None: all turbulence at the pupil."""
    layers: int = 8
    """Number of layers into which the profile is grouped; theta0 and tau0 do not depend on it."""
    wind: tuple[float, float] | None = None
    """Wind speed towards +x and +y [m/s]; None: the winds of the profile, or no wind without one."""
    frame_interval: float | None = None
    """Time from the start of one frame to the next [s], for drifting turbulence; None: independent frames."""
    exposure_time: float = 0.0
    """Exposure time of a frame [s]; needs a wind."""

    def make(self, r0: float | None, wavelength: float, outer_scale: float) -> Turbulence:
        """Return the turbulence with Fried parameter `r0` [m], of which the option tells what None and inf mean."""
        if self.wind is not None:
            speed = math.hypot(*self.wind)
            require_within("--turbulence.wind", speed, 0.0, 200.0, " m/s", "calm air to the fastest jet streams")
        if r0 == math.inf:
            return None
        require_r0("--r0", r0)
        if self.profile is not None:
            layers = named_layers(self.profile, self.layers)
            if r0 is not None or self.wind is not None:
                winds = layers.winds if self.wind is None else [self.wind] * len(layers.heights)
                layers = Layers.from_fractions(
                    layers.r0(wavelength) if r0 is None else r0, wavelength, layers.heights, layers.strengths, winds
                )
            return LayeredPhase(layers, wavelength, outer_scale, self.frame_interval)
        r0 = _DEFAULT_R0 if r0 is None else r0
        if self.wind is None:
            if self.frame_interval is not None:
                raise ValueError("--turbulence.frame-interval needs --turbulence.wind or --turbulence.profile")
            if self.exposure_time > 0:
                raise ValueError("--turbulence.exposure-time needs --turbulence.wind or --turbulence.profile")
            return TurbulencePhase(r0, outer_scale)
        layers = Layers.from_fractions(r0, wavelength, [0.0], [1.0], [self.wind])
        return LayeredPhase(layers, wavelength, outer_scale, self.frame_interval)


@dataclass(frozen=True, kw_only=True)
class ConditionOptions(FilterOptions):
    """Observing conditions: sky, clouds and band."""

    sky: float | None = None
    """Sky background [electrons per pixel and frame]; None: from --instrument, or else 0."""
    transparency_scatter: float = 0.0
    """Standard deviation of the logarithm of each frame's transmission, due to clouds."""
    band_width: float = 0.0
    """Width of a top-hat band around the wavelength, instead of a filter [m]; 0: one wavelength."""

    def make(self, exposure_time: float, wavelength: float, sky: float = 0.0) -> Conditions:
        """Return the conditions for `simulate_observation`. Raises ValueError if a value is out of range."""
        if not (math.isfinite(self.band_width) and 0 <= self.band_width < 2 * wavelength):
            raise ValueError(
                f"--conditions.band-width is {self.band_width}: it must be at least 0 m and below twice the wavelength"
            )
        if self.band_width and self.filter is not None:
            raise ValueError("--conditions.band-width and --conditions.filter are both given: give only one of them")
        if self.temperature is not None and not self.band_width and self.filter is None:
            raise ValueError(
                "--conditions.temperature is that of light in a band: give --conditions.filter or "
                "--conditions.band-width, or leave it out"
            )
        band, passband = self.filter_band(wavelength), None if self.filter is None else Passband.find(self.filter)
        if self.band_width:
            passband = Passband.top_hat(wavelength, self.band_width)
            band = Band.from_filter(passband, self.n_wavelengths, self.temperature)
        if passband is not None:
            warn_of_few_wavelengths(passband, self.n_wavelengths, self.temperature)
        return Conditions(
            sky=sky if self.sky is None else self.sky,
            transparency_scatter=self.transparency_scatter,
            exposure_time=exposure_time,
            band=band,
        )


@dataclass(frozen=True)
class TrueMaskOptions:
    """Error of the mask's position: frames are taken through a mask that differs from the one named in the stack."""

    rotation_deg: float = 0.0
    """Rotation of the mask from x to y [degrees]."""
    magnification: float = 1.0
    """Magnification of the positions and sizes of the holes."""

    def apply(self, aperture: Aperture) -> Aperture | None:
        """Return the true mask, or None if it does not differ.

        Raises ValueError for a full pupil, and for numbers that are not finite or, as a magnification, not positive.
        """
        if self == TrueMaskOptions():
            return None
        if not isinstance(aperture, SparseAperture):
            raise ValueError("--true-mask.rotation-deg and --true-mask.magnification are for masks, not a full pupil")
        if not math.isfinite(self.rotation_deg):
            raise ValueError(f"--true-mask.rotation-deg is {self.rotation_deg}: it must be finite, in degrees")
        if not (math.isfinite(self.magnification) and self.magnification > 0):
            raise ValueError(f"--true-mask.magnification is {self.magnification}: it must be finite and positive")
        geometry = MaskGeometry(math.radians(self.rotation_deg), self.magnification, self.magnification)
        return geometry.apply(aperture)


@dataclass(frozen=True, kw_only=True)
class Options(InstrumentOptions, MaskOptions, RunOptions):
    """Simulate short exposures of a scene through a mask and turbulence, with photon and read-out noise.

    Writes stack.npz (for `torchmask restore`; it also contains the truth), figures, config.yaml and the log to a new
    folder.
    """

    scene: SceneOptions = field(default_factory=SceneOptions)
    """The target; --instrument tells its size, source.size over the field of the camera, if that is possible."""
    wavelength: float | None = None
    """Wavelength of the observation [m]; None: the mean of the filter, or else that of the mask's .json file."""
    n_pixels: int = 128
    """Pixels per side of the image."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing at the shortest wavelength."""
    r0: float | None = None
    """Fried parameter of the turbulence at the wavelength [m]; None: that of the profile, or 0.15 without one; inf: no
    turbulence."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence [m]."""
    turbulence: TurbulenceOptions = field(default_factory=TurbulenceOptions)
    """Layers, wind and timing."""
    conditions: ConditionOptions = field(default_factory=ConditionOptions)
    """Sky, clouds and filter."""
    true_mask: TrueMaskOptions = field(default_factory=TrueMaskOptions)
    """Error of the mask's position."""
    n_frames: int = 20
    """Number of short exposures."""
    n_photons: float | None = None
    """Electrons per frame through the mask, also outside the field; None: from --instrument, or else 1e7."""
    readout_noise: float = 1.5
    """Read-out noise [electrons rms per pixel and frame]."""
    pixel_fill: float = 0.0
    """Sensitive fraction of the area of a pixel, 1 for pixels without gaps; 0: pixels are points."""
    jitter: float = 0.0
    """Motion of the image during a frame, as by vibrations: standard deviation along each axis [pixels]."""
    seed: int = 0
    """Random seed of the turbulence and the noise."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets; its light depends on the mask."""
        return cls(
            scene=scene_of(known),
            wavelength=known.mean_wavelength,
            n_pixels=known.camera.n_pixels,
            pixel_scale_arcsec=known.pixel_scale / ARCSEC,
            r0=known.site.r0,
            outer_scale=known.site.outer_scale,
            turbulence=TurbulenceOptions(wind=(known.site.wind, 0.0), exposure_time=known.exposure),
            conditions=ConditionOptions(
                filter=known.filter,
                band_width=known.width or 0.0,
                n_wavelengths=known.n_wavelengths,
                temperature=known.source.temperature,
            ),
            n_frames=known.frames,
            readout_noise=known.camera.readout_noise,
            pixel_fill=known.camera.pixel_fill,
        )


def scene_of(known: Instrument) -> SceneOptions:
    """Return a scene of the size of the instrument's target, if that is told, a pixel or more, and fits the field."""
    share = 0.0 if known.source.size is None else known.source.size * ARCSEC / known.field_of_view
    return SceneOptions(size=share) if 1 / known.camera.n_pixels <= share <= 1 else SceneOptions()


def observing_wavelength(options: Options) -> float:
    """Return the wavelength [m]: --wavelength, else that of the filter or the mask; ValueError if none is known."""
    told = options.conditions.told_wavelength(options.wavelength)
    if told is None:
        told = mask_file_wavelength(options)
    if told is None:
        raise ValueError(
            f"--wavelength is missing: give it in m, such as 550e-9. --mask {options.mask} has none, "
            "unlike the mask.json of `torchmask design`"
        )
    return told


def used_instrument(known: Instrument, area: float, options: Options) -> Instrument:
    """Return the instrument of these options, with what was given beside its file; its light is that through `area`."""
    turbulence = options.turbulence
    given = {
        name: getattr(options, name) for name in ("r0", "outer_scale", "n_pixels", "readout_noise", "pixel_fill")
    } | {
        "wind": None if turbulence.wind is None else math.hypot(*turbulence.wind),
        "exposure": turbulence.exposure_time,
        "pixel_scale": options.pixel_scale_arcsec,
        "n_frames": options.n_frames,
        "n_photons": options.n_photons,
        "sky": options.conditions.sky,
    }
    return instrument_used(known, area, given)


def run(options: Options) -> None:
    """Simulate, and write the stack."""
    known = options.known_instrument()
    telescope = None if known is None else known.telescope
    told = load_aperture(options, telescope)
    assert options.mask is not None  # or it would not be loaded
    warn_of_blocked_holes(options.mask, told, telescope)
    true = options.true_mask.apply(told)
    aperture = true or told
    wavelength = observing_wavelength(options)
    options.require_its_wavelength(wavelength)
    photons, sky = (DEFAULT_PHOTONS, 0.0) if known is None else (known.photons(told.area), known.sky(told.area))
    n_photons = photons if options.n_photons is None else options.n_photons
    require("--n-photons", options.n_photons, " electrons per frame", most=_MOST_PHOTONS)
    conditions = options.conditions.make(options.turbulence.exposure_time, wavelength, sky)
    turbulence = options.turbulence.make(options.r0, wavelength, options.outer_scale)
    pixel_scale = pixel_angle(options.pixel_scale_arcsec)
    if pixel_scale is None:
        # Real masks may reach beyond their nominal pupil.
        diameter = max(told.mask_diameter, told.extent, aperture.extent)
        shortest = wavelength if conditions.band is None else conditions.band.shortest
        finest = Grid.nyquist(diameter, shortest, options.n_pixels)
        grid = Grid(options.n_pixels, finest.pixel_scale, wavelength)
    else:
        grid = Grid(options.n_pixels, pixel_scale, wavelength)
    require("--jitter", options.jitter, " pixels, half the field", zero=True, most=min(grid.shape) / 2)
    detector = Detector(options.readout_noise, pixel=jittered(square_pixel(options.pixel_fill), options.jitter))
    scene = make_scene(grid.shape, n_photons, options.scene)
    used = None if known is None else used_instrument(known, float(told.area), options)
    with new_run("simulate", options, options.seed) as output:
        output.keep_instrument(used)
        generator, records = torch.Generator().manual_seed(options.seed), list[Record]()
        observation = simulate_observation(
            *(scene, aperture, grid, turbulence, detector, options.n_frames, generator),
            conditions=conditions,
            told=None if true is None else told,
            allow_overlap=options.allow_overlap,
            callback=fan_out(output.callback, records.append),
        )
        observation.save(output.directory / STACK)
        log_observation("observation", observation, output.logger, conditions.band)
        if isinstance(turbulence, LayeredPhase):
            output.summary.append(turbulence.layers.describe(wavelength))
        kept = records[-1].scalars["kept_light"]
        output.summary.append(
            f"{options.n_frames} frames of {grid.shape[0]} x {grid.shape[1]} pixels of "
            f"{grid.pixel_scale / ARCSEC:.4g} arcsec, {n_photons:.4g} photons in each, {100 * kept:.1f} % of the "
            "light inside the field"
        )
