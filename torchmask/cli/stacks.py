"""Reading a stack of exposures, with options that override what its files say."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from torchmask.cli.agreement import complete, planned_scale, require_time
from torchmask.cli.config import CONFIG
from torchmask.cli.cubes import require_one_map, require_wide_frames
from torchmask.cli.options import (
    InstrumentOptions,
    MaskOptions,
    load_aperture,
    mask_file_wavelength,
    pixel_angle,
)
from torchmask.data.keywords import missing
from torchmask.data.light import usable_frames
from torchmask.data.observe import read_observation
from torchmask.grid import Grid
from torchmask.instrument.instrument import Instrument
from torchmask.io import as_tensor, load_npz
from torchmask.numbers import require_wavelength
from torchmask.observation import Observation, check_frames
from torchmask.optics.pixel import jittered, square_pixel
from torchmask.optics.sky_scale import MATRIX, cards_at, stated_side, warn_of_other_scales
from torchmask.restoration.noise import check_errors

STACK = "stack.npz"  # its name in the folder of a run


@dataclass(frozen=True)
class FITSOptions:
    """Values that the header of a FITS file may lack, over which they take precedence, and calibration."""

    unit: str | None = None
    """Unit of the pixels, such as "adu", "electron / s" or "250 electron"; None: from the header (BUNIT), else adu."""
    gain: float | None = None
    """Gain [electrons per adu]; None: from the header (EGAIN, GAIN)."""
    saturation: float | None = None
    """Value in the file, in its unit, at which pixels saturate; None: from the header (SATURATE, FULLWELL), or where
    pixels pile up."""
    dark: Path | None = None
    """FITS image to subtract, in the units of the files."""
    flat: Path | None = None
    """FITS image to divide by, of any scale."""
    bad_pixels: Path | None = None
    """FITS image that is not 0 where a pixel is bad."""
    crop: int | None = None
    """Side of the field to cut out around the target [pixels]; None: the whole image."""
    target: tuple[int, int] | None = None
    """Pixel of the target in every file: row column, counted from 0; None: where the mean frame is brightest."""
    keep: float | None = None
    """Fraction of the frames to keep, the best ones; None: all."""
    keep_by: Literal["sharpness", "flux"] = "sharpness"
    """Quantity by which the best frames are chosen."""


@dataclass(frozen=True)
class StackOptions(InstrumentOptions, MaskOptions, FITSOptions):
    """Options that override what the files say."""

    wavelength: float | None = None
    """Wavelength of the observation [m]; None: from the file, or else from --instrument or the mask's .json file."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: from the file, or else from --instrument."""
    exposure_time: float | None = None
    """Exposure time of one frame [s]; None: from the file, or else from --instrument."""
    readout_noise: float | None = None
    """Read-out noise [electrons rms per pixel and frame]; None: from the file or --instrument, or else measured on the
    frames."""
    pixel_fill: float | None = None
    """Sensitive fraction of the area of a pixel, 1 for pixels without gaps, 0 for points; None: from the file or
    --instrument, or else points."""
    jitter: float | None = None
    """Known motion of the image during a frame, as by vibrations, standard deviation along each axis [pixels]; None:
    from the file, or else none."""
    skip: tuple[int, ...] = ()
    """Numbers of frames to leave out, counted from 0 through all files of a stack."""
    errors: bool = True
    """Weight pixels by the standard deviations in the file (FITS extension ERR), if any; photon noise counts evenly."""


def group_files(files: Sequence[Path], join: bool) -> dict[str, list[Path]]:
    """Return the files of each stack by a unique name: that of the (first) file, with a number if it occurs twice."""
    groups = [list(files)] if join and files else [[file] for file in files]
    named: dict[str, list[Path]] = {}
    for group in groups:
        name, number = group[0].stem, 1
        while name in named:
            number += 1
            name = f"{group[0].stem}-{number}"
        named[name] = group
    return named


def read_stack(files: Sequence[Path], options: StackOptions) -> Observation:
    """Read one stack: an .npz file, or FITS files that belong together. Raises ValueError if it cannot be used."""
    if options.wavelength is not None:
        require_wavelength("--wavelength", options.wavelength)
    pixel = None if options.pixel_fill is None else square_pixel(options.pixel_fill)
    for path in files:
        _require_stack(path)
    known = options.known_instrument()
    observation = _read(files, options, known)
    if options.pixel_fill is not None:
        observation = dataclasses.replace(observation, pixel=pixel)
    if known is not None:
        observation = complete(observation, known, _given(options), files[0])
    if options.jitter is not None:
        observation = dataclasses.replace(observation, pixel=jittered(observation.pixel, options.jitter))
    numbers = observation.frame_numbers
    try:
        frames, valid = check_frames(observation.frames, observation.valid, observation.grid, numbers)
    except ValueError as error:
        raise ValueError(f"{files[0]}: {error}") from error
    if not options.errors or observation.errors is None:
        return dataclasses.replace(observation, errors=None)
    try:
        check_errors(observation.errors, frames, valid, numbers)
    except ValueError as error:
        raise ValueError(f"{files[0]}: {error}; or give --no-errors to weight all pixels equally") from error
    return observation


def _require_stack(path: Path) -> None:
    """Raise ValueError unless this is a file that may hold frames; the message says where a folder has them."""
    if path.is_dir():
        raise ValueError(f"{path} is a folder: {_frames_in(path)}")
    if not path.is_file():
        raise ValueError(f"there is no file {path} (needed: a stack of exposures, .npz or .fits)")
    if path.suffix.lower() in (".json", ".dxf"):
        raise ValueError(f"{path} is not a stack of frames: give an .npz or FITS file (a mask belongs to --mask)")


def _frames_in(folder: Path) -> str:
    """Return what of a folder to give; FITS files of a run are its results."""
    if (folder / STACK).is_file():
        return f"give the stack in it, {folder / STACK}"
    if any(folder.glob("*.fits")) and not (folder / CONFIG).is_file():
        return f"give the FITS files in it, such as {folder / '*.fits'}"
    return "it holds no stack of frames, so give an .npz file of `torchmask simulate`, or FITS files"


def _given(options: StackOptions) -> set[str]:
    """Return the names of the options that have a value."""
    return {item.name for item in dataclasses.fields(options) if getattr(options, item.name) is not None}


def _read(files: Sequence[Path], options: StackOptions, known: Instrument | None) -> Observation:
    telescope = None if known is None else known.telescope
    stacks = [path for path in files if path.suffix.lower() in (".npz", ".npy")]
    if not stacks:
        return _from_fits(files, options, known)
    if len(files) > 1:
        raise ValueError(f"--join is for FITS files, but {stacks[0]} is a stack by itself: leave out one or the other")
    if files[0].suffix.lower() == ".npy":
        raise ValueError(f"{files[0]} is a bare array: write it as `frames` [electrons] to an .npz file by numpy.savez")
    _refuse(options, FITSOptions, f"is for FITS files, but {files[0]} is not one: leave it out")
    if options.mask is None:
        _refuse(options, MaskOptions, f"is for --mask, which is not given: {files[0]} has a mask of its own")
    observation = _from_npz(files[0], options, known)
    grid, scale = observation.grid, pixel_angle(options.pixel_scale_arcsec)
    if scale is not None:
        stated = {"the file": grid.pixel_scale, MATRIX: stated_side(observation.header)}
        warn_of_other_scales(files[0], scale, stated, stacklevel=2)
    scale = scale or grid.pixel_scale
    header = cards_at(observation.header, scale)
    changes: dict[str, Any] = {"grid": Grid(grid.n_pixels, scale, options.wavelength or grid.wavelength)}
    if options.mask is not None:
        changes["aperture"] = load_aperture(options, telescope)
    if options.exposure_time is not None:
        require_time(options.exposure_time)
        header["XPOSURE"] = options.exposure_time
    if options.readout_noise is not None:
        changes["readout_noise"] = options.readout_noise
    return _usable(dataclasses.replace(observation, header=header, **changes), files[0], options)


def _from_npz(path: Path, options: StackOptions, known: Instrument | None) -> Observation:
    """Read an .npz file: an observation, or frames without a mask.

    Raises ValueError if the file is neither, or holds no wavelength of light in metres.
    """
    try:
        observation = Observation.load(path)
    except ValueError:
        stored = load_npz(path, required=("frames",))
        if "centers" in stored:
            raise
        observation = _from_frames(path, stored, options, known)
    require_wavelength(f"{path}: wavelength", observation.grid.wavelength)
    return observation


def _from_frames(
    path: Path, stored: Mapping[str, np.ndarray], options: StackOptions, known: Instrument | None
) -> Observation:
    """Return frames [electrons], which the arrays of a file hold, with what options say of them, as of FITS files.

    Raises ValueError if neither the file nor an option says what is needed, or an array has a wrong shape.
    """
    if options.mask is None:
        raise ValueError(f"{path} has no 'centers' of a mask: give --mask")
    aperture = load_aperture(options, None if known is None else known.telescope)
    planned = (mask_file_wavelength(options), None) if known is None else (known.mean_wavelength, planned_scale(known))
    told = {name: stored[name] for name in ("wavelength", "pixel_scale", "readout_noise") if name in stored}
    for name, value in told.items():
        if value.size != 1:
            raise ValueError(f"{path}: {name} has shape {value.shape}: one number is needed")
    told = {name: value.item() for name, value in told.items()}
    wavelength = options.wavelength or told.get("wavelength") or planned[0]
    scale = told.get("pixel_scale") or pixel_angle(options.pixel_scale_arcsec) or planned[1]  # an option has its turn
    if wavelength is None:
        raise missing(path, "wavelength", "--wavelength [m]")
    if scale is None:
        raise missing(path, "pixel_scale", "--pixel-scale-arcsec [arcsec]")
    arrays: dict[str, Any] = {
        name: as_tensor(stored[name], "cpu") for name in ("frames", "valid", "errors") if name in stored
    }
    shape = tuple(arrays["frames"].shape)
    if len(shape) == 3 and shape[0] == shape[1] != shape[2]:
        warnings.warn(
            f"{path}: frames has shape {shape}, and so holds {shape[0]} frames of {shape[1]} x {shape[2]} pixels: if "
            "the last axis counts frames, move it to the front",
            stacklevel=2,
        )
    try:
        grid = Grid(shape[-2:], scale, wavelength)
        return Observation(aperture=aperture, grid=grid, readout_noise=told.get("readout_noise"), **arrays)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def require_fine_pixels(observation: Observation, options: StackOptions, path: Path) -> None:
    """Raise ValueError, which blames the file, if the pixel scale that it states undersamples the image."""
    if options.pixel_scale_arcsec is not None:
        return
    try:
        observation.grid.require_sampling(observation.aperture.extent)
    except ValueError as error:
        told = str(error).replace("pixel_scale", "the pixel scale")  # which `wording` would take for the option
        raise ValueError(f"{path}: {told}; correct it in the file, or give --pixel-scale-arcsec") from error


def _refuse(options: StackOptions, group: type, reason: str) -> None:
    """Raise ValueError if an option of this group is given."""
    for item in dataclasses.fields(group):
        if getattr(options, item.name) != item.default:
            raise ValueError(f"--{item.name.replace('_', '-')} {reason}")


def _usable(observation: Observation, path: Path, options: StackOptions) -> Observation:
    """Return the observation with the frames that hold light and are not skipped."""
    frames = observation.frames
    valid = torch.isfinite(frames) if observation.valid is None else observation.valid.expand_as(frames)
    try:
        kept = usable_frames(frames.numpy(), valid.numpy(), options.skip, observation.frame_numbers)
        return observation.take(kept)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _from_fits(files: Sequence[Path], options: StackOptions, known: Instrument | None) -> Observation:
    """Read FITS files. Raises ValueError as `read_observation`, but asks for a missing pixel scale in arcsec."""
    aperture = load_aperture(options, None if known is None else known.telescope)
    require_one_map(options.bad_pixels)
    scale = pixel_angle(options.pixel_scale_arcsec)
    given = {item.name: getattr(options, item.name) for item in dataclasses.fields(FITSOptions)}
    given |= {"wavelength": options.wavelength, "readout_noise": options.readout_noise}
    given |= {"skip": options.skip, "exposure_time": options.exposure_time}
    given["design_wavelength"] = mask_file_wavelength(options) if known is None else known.mean_wavelength
    given["design_pixel_scale"] = None if known is None else planned_scale(known)
    try:
        observation = read_observation(files, aperture, pixel_scale=scale, **given)
    except ValueError as error:
        raise ValueError(str(error).replace("give pixel_scale [rad]", "give --pixel-scale-arcsec [arcsec]")) from error
    require_wide_frames(observation, files[0])
    return observation
