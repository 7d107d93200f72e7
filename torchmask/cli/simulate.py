"""`torchmask simulate`: draw short exposures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch

from torchmask.atmosphere.phase import LayeredPhase
from torchmask.cli.condition_options import ConditionOptions, TurbulenceOptions
from torchmask.cli.instrument_used import UsedInstrumentOptions, with_light, with_size
from torchmask.cli.obstacles import warn_of_blocked_holes
from torchmask.cli.options import (
    DEFAULT_PHOTONS,
    FULL,
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
from torchmask.numbers import require
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import jittered, square_pixel
from torchmask.optics.pupil import Aperture
from torchmask.record import Record, fan_out
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

_DEFAULT_FRAMES = 20
_FULL_PUPIL = ("mask_diameter", "central_obstruction", "vane_width", "vane_angles")  # options of `--mask full`
_MOST_PHOTONS = 1e15  # electrons per frame; the photon noise of more in a pixel is lost in the rounding of float64


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
class Options(UsedInstrumentOptions, MaskOptions, RunOptions):
    """Simulate short exposures of a scene through a mask and turbulence, with photon and read-out noise.

    Writes stack.npz (for `torchmask restore`; it also contains the truth), figures, config.yaml and the log to a new
    folder.
    """

    scene: SceneOptions = field(default_factory=SceneOptions)
    """The target; --instrument tells its size, source.size over the field of the camera, if that is possible."""
    wavelength: float | None = None
    """Wavelength of the observation [m]; None: from --instrument, or else the mean of the filter, or that of the mask's
    .json file."""
    n_pixels: int = 128
    """Pixels per side of the image."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: from --instrument, or else the largest without aliasing at the
    shortest wavelength."""
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
    n_frames: int | None = None
    """Number of short exposures; None: from --instrument, or else 20."""
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
        """Return the options that an instrument sets; all others follow from it."""
        return cls(
            scene=scene_of(known),
            n_pixels=known.camera.n_pixels,
            r0=known.site.r0,
            outer_scale=known.site.outer_scale,
            turbulence=TurbulenceOptions(wind=(known.site.wind, 0.0), exposure_time=known.exposure),
            conditions=ConditionOptions(n_wavelengths=known.n_wavelengths),
            readout_noise=known.camera.readout_noise,
            pixel_fill=known.camera.pixel_fill,
        )

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, a full pupil being its telescope."""
        names = ("wavelength", "n_pixels", "pixel_scale_arcsec", "r0", "outer_scale", "n_frames", "readout_noise")
        names = (*names, "pixel_fill", *(_FULL_PUPIL if str(self.mask) == FULL else ()))
        turbulence, conditions = self.turbulence, self.conditions
        return {name: getattr(self, name) for name in names} | {
            "wind": None if turbulence.wind is None else math.hypot(*turbulence.wind),
            "exposure": turbulence.exposure_time,
            "filter": conditions.filter,
            "width": conditions.band_width,
            "n_wavelengths": conditions.n_wavelengths,
            "temperature": conditions.temperature,
        }

    @property
    def scene_follows(self) -> bool:
        """Whether the size of the target is that of the file, whose angle it keeps."""
        known = self.known_instrument()
        return known is not None and self.scene.size == scene_of(known).size

    def used_instrument(self) -> Instrument | None:
        """Return the instrument of the file with what was given beside it, but for its light; None without a file."""
        used = super().used_instrument()
        if used is None or self.scene_follows:
            return used
        return with_size(used, self.scene.size * used.field_of_view / ARCSEC)

    def following(self, used: Instrument, area: float) -> Self:
        """Return the same with what follows from an instrument, for the light of an open area [m^2], unless given."""
        size = scene_of(used).size if self.scene_follows else self.scene.size
        return replace(
            self,
            scene=replace(self.scene, size=size),
            wavelength=used.mean_wavelength,
            pixel_scale_arcsec=used.pixel_scale / ARCSEC,
            conditions=self.conditions.following(used, area),
            n_photons=used.photons(area) if self.n_photons is None else self.n_photons,
            n_frames=used.frames,
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


def run(options: Options) -> None:
    """Simulate, and write the stack."""
    known = options.known_instrument()
    telescope = None if known is None else known.telescope
    told = load_aperture(options, telescope)
    assert options.mask is not None  # or it would not be loaded
    warn_of_blocked_holes(options.mask, told, telescope)
    true = options.true_mask.apply(told)
    aperture = true or told
    used = options.used_instrument()
    seen = options if used is None else options.following(used, float(told.area))
    wavelength = observing_wavelength(seen)
    options.require_its_wavelength(wavelength)
    n_photons = DEFAULT_PHOTONS if seen.n_photons is None else seen.n_photons
    n_frames = _DEFAULT_FRAMES if seen.n_frames is None else seen.n_frames
    require("--n-photons", options.n_photons, " electrons per frame", most=_MOST_PHOTONS)
    conditions = seen.conditions.make(options.turbulence.exposure_time, wavelength)
    turbulence = options.turbulence.make(options.r0, wavelength, options.outer_scale)
    pixel_scale = pixel_angle(seen.pixel_scale_arcsec)
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
    scene = make_scene(grid.shape, n_photons, seen.scene)
    kept = used and with_light(used, float(told.area), options.n_photons, options.conditions.sky)
    with new_run("simulate", options, options.seed) as output:
        output.keep_instrument(kept)
        generator, records = torch.Generator().manual_seed(options.seed), list[Record]()
        observation = simulate_observation(
            *(scene, aperture, grid, turbulence, detector, n_frames, generator),
            conditions=conditions,
            told=None if true is None else told,
            allow_overlap=options.allow_overlap,
            callback=fan_out(output.callback, records.append),
        )
        observation.save(output.directory / STACK)
        log_observation("observation", observation, output.logger, conditions.band)
        if isinstance(turbulence, LayeredPhase):
            output.summary.append(turbulence.layers.describe(wavelength))
        inside = records[-1].scalars["kept_light"]
        output.summary.append(
            f"{n_frames} frames of {grid.shape[0]} x {grid.shape[1]} pixels of "
            f"{grid.pixel_scale / ARCSEC:.4g} arcsec, {n_photons:.4g} photons in each, {100 * inside:.1f} % of the "
            "light inside the field"
        )
