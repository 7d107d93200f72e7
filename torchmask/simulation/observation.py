"""A stack of short exposures, and the end-to-end simulation that draws one.

The simulation shares no model with the inversion: the turbulent phase is sampled within each sub-aperture rather than
expanded in modes, on a pupil raster four times as fine, whose image is four times as wide as the field, and light that
leaves the field is lost.
"""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.io import load_npz, save_npz
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.optics.otf import psf_from_samples
from torchmask.optics.turbulence import TurbulencePhase
from torchmask.record import Callback, Record

_OVERSAMPLING = 4  # of the pupil: the field of the PSFs beside that of the image
_CHUNK = 2**21  # pixels of unfolded PSFs held at once

_NEEDED_NUMBERS = ("subaperture_diameter", "mask_diameter", "pixel_scale", "wavelength")
_NUMBERS = (*_NEEDED_NUMBERS, "readout_noise", "orientation", "central_obstruction", "r0", "outer_scale", "n_photons")
_IMAGES = ("object", "psfs", "valid", "errors")


@dataclass(frozen=True, eq=False)
class Observation:
    """Short exposures of one object, how they were taken and, where it is known, the truth behind them.

    frames : (T, H, W) electrons
    aperture, grid : what they were taken through
    readout_noise : electrons rms per pixel and frame; None where nobody knows it: the restoration measures it then
    object : (H, W) the scene in expected electrons per frame, on the frames' pixels
    psfs : (T, H, W) centred on pixel [H // 2, W // 2] and cropped to the field, not renormalised: what is missing to a
        sum of 1 fell outside
    r0, outer_scale : of the turbulence [m]
    n_photons : electrons per frame, before the field was cropped
    valid : (H, W) or (T, H, W) bool, False where a pixel is dead or saturated; None: all are valid
    errors : (T, H, W) electrons rms of each pixel, or None
    header : FITS cards that go with the frames: sky coordinates, target, telescope, filter, date

    The truth (object, psfs, r0, outer_scale, n_photons) is None where nobody knows it, as in a real observation.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> frames = torch.rand(5, 32, 32)
    >>> observation = Observation(frames, mask, Grid.nyquist(1.0, 550e-9, 32), readout_noise=1.5)
    >>> observation.object is None, len(observation.frames)
    (True, 5)
    """

    frames: Tensor
    aperture: Aperture
    grid: Grid
    readout_noise: float | None
    object: Tensor | None = None
    psfs: Tensor | None = None
    r0: float | None = None
    outer_scale: float | None = None
    n_photons: float | None = None
    valid: Tensor | None = None
    errors: Tensor | None = None
    header: Mapping[str, str | int | float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.frames.ndim != 3 or self.frames.shape[-2:] != self.grid.shape or not len(self.frames):
            raise ValueError(
                f"frames has shape {tuple(self.frames.shape)}: it must be (n_frames, {self.grid.shape[0]}, "
                f"{self.grid.shape[1]}), with at least one frame"
            )
        noise = self.readout_noise
        if noise is not None and not (math.isfinite(noise) and noise >= 0):
            raise ValueError(f"readout_noise is {noise}: it must be finite and not negative")
        for name, shape in (("object", self.grid.shape), ("psfs", self.frames.shape), ("errors", self.frames.shape)):
            values = getattr(self, name)
            if values is not None and tuple(values.shape) != tuple(shape):
                raise ValueError(f"{name} has shape {tuple(values.shape)}: it must be {tuple(shape)}")
        valid = self.valid
        if valid is not None and (
            valid.dtype != torch.bool or tuple(valid.shape) not in (self.grid.shape, tuple(self.frames.shape))
        ):
            raise ValueError(
                f"valid is {valid.dtype} of shape {tuple(valid.shape)}: it must be bool, (H, W) or (T, H, W)"
            )

    @classmethod
    def from_fits(
        cls,
        paths: str | Path | Sequence[str | Path],
        aperture: Aperture,
        *,
        wavelength: float | None = None,
        pixel_scale: float | None = None,
        unit: str | None = None,
        gain: float | None = None,
        exposure_time: float | None = None,
        readout_noise: float | None = None,
        dark: Any = None,
        flat: Any = None,
        bad_pixels: Any = None,
        crop: int | None = None,
        target: tuple[int, int] | None = None,
        keep: float | None = None,
        keep_by: str = "sharpness",
    ) -> Observation:
        """Read a telescope's exposures: a cube (T, H, W), an image, or a list of such files, in that order.

        An option left at None is taken from the header; what is given wins over it. Needs astropy (extra `data`).

        Parameters
        ----------
        paths : path or sequence of paths
            FITS files of one filter, pixel scale and orientation. The SCI extension is read, or else the first image;
            ERR becomes `errors`, DQ marks pixels that are not valid.
        aperture : Aperture
            That they were taken through, in metres on the pupil, x and y along the image's columns and rows.
        wavelength : float, optional
            [m]. Header: WAVELEN, or the FILTER of a known instrument.
        pixel_scale : float, optional
            [rad]. Header: PIXELSCL [arcsec], or CD, PC or CDELT.
        unit : str, optional
            Unit of the pixels, such as "adu", "electron / s" or "250 electron". Header: BUNIT; without it the pixels
            are in adu where a gain is known, and in electrons (with a warning) where none is.
        gain : float, optional
            Electrons per adu (DN, count). Header: EGAIN, GAIN.
        exposure_time : float, optional
            Of one frame [s], for units per second. Header: XPOSURE, EXPTIME; EFFINTTM for cubes of JWST.
        readout_noise : float, optional
            [electrons rms]. Header: RDNOISE, READNOIS. It may remain unknown.
        dark, flat, bad_pixels : path or (H, W) array, optional
            In the units of the file; of any scale; not 0 where bad. Of a cube the median is used.
        crop : int, optional
            Side of the field that is cut out around the target, which comes to pixel [crop // 2, crop // 2]: the same
            in all frames of a file, found afresh in every file. The sky coordinates move with it.
        target : (row, column), optional
            Pixel of the target in every file, counted from 0. None: where the mean frame is brightest.
        keep : float, optional
            Fraction of the frames to keep: those of highest `keep_by`, "sharpness" or "flux".

        Raises
        ------
        ValueError
            If a file is missing or damaged, a keyword that is needed is missing (the message names it and the option
            that stands for it), the files mix filters, pixel scales, shapes or orientations, or an option is wrong.
        """
        from torchmask.data.observe import observation_fields

        fields = observation_fields(
            paths,
            aperture,
            wavelength=wavelength,
            pixel_scale=pixel_scale,
            unit=unit,
            gain=gain,
            exposure_time=exposure_time,
            readout_noise=readout_noise,
            dark=dark,
            flat=flat,
            bad_pixels=bad_pixels,
            crop=crop,
            target=target,
            keep=keep,
            keep_by=keep_by,
        )
        return cls(**fields)

    def save(self, path: str | Path) -> None:
        """Write everything to a new .npz file (compressed, without pickle; the format of `load`).

        Raises ValueError if the file exists, its folder does not, or its name does not end in .npz.
        """
        aperture, grid = self.aperture, self.grid
        values = {
            "frames": self.frames,
            "pixel_scale": grid.pixel_scale,
            "wavelength": grid.wavelength,
            "centers": aperture.centers,
            "subaperture_diameter": aperture.subaperture_diameter,
            "mask_diameter": aperture.mask_diameter,
            "shape": aperture.shape,
            "orientation": aperture.orientation,
            "central_obstruction": aperture.central_obstruction,
        }
        optional = {name: getattr(self, name) for name in ("readout_noise", *_IMAGES, "r0", "outer_scale", "n_photons")}
        if self.header:
            optional["header"] = json.dumps(dict(self.header))
        save_npz(path, values | {name: value for name, value in optional.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read what `save` wrote, or any .npz file with its keys.

        Of an aperture, `shape`, `orientation` and `central_obstruction` may be missing, of an observation all that may
        be None. One centred disc is a full pupil of its own diameter, whatever `mask_diameter` says.

        Raises
        ------
        ValueError
            If the file is missing, damaged, holds pickled objects, lacks a key or holds arrays that disagree.
        """
        stored = load_npz(path, required=("frames", "centers", *_NEEDED_NUMBERS))
        try:
            return cls._from_arrays(stored)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} holds no valid observation: {error}") from error

    @classmethod
    def _from_arrays(cls, stored: dict[str, Any]) -> Observation:
        number = {name: float(stored[name].item()) for name in _NUMBERS if name in stored}
        centers, diameter = torch.from_numpy(stored["centers"]), number["subaperture_diameter"]
        shape, orientation = str(stored.get("shape", "disc")), number.get("orientation", 0.0)
        if len(centers) == 1 and not centers.any() and shape == "disc":
            aperture = FullAperture(diameter, number.get("central_obstruction", 0.0), dtype=centers.dtype)
        else:
            aperture = SparseAperture(centers, diameter, number["mask_diameter"], shape, orientation)
        frames = torch.from_numpy(stored["frames"])
        height, width = frames.shape[-2:]
        grid = Grid(height if height == width else (height, width), number["pixel_scale"], number["wavelength"])
        optional: dict[str, Any] = {name: torch.from_numpy(stored[name]) for name in _IMAGES if name in stored}
        optional |= {name: number[name] for name in ("r0", "outer_scale", "n_photons") if name in number}
        if "header" in stored:
            optional["header"] = json.loads(str(stored["header"]))
        return cls(frames, aperture, grid, number.get("readout_noise"), **optional)


def simulate_observation(
    scene: Tensor,
    aperture: Aperture,
    grid: Grid,
    turbulence: TurbulencePhase | None,
    detector: Detector,
    n_frames: int,
    generator: torch.Generator | None = None,
    *,
    callback: Callback | None = None,
) -> Observation:
    """Draw short exposures of a scene, end to end.

    Parameters
    ----------
    scene : (H, W) tensor
        Expected electrons per pixel and frame before any blur; its sum is the number of photons that the aperture
        collects in a frame. All of it lies within the field.
    aperture : Aperture
        One aperture, without leading axes.
    grid : Grid
    turbulence : TurbulencePhase or None
        None for a perfect atmosphere.
    detector : Detector
    n_frames : int
    generator : torch.Generator, optional
        Seeds one stream for the screens and one for the noise: another flux or read-out noise leaves the screens as
        they were.
    callback : callable, optional
        Receives a `Record` of stage "simulation" after each chunk of frames, with the frames so far.

    Returns
    -------
    Observation
        Of the scene's dtype and device, detached.

    Raises
    ------
    ValueError
        If the scene does not fit the grid, is negative, black or not finite, the aperture is a population,
        `n_frames` is below 1, or the grid samples the aperture too coarsely.

    Examples
    --------
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> scene = torch.zeros(32, 32, dtype=torch.float64); scene[12:20, 14:18] = 1000.0
    >>> observation = simulate_observation(
    ...     scene, mask, Grid.nyquist(1.0, 550e-9, 32), TurbulencePhase(0.15, 20.0), Detector(1.5), n_frames=4,
    ...     generator=torch.Generator().manual_seed(0))
    >>> observation.frames.shape
    torch.Size([4, 32, 32])
    """
    scene = scene.detach()
    _check(scene, aperture, grid, n_frames)
    device = None if generator is None else generator.device
    screens_seed, noise_seed = torch.randint(2**62, (2,), generator=generator, device=device).tolist()
    noise = torch.Generator().manual_seed(noise_seed)
    with torch.no_grad():
        samples = aperture.samples(grid, _OVERSAMPLING)
        phases = None
        if turbulence is not None:
            phases = turbulence(samples, n_frames, torch.Generator().manual_seed(screens_seed))
        chunk = max(1, _CHUNK // math.prod(samples.raster))
        frames, psfs = [], []
        for first in range(0, n_frames, chunk):
            count = min(chunk, n_frames - first)
            phase = None if phases is None else phases[first : first + count]
            unfolded = psf_from_samples(samples, phase).to(scene).expand(count, *samples.raster)
            frames.append(detector(image_formation(scene, unfolded), noise))
            psfs.append(_centre(unfolded, grid.shape))
            if callback is not None:
                light = {"kept_light": float(frames[-1].sum() / (count * scene.sum()))}
                callback(Record("simulation", first + count, n_frames, light, {"frames": torch.cat(frames)}))
    return Observation(
        frames=torch.cat(frames),
        aperture=copy.deepcopy(aperture).requires_grad_(False),  # a mask that trains on does not change the past
        grid=grid,
        readout_noise=detector.readout_noise,
        object=scene,
        psfs=torch.cat(psfs),
        r0=None if turbulence is None else float(turbulence.r0),
        outer_scale=None if turbulence is None else float(turbulence.outer_scale),
        n_photons=float(scene.sum()),
    )


def _check(scene: Tensor, aperture: Aperture, grid: Grid, n_frames: int) -> None:
    if tuple(scene.shape) != grid.shape:
        raise ValueError(f"scene has shape {tuple(scene.shape)}: the grid needs {grid.shape}")
    if not scene.is_floating_point():
        raise ValueError(f"scene has dtype {scene.dtype}: it must be floating point, in electrons per frame")
    if not bool(torch.isfinite(scene).all()):
        raise ValueError("scene holds values that are not finite")
    if float(scene.min()) < 0:
        raise ValueError(f"scene holds negative light ({float(scene.min()):.3g} electrons): clip it at 0")
    if float(scene.sum()) == 0:
        raise ValueError("scene is black: scale it so that its sum is the number of photons per frame")
    if aperture.centers.ndim != 2:
        raise ValueError(f"aperture is a population {tuple(aperture.centers.shape[:-2])}: simulate one at a time")
    if n_frames != int(n_frames) or n_frames < 1:
        raise ValueError(f"n_frames is {n_frames}: it must be a whole number of at least 1")


def _centre(psfs: Tensor, shape: tuple[int, int]) -> Tensor:
    """Crop PSFs with their origin at [0, 0] to `shape`, the origin at its middle."""
    middle = (shape[0] // 2, shape[1] // 2)
    return psfs.roll(middle, dims=(-2, -1))[..., : shape[0], : shape[1]].clone()
