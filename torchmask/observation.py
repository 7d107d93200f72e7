"""A stack of short exposures with all that is known about it, and its checks."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.io import as_tensor, load_npz, save_npz
from torchmask.optics.aperture import Aperture
from torchmask.optics.bad_pixels import fill_bad_pixels
from torchmask.optics.copies import copies_among
from torchmask.optics.pixel import PixelResponse, pixel_record, read_pixel
from torchmask.optics.records import aperture_record, read_aperture
from torchmask.optics.sky_scale import matrix_at
from torchmask.record import Brief

_NEEDED_NUMBERS = ("subaperture_diameter", "mask_diameter", "pixel_scale", "wavelength")

_OPTIONAL_NUMBERS = ("r0", "outer_scale", "n_photons", "background")

_NUMBERS = (*_NEEDED_NUMBERS, "readout_noise", *_OPTIONAL_NUMBERS)

_ARRAYS = ("object", "psfs", "phases", "valid", "errors", "transmission")

_TRUE = "true_"  # prefix of the true aperture's entries in a file

PHASE_OVERSAMPLING = 4  # oversampling of the pupil samples on which phases are stored


@dataclass(frozen=True, eq=False, repr=False)
class Observation(Brief):
    """Short exposures of one object, how they were taken and, for simulations, the truth behind them.

    frames : (T, H, W) exposures [electrons]
    aperture : aperture through which they were taken, as far as the observer knows
    grid : pixels and wavelength of the frames
    readout_noise : read-out noise [electrons rms per pixel and frame]; None if unknown: the restoration measures it
    object : (H, W) true scene, expected electrons per pixel and frame
    psfs : (T, H, W) true PSFs, centred on pixel [H // 2, W // 2] and cropped to the field; sums below 1 mean lost light
    phases : (T, N, P) true phases [rad] on the pupil samples `aperture.samples(grid, PHASE_OVERSAMPLING)`, as `PSF`
        takes them and `ZernikePhase` returns them with that oversampling
    r0 : true Fried parameter [m]
    outer_scale : true outer scale of the turbulence [m]
    n_photons : true number of electrons per frame, including those outside the field
    valid : (H, W) or (T, H, W) bool, False for dead and saturated pixels; None if all are valid
    errors : (T, H, W) standard deviation of each pixel [electrons], or None
    true_aperture : real aperture, if it differs from `aperture`
    background : true sky [electrons per pixel and frame]
    transmission : (T,) true transmission of each frame, 1 on average
    header : FITS cards that belong to the frames: sky coordinates, target, telescope, filter, date
    pixel : blur by the detector's pixels, which psfs include; None if they are points
    frame_numbers : number of each frame in the files it was read from, counted from 0 through all of them; 0 to T - 1
        by default

    Raises ValueError if an array does not fit the grid, the frames or their number, `valid` is not bool, or the
    read-out noise is negative or not finite.

    In real observations the truth (object, psfs, phases, r0, outer_scale, n_photons, background, transmission,
    true_aperture) is None.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
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
    phases: Tensor | None = None
    true_aperture: Aperture | None = None
    background: float | None = None
    transmission: Tensor | None = None
    pixel: PixelResponse | None = None
    frame_numbers: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.frames.ndim != 3 or self.frames.shape[-2:] != self.grid.shape or not len(self.frames):
            raise ValueError(
                f"frames has shape {tuple(self.frames.shape)}: it must be (n_frames, {self.grid.shape[0]}, "
                f"{self.grid.shape[1]}), with at least one frame"
            )
        noise = self.readout_noise
        if noise is not None and not (math.isfinite(noise) and noise >= 0):
            raise ValueError(f"readout_noise is {noise}: it must be finite and not negative, in electrons rms")
        object.__setattr__(self, "frame_numbers", number_frames(self.frame_numbers, len(self.frames)))
        shapes = {"object": self.grid.shape, "psfs": self.frames.shape, "errors": self.frames.shape}
        shapes["transmission"] = (len(self.frames),)
        if self.phases is not None:
            samples = self.aperture.samples(self.grid, PHASE_OVERSAMPLING)
            shapes["phases"] = (len(self.frames), *samples.weights.shape)
        for name, shape in shapes.items():
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

    @property
    def sky_matrix(self) -> Tensor | None:
        """Matrix (2, 2) that converts pixels (x, y) to angles (east, north) on the sky [rad].

        It is None if the header has no sky coordinates. Where their scale contradicts that of `grid` by more than 1 %,
        only their orientation counts. Needs astropy (extra `data`).
        """
        matrix = matrix_at(self.header, self.grid.pixel_scale) if self.header else None
        return None if matrix is None else torch.from_numpy(matrix)

    @property
    def exposure_time(self) -> float | None:
        """Exposure time of a frame [s], which is XPOSURE in the header; None if it is not known."""
        time = self.header.get("XPOSURE")
        return float(time) if isinstance(time, int | float) else None

    def take(self, frames: Sequence[int] | np.ndarray) -> Observation:
        """Return the observation reduced to frames at these positions, from 0; `frame_numbers` keeps their numbers."""
        chosen = torch.as_tensor(np.asarray(frames, dtype=np.int64), device=self.frames.device)
        per_frame = ["frames", "psfs", "phases", "errors", "transmission"]
        if self.valid is not None and self.valid.ndim == 3:
            per_frame.append("valid")
        parts = {name: getattr(self, name) for name in per_frame}
        numbers = tuple(self.frame_numbers[position] for position in chosen.tolist())
        return replace(
            self,
            frame_numbers=numbers,
            **{name: part[chosen] for name, part in parts.items() if part is not None},
        )

    def save(self, path: str | Path) -> None:
        """Write the observation to a new compressed .npz file, which `load` reads.

        Raises ValueError if the file exists, its folder does not, its name does not end in .npz, or `pixel` is of
        a class of your own.
        """
        grid = self.grid
        values = {
            "frames": self.frames,
            "pixel_scale": grid.pixel_scale,
            "wavelength": grid.wavelength,
            "frame_numbers": np.array(self.frame_numbers),
            **aperture_record(self.aperture),
            **pixel_record(self.pixel),
        }
        if self.true_aperture is not None:
            record = aperture_record(self.true_aperture)
            values |= {_TRUE + name: value for name, value in record.items()}
        optional = {name: getattr(self, name) for name in ("readout_noise", *_ARRAYS, *_OPTIONAL_NUMBERS)}
        if self.header:
            optional["header"] = json.dumps(dict(self.header))
        save_npz(path, values | {name: value for name, value in optional.items() if value is not None})

    @classmethod
    def load(cls, path: str | Path) -> Observation:
        """Read an observation written by `save`, or any .npz file with the same keys.

        Keys of values that may be None may be missing, and so may the `shape` of the holes, which are discs by default.
        A single centred disc is a full pupil of its own diameter, whatever `mask_diameter` says.

        Raises
        ------
        ValueError
            If the file is missing or damaged, contains pickled objects, lacks a key or has arrays that disagree.
        """
        stored = load_npz(path, required=("frames", "centers", *_NEEDED_NUMBERS))
        try:
            return cls._from_arrays(stored)
        except (ValueError, TypeError) as error:
            raise ValueError(f"{path} does not contain a valid observation: {error}") from error

    @classmethod
    def _from_arrays(cls, stored: dict[str, Any]) -> Observation:
        number = {name: float(stored[name].item()) for name in _NUMBERS if name in stored}
        aperture = _read_aperture(stored, "")
        frames = torch.from_numpy(stored["frames"])
        height, width = frames.shape[-2:]
        grid = Grid(height if height == width else (height, width), number["pixel_scale"], number["wavelength"])
        true_aperture = _read_aperture(stored, _TRUE) if f"{_TRUE}centers" in stored else None
        optional: dict[str, Any] = {"true_aperture": true_aperture, "pixel": read_pixel(stored)} | {
            name: torch.from_numpy(stored[name]) for name in _ARRAYS if name in stored
        }
        optional |= {name: number[name] for name in _OPTIONAL_NUMBERS if name in number}
        if "frame_numbers" in stored:
            optional["frame_numbers"] = tuple(stored["frame_numbers"].tolist())
        if "header" in stored:
            optional["header"] = json.loads(str(stored["header"]))
        return cls(frames, aperture, grid, number.get("readout_noise"), **optional)


def number_frames(numbers: Sequence[int], n_frames: int) -> tuple[int, ...]:
    """Return the numbers of `n_frames` frames: those given, or 0, 1, ... if none are.

    Raises ValueError unless there are as many numbers as frames.
    """
    if len(numbers) not in (0, n_frames):
        raise ValueError(f"frame_numbers has {len(numbers)} numbers for {n_frames} frames: give one for each frame")
    return tuple(numbers) or tuple(range(n_frames))


def check_frames(
    frames: Tensor | np.ndarray, valid: Tensor | np.ndarray | None, grid: Grid, numbers: Sequence[int] = ()
) -> tuple[Tensor, Tensor]:
    """Return frames (T, H, W) in float64 with their invalid pixels filled in, and `valid` as (T, H, W).

    Pixels that are not valid have no weight in later fits, but means and Fourier transforms need values for them, which
    `fill_bad_pixels` provides.

    Raises TypeError if frames are no numbers, and ValueError if they are complex, a shape is wrong, a valid pixel is
    not finite, or a frame has no valid pixel or no light.
    The message names frames by `numbers`, or from 0 if none are given.
    """
    frames = as_tensor(frames)
    if frames.is_complex():
        raise ValueError(f"frames are {frames.dtype}: they must be real, in electrons")
    if frames.ndim != 3 or tuple(frames.shape[1:]) != grid.shape or not len(frames):
        is_last = frames.ndim == 3 and tuple(frames.shape[:2]) == grid.shape
        raise ValueError(
            f"frames has shape {tuple(frames.shape)}: the grid needs (n_frames, {grid.shape[0]}, {grid.shape[1]}), "
            "with at least one frame" + (": move the last axis, which counts frames, to the front" if is_last else "")
        )
    frames = frames.detach().double()
    if valid is None:
        valid = torch.ones_like(frames, dtype=torch.bool)
    else:
        valid = as_tensor(valid, frames.device)
        if valid.dtype != torch.bool or tuple(valid.shape) not in (grid.shape, tuple(frames.shape)):
            raise ValueError(
                f"valid is {valid.dtype} of shape {tuple(valid.shape)}: it must be bool, of shape {grid.shape} or "
                f"{tuple(frames.shape)}"
            )
        valid = valid.expand(frames.shape)
        frames = fill_bad_pixels(frames, valid)
    named = torch.tensor(number_frames(numbers, len(frames)), device=frames.device)
    unseen = ~valid.any(2).any(1)
    if bool(unseen.any()):
        raise ValueError(
            f"frames {named[unseen].tolist()} have no valid pixel: leave them out, or see whether `valid` is True "
            "where a pixel counts"
        )
    bad = ~torch.isfinite(frames).flatten(1).all(1)
    if bool(bad.any()):
        raise ValueError(f"frames {named[bad].tolist()} hold values that are not finite: mark those pixels in `valid`")
    dark = frames.mean((1, 2)) <= 0
    if bool(dark.any()):
        raise ValueError(
            f"frames {named[dark].tolist()} hold no light: their mean pixel is not positive. Leave them out, or "
            "subtract less sky and dark"
        )
    return frames, valid


def warn_of_copies(frames: Tensor, stacklevel: int) -> None:
    """Warn of frames (T, H, W) that repeat earlier ones, as if it were raised `stacklevel` calls above."""
    if copies := copies_among(frames):
        warnings.warn(
            f"frames {copies} of this stack, counted from 0, repeat earlier ones pixel by pixel, as a file that is "
            "read twice does: they tell nothing new, but count as much, so leave them out",
            stacklevel=stacklevel + 1,
        )


def _read_aperture(stored: Mapping[str, Any], prefix: str) -> Aperture:
    own = {name.removeprefix(prefix): array for name, array in stored.items() if name.startswith(prefix)}
    values = {
        name: array.item() if array.size == 1 else array.tolist() for name, array in own.items() if array.ndim < 2
    }
    return read_aperture(values | {"centers": torch.from_numpy(own["centers"])})
