"""FITS files: one file in, as arrays and a header; one restored image out."""

from __future__ import annotations

import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchmask.io import extra


@dataclass(frozen=True, eq=False)
class FITSImages:
    """The images of one file, in its own units.

    path : where they come from
    values : (T, H, W) float64
    errors : (T, H, W) or None, from an ERR extension
    valid : (T, H, W) bool: finite, not marked as bad in an extension, and below what the file's integers can hold
    header : the cards that hold a value: the image's, and where it has none, those of the primary header
    is_cube : whether the file itself has a time axis
    """

    path: Path
    values: np.ndarray
    errors: np.ndarray | None
    valid: np.ndarray
    header: dict[str, bool | int | float | str]
    is_cube: bool


def read_fits(path: str | Path) -> FITSImages:
    """Read an image (H, W) or a cube (T, H, W): the SCI extension, or else the first image in the file.

    A pixel is not valid where a value or error is not finite, or where an extension BADPIX, BPM or DQ is not 0: of DQ
    for JWST the lowest bit, DO_NOT_USE (the others tell what was done to a pixel that is good), for others any bit.
    Nor is it where integers of 8 or 16 bits are at their largest value, at which a converter stops.

    Raises
    ------
    ValueError
        If the file is missing, is no FITS, is truncated or fails its checksum, holds no image of 2 or 3 axes or
        several that could be meant, or its extensions disagree in shape.
    """
    with extra("data"):
        from astropy.io import fits
        from astropy.io.fits.verify import VerifyError, VerifyWarning
        from astropy.utils.exceptions import AstropyUserWarning

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path} (needed: a FITS file)")
    try:
        with warnings.catch_warnings(record=True) as caught, open(path, "rb") as file:
            warnings.simplefilter("always")
            with fits.open(file, checksum=True) as hdus:
                images = _images(path, hdus)
    except _Refused as error:
        raise ValueError(f"{path} {error}") from None
    except (OSError, TypeError, ValueError, LookupError, EOFError, MemoryError, zlib.error, VerifyError) as error:
        raise _damaged(path, error) from error
    for warning in caught:  # all that astropy says of a truncated file or a wrong checksum
        if issubclass(warning.category, AstropyUserWarning) and not issubclass(warning.category, VerifyWarning):
            raise _damaged(path, warning.message)
    return images


def _damaged(path: Path, why: Any) -> ValueError:
    return ValueError(f"{path} is no FITS file, or is damaged: {' '.join(str(why).split())}")


class _Refused(Exception):
    """A sound FITS file that does not hold what is needed."""


def _images(path: Path, hdus: Any) -> FITSImages:
    science = [hdu for hdu in hdus if hdu.is_image and hdu.name == "SCI"]
    images = science or [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) > 0]
    if not images:
        raise _Refused("holds no image")
    if len(science) > 1:
        raise _Refused(f"holds {len(science)} SCI extensions: write the one to use to a file of its own")
    values = images[0].data
    if values is None or values.ndim not in (2, 3) or 0 in values.shape:
        shape = None if values is None else values.shape
        raise _Refused(f"holds an array of shape {shape}: it must be an image (H, W) or a cube (T, H, W)")
    header = _cards(hdus[0].header) | _cards(images[0].header)
    errors, quality = (_extension(hdus, name, values.shape) for name in ("ERR", "DQ"))
    valid = np.isfinite(values)
    if values.dtype.kind in "iu" and values.dtype.itemsize <= 2:
        valid &= values < np.iinfo(values.dtype.newbyteorder("=")).max
    for marked in (_extension(hdus, name, values.shape) for name in ("BADPIX", "BPM")):
        if marked is not None:
            valid &= marked == 0
    if errors is not None:
        valid &= np.isfinite(errors)
    if quality is not None:
        jwst = str(header.get("TELESCOP", "")).strip().upper() == "JWST"
        valid &= (quality & 1 if jwst else quality) == 0
    cube = (-1, *values.shape[-2:])
    return FITSImages(
        path,
        values.astype(np.float64).reshape(cube),
        None if errors is None else errors.astype(np.float64).reshape(cube),
        valid.reshape(cube),
        header,
        values.ndim == 3,
    )


def _cards(header: Any) -> dict[str, bool | int | float | str]:
    """The cards with a value; those that cannot be read are passed over, they may not be needed."""
    with extra("data"):
        from astropy.io.fits.verify import VerifyError

    cards = {}
    for card in header.cards:
        try:
            name, value = card.keyword, card.value
        except (VerifyError, ValueError):
            continue
        if isinstance(value, bool | int | float | str) and value != "" and name not in ("COMMENT", "HISTORY", ""):
            cards[name] = value
    return cards


def _extension(hdus: Any, name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """The data of a companion extension, one image for all frames if it is flat; None if there is none."""
    if name not in hdus:
        return None
    data = hdus[name].data if hdus[name].is_image else None
    if data is None:
        raise _Refused(f"has {name} that is no image")
    if data.shape not in (shape, shape[-2:]):
        raise _Refused(f"has {name} of shape {data.shape}, and images of shape {shape}: they must agree")
    return np.broadcast_to(data, shape)
