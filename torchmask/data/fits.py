"""Reading of a FITS file as arrays and a header."""

from __future__ import annotations

import re
import warnings
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from torchmask.io import extra

# parts of names of images that go with another one, as pipelines call them
_COMPANION = re.compile(
    "AREA|BACK|BAD|BIAS|BKG|BPM|CTX|DARK|DQ|ERR|FLAG|FLAT|GAIN|MASK|MODEL|NOISE|PSF|QUAL|RESID|RMS|SAMP|SIG|SKY|STAT|STD|"
    "TIME|UNC|VAR|WAVE|WEIGHT|WHT"
)


@dataclass(frozen=True, eq=False)
class FITSImages:
    """The images of one file, in its own units.

    path : path of the file
    values : (T, H, W) float64
    errors : (T, H, W) standard deviations from an ERR extension, or None
    valid : (T, H, W) bool, True for values that are finite, not marked as bad in an extension, and below the largest
        value of the file's integers
    header : cards that hold a value, those of the image before those of the primary header
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

    A pixel is not valid if its value or error is not finite, or if it is not 0 in an extension BADPIX, BPM or DQ. In DQ
    of JWST only the lowest bit, DO_NOT_USE, counts, because the others describe corrections of good pixels. In images
    of 8- or 16-bit integers, pixels at the largest value are saturated and not valid.

    Raises
    ------
    ValueError
        If the file is missing, not FITS, truncated or fails its checksum, has no image of 2 or 3 axes, or several
        between which neither a name nor a shape decides (names that differ in their last digits number frames), or if
        the shapes of its extensions disagree.

    Warns
    -----
    UserWarning
        If other images of the same shape are left out, without a name that says that they go with the first.
    """
    with extra("data"):
        from astropy.io import fits
        from astropy.io.fits.verify import VerifyError, VerifyWarning
        from astropy.utils.exceptions import AstropyUserWarning

    path = Path(path)
    if path.is_dir():
        raise ValueError(f"{path} is a folder: give the FITS files in it, such as {path / '*.fits'}")
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
    for warning in caught:  # for a truncated file or a wrong checksum astropy only warns
        if issubclass(warning.category, AstropyUserWarning) and not issubclass(warning.category, VerifyWarning):
            raise _damaged(path, warning.message)
        if warning.category is _LeftOut:
            warnings.warn(f"{path} {warning.message}", stacklevel=3)
    return images


def _damaged(path: Path, why: Any) -> ValueError:
    told = " ".join(str(why).split()).partition(" If this is really a FITS file")[0]  # an option of astropy follows
    return ValueError(f"{path} is not a FITS file, or is damaged: {told}")


class _Refused(Exception):
    """The FITS file is intact but does not contain what is needed."""


class _LeftOut(UserWarning):
    """The FITS file has more images than the one that is read."""


def _images(path: Path, hdus: Any) -> FITSImages:
    science = [hdu for hdu in hdus if hdu.is_image and hdu.name == "SCI"]
    images = science or [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) > 0]
    if not images:
        raise _Refused("holds no image")
    if len(science) > 1:
        raise _Refused(f"holds {len(science)} SCI extensions: write the one to use to a file of its own")
    alike = [hdu for hdu in images if _nature(hdu) == _nature(images[0])]
    if len(alike) > 1:
        raise _Refused(
            f"holds {len(alike)} images of one shape without names that differ{_but_in_digits(alike)}: if they are "
            "frames, write them as one cube (T, H, W), or else write the one to use to a file of its own"
        )
    others = [hdu.name for hdu in images[1:] if hdu.shape == images[0].shape and not _COMPANION.search(hdu.name)]
    if others:
        warnings.warn(
            f"holds {len(others)} more images of the same shape ({', '.join(others[:4])}{', ...' * (len(others) > 4)}) "
            "that are left out: if they are frames, write them as one cube (T, H, W)",
            _LeftOut,
            stacklevel=2,
        )
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


def _nature(hdu: Any) -> tuple[str, tuple[int, ...]]:
    """Return what tells an image from its companions: its name, which a primary image lacks, without a number at its
    end, and its shape."""
    return "" if hdu.name == "PRIMARY" else hdu.name.rstrip("0123456789").rstrip("_- "), hdu.shape


def _but_in_digits(alike: Sequence[Any]) -> str:
    """Return a part of a message that says how the names of images differ, if they do."""
    first, last = alike[0].name, alike[-1].name
    return "" if first == last or first == "PRIMARY" else f" but in their digits ({first} to {last})"


def _cards(header: Any) -> dict[str, bool | int | float | str]:
    """Return the cards with a value; unreadable ones are skipped, as they may not be needed."""
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
    """Return the data of a companion extension, repeated for all frames if it is one image; None if it is missing."""
    if name not in hdus:
        return None
    data = hdus[name].data if hdus[name].is_image else None
    if data is None:
        raise _Refused(f"has an extension {name} that is not an image")
    if data.shape not in (shape, shape[-2:]):
        raise _Refused(f"has an extension {name} of shape {data.shape} and images of shape {shape}: they must agree")
    return np.broadcast_to(data, shape)
