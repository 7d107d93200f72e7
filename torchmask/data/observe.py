"""Reading an observation from FITS files: checks, calibration, cropping, selection and conversion to electrons."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from torchmask.data import keywords
from torchmask.data.calibration import best_frames, calibrate, crop_corner, find_target
from torchmask.data.checks import check_alike, check_field_rotation, check_given_scale, check_options, check_rotation
from torchmask.data.fits import FITSImages, read_fits
from torchmask.data.light import opened_files, usable_frames
from torchmask.data.reference import reference_image
from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture
from torchmask.optics.saturation import find_saturated
from torchmask.optics.sky_scale import cards_at

PathLike = str | Path
_T = TypeVar("_T")


def read_observation(
    paths: PathLike | Sequence[PathLike],
    aperture: Aperture,
    *,
    wavelength: float | None = None,
    design_wavelength: float | None = None,
    pixel_scale: float | None = None,
    design_pixel_scale: float | None = None,
    unit: str | None = None,
    gain: float | None = None,
    exposure_time: float | None = None,
    readout_noise: float | None = None,
    saturation: float | None = None,
    dark: Any = None,
    flat: Any = None,
    bad_pixels: Any = None,
    crop: int | None = None,
    target: tuple[int, int] | None = None,
    skip: Sequence[int] = (),
    keep: float | None = None,
    keep_by: str = "sharpness",
) -> Observation:
    """Read a telescope's exposures from FITS files: cubes (T, H, W) or images, in the order given.

    Options that are not given are read from the header; those that are take precedence. The pixels are points, or
    squares without gaps if INSTRUME is NIRISS or NIRCAM. Needs astropy (extra `data`).

    Parameters
    ----------
    paths : path or sequence of paths
        FITS files of one filter, pixel scale and orientation. The SCI extension is read, or else the first image;
        ERR becomes `errors`; DQ, BADPIX or BPM mark pixels that are not valid. Files whose header says dark, bias or
        closed shutter are left out with a warning, and so are frames that hold no light.
    aperture : Aperture
        Aperture through which the exposures were taken, in metres on the pupil, with x and y along the columns and
        rows of the image.
    wavelength : float, optional
        Wavelength [m]. Header: WAVELEN, or the FILTER of a known instrument.
    design_wavelength : float, optional
        Wavelength for which the mask was designed [m], used if there is no other.
    pixel_scale : float, optional
        Angle of a pixel [rad]. Header: PIXELSCL [arcsec], or CD, PC or CDELT. Whatever decides, the sky coordinates of
        the observation keep their orientation and get this scale.
    design_pixel_scale : float, optional
        Angle of a pixel for which the instrument was planned [rad], used if there is no other.
    unit : str, optional
        Unit of the pixels, such as "adu", "electron / s" or "250 electron". Header: BUNIT; without it the pixels
        are in adu, and a gain is needed.
    gain : float, optional
        Gain [electrons per adu, DN or count]. Header: EGAIN, GAIN.
    exposure_time : float, optional
        Exposure time of one frame [s], for units per second. Header: XPOSURE, EXPTIME; EFFINTTM for cubes of JWST.
    readout_noise : float, optional
        Read-out noise [electrons rms]. Header: RDNOISE, READNOIS. It may remain unknown.
    saturation : float, optional
        Value in the file, in its unit, at and above which a pixel is saturated and not valid. Header: SATURATE, or
        FULLWELL [electrons]. Without them it is the largest value, if pixels pile up there (`find_saturated`).
    dark : path or (H, W) array, optional
        Dark image in the units of the file, of the same exposure time. Of a cube the median is used, as for `flat` and
        `bad_pixels`.
    flat : path or (H, W) array, optional
        Flat field, of any scale.
    bad_pixels : path or (H, W) array, optional
        Bad-pixel map, not 0 where a pixel is bad.
    crop : int, optional
        Side [pixels] of the field to cut out with the target on its pixel [crop // 2, crop // 2]. It is the same for
        all frames of a file but may differ between files. The sky coordinates are adjusted.
    target : (row, column), optional
        Pixel of the target in every file, counted from 0; by default, where the mean frame is brightest.
    skip : sequence of int
        Frames to leave out, counted from 0 through all files, also those without light; `frame_numbers` of the
        observation, and all messages, count in the same way.
    keep : float, optional
        Fraction of the frames to keep, those with the highest `keep_by`.
    keep_by : {"sharpness", "flux"}
        Quantity by which `keep` selects frames.

    Raises
    ------
    ValueError
        If a file is missing or damaged; a keyword that is needed is missing (the message names it and the option to
        give instead); the files mix filters, wavelengths, pixel scales, shapes or orientations; or an option is out of
        range, such as a wavelength in nm or a pixel scale in arcsec.
    TypeError
        If a number has a unit of astropy, or `unit` is no text.

    Warns
    -----
    UserWarning
        If files or frames are left out, pixels are saturated, frames are clouded, a dark has another exposure time, a
        header states two pixel scales, or another than is given, that differ by more than 1 %, the parallactic angles
        (PARANG, ESO TEL PARANG) say that the sky turned in the field, only some of the files have sky coordinates, or
        only some have an ERR or a read-out noise, which are not used then.

    Examples
    --------
    >>> import tempfile
    >>> from astropy.io import fits
    >>> from torchmask.optics.aperture import SparseAperture
    >>> path = tempfile.mkdtemp() + "/cube.fits"
    >>> header = fits.Header({"BUNIT": "electron", "PIXELSCL": 0.05, "WAVELEN": 550e-9, "RDNOISE": 1.5})
    >>> fits.writeto(path, np.ones((5, 32, 32), dtype="float32"), header)
    >>> observation = read_observation(path, SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0))
    >>> observation.frames.shape, observation.readout_noise
    (torch.Size([5, 32, 32]), 1.5)
    """
    positive = {
        "wavelength": wavelength,
        "design_wavelength": design_wavelength,
        "pixel_scale": pixel_scale,
        "design_pixel_scale": design_pixel_scale,
        "gain": gain,
        "exposure_time": exposure_time,
        "saturation": saturation,
    }
    check_options(positive, readout_noise, keep, keep_by, unit)
    crop = None if crop is None else whole_number("crop", crop, least=2, note=", in pixels")
    if target is not None and crop is None:
        raise ValueError(f"target is {target}, but there is no field to cut out around it: give crop [pixels] too")
    files = [read_fits(path) for path in ([paths] if isinstance(paths, str | Path) else list(paths))]
    if not files:
        raise ValueError("paths is empty: give at least one FITS file")
    files, numbers, skip = opened_files(files, skip)
    lengths = [keywords.wavelength(file.header, file.path, wavelength, design_wavelength) for file in files]
    scales = [keywords.pixel_scale(file.header, file.path, pixel_scale, design_pixel_scale) for file in files]
    check_alike(files, lengths, scales)
    check_given_scale(files, pixel_scale)
    options = (unit, gain, exposure_time)
    factors = [keywords.electrons_per_unit(f.header, f.path, f.is_cube, *options) for f in files]
    times = [keywords.exposure_seconds(file.header, file.path, file.is_cube, exposure_time) for file in files]
    noises = [keywords.number(file.header, ("RDNOISE", "READNOIS"), file.path) for file in files]
    counted = [keywords.counts_time(file.header, file.path, unit) for file in files]
    exposures = {file.path: time for file, time, grows in zip(files, times, counted, strict=True) if grows and time}
    images = [
        reference_image(dark, "dark", exposures),
        *map(reference_image, (flat, bad_pixels), ("flat", "bad_pixels")),
    ]

    resolution = lengths[0] / aperture.extent / scales[0]  # [pixels]
    blur = max(1.0, resolution / 2)
    full = [keywords.saturation(f.header, f.path, factor, saturation) for f, factor in zip(files, factors, strict=True)]
    piled = _piled_up(files, images[2]) if None in full else None
    stacks, headers = [], []
    for file, factor, level in zip(files, factors, full, strict=True):
        stack, header = _stack(_mark_saturated(file, level, piled), factor, images, crop, target, blur)
        stacks.append(stack)
        headers.append(header)
    frames = np.concatenate([stack[0] for stack in stacks])
    valid = np.concatenate([stack[2] for stack in stacks])
    errors = _joined([stack[1] for stack in stacks], files)
    check_rotation(files, frames.shape[-1])
    check_field_rotation(files, (frames.shape[-2], frames.shape[-1]), resolution)
    kept = usable_frames(frames, valid, skip, numbers)
    if keep is not None:
        kept = kept[best_frames(frames[kept], valid[kept], keep, keep_by)]
    if readout_noise is None and (known := _of_all(noises, files, "a read-out noise (RDNOISE or READNOIS)")):
        readout_noise = math.sqrt(np.average(np.square(known), weights=[len(stack[0]) for stack in stacks]))
    side = frames.shape[-1] if frames.shape[-1] == frames.shape[-2] else frames.shape[-2:]
    return Observation(
        frames=torch.from_numpy(frames),
        aperture=aperture,
        grid=Grid(side, scales[0], lengths[0]),
        readout_noise=readout_noise,
        valid=torch.from_numpy(valid),
        errors=None if errors is None else torch.from_numpy(errors),
        header=cards_at(keywords.common_cards(headers), scales[0]) | _mean_exposure(files, times),
        pixel=keywords.pixel_response(headers[0]),
        frame_numbers=numbers,
    ).take(kept)


def _piled_up(files: Sequence[FITSImages], bad_pixels: np.ndarray | None) -> float | None:
    """Return the value in the files, all together, at which good pixels pile up, or None if there is none."""
    values, valid = (np.concatenate(part) for part in ([f.values for f in files], [f.valid for f in files]))
    good = torch.from_numpy(valid if bad_pixels is None else valid & (bad_pixels == 0))
    piled = find_saturated(torch.from_numpy(values), good).numpy()
    return float(values[piled][0]) if piled.any() else None


def _mark_saturated(file: FITSImages, full: float | None, piled: float | None) -> FITSImages:
    """Mark pixels of the value `full`, or of `piled` if it is not known, or more as not valid, with a warning."""
    level, why = (piled, "at which they pile up") if full is None else (full, "or more")
    spoilt = np.zeros_like(file.valid) if level is None else file.valid & (file.values >= level)
    if not spoilt.any():
        return file
    warnings.warn(
        f"{file.path}: {spoilt.sum()} pixels in {spoilt.any((1, 2)).sum()} frames are saturated ({level:.10g} {why}) "
        "and ignored",
        stacklevel=3,
    )
    return replace(file, valid=file.valid & ~spoilt)


def _mean_exposure(files: Sequence[FITSImages], times: Sequence[float | None]) -> dict[str, float]:
    """Return XPOSURE, the mean exposure time of a frame [s], if that of every file is known."""
    known = [(time, len(file.values)) for time, file in zip(times, files, strict=True) if time is not None]
    if len(known) < len(files):
        return {}
    return {"XPOSURE": sum(time * count for time, count in known) / sum(count for _, count in known)}


def _stack(
    file: FITSImages, factor: float, images: Sequence[np.ndarray | None], crop: int | None, target: Any, blur: float
) -> tuple[tuple[np.ndarray, np.ndarray | None, np.ndarray], dict[str, Any]]:
    """Return the frames [electrons], errors and valid pixels of one file, and the cards to keep with them."""
    try:
        values, valid, sensitivity = calibrate(file.values, file.valid, *images)
        errors = None if file.errors is None else np.nan_to_num(file.errors / sensitivity) * factor
        header = keywords.kept_cards(file.header)
        window = (slice(None), slice(None))
        if crop is not None:
            place = find_target(values, valid, blur) if target is None else target
            row, column = crop_corner(values.shape[1:], place, crop)
            window = (slice(row, row + crop), slice(column, column + crop))
            header = keywords.shift_cards(header, column, row)
    except ValueError as error:
        raise ValueError(f"{file.path}: {error}") from None
    cut = (slice(None), *window)
    return (values[cut] * factor, None if errors is None else errors[cut], valid[cut].copy()), header


def _joined(errors: Sequence[np.ndarray | None], files: Sequence[FITSImages]) -> np.ndarray | None:
    """Return the errors of all files concatenated; None if one file lacks them."""
    known = _of_all(errors, files, "errors (ERR)")
    return np.concatenate(known) if known else None


def _of_all(values: Sequence[_T | None], files: Sequence[FITSImages], what: str) -> list[_T]:
    """Return the values of all files; none if one file lacks its own, with a warning if only some files do."""
    known = [value for value in values if value is not None]
    if len(known) == len(files):
        return known
    if known:
        lacking = [file.path.name for file, value in zip(files, values, strict=True) if value is None]
        warnings.warn(
            f"only {len(known)} of {len(files)} files have {what}, which are not used, as {', '.join(lacking[:4])}"
            f"{' and others' * (len(lacking) > 4)} have none: the noise is measured from the frames unless it is told",
            stacklevel=3,
        )
    return []
