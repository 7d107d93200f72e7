"""Reading of the images by which exposures are calibrated: darks, flats and maps of bad pixels."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from torchmask.data import keywords
from torchmask.data.fits import FITSImages, read_fits

_SAME = 0.01  # relative difference of exposure times that changes nothing


def reference_image(source: Any, name: str, exposures: Mapping[Path, float] | None = None) -> np.ndarray | None:
    """Return a calibration image (H, W) from an array, a tensor or a FITS file; the median of a cube.

    `exposures` are the exposure times [s] of the files with the frames, with which that of a dark is compared.

    Raises ValueError if the image has another number of axes, or as `read_fits` does.

    Warns
    -----
    UserWarning
        If the header tells an exposure time that differs from that of the frames.
    """
    if source is None:
        return None
    if isinstance(source, str | Path):
        file = read_fits(source)
        _compare(file, name, exposures or {})
        values = np.where(file.valid, file.values, np.nan) if name != "bad_pixels" else file.values
    else:
        values = np.asarray(source, dtype=float)
        values = values[None] if values.ndim == 2 else values
    if values.ndim != 3:
        raise ValueError(f"{name} has shape {values.shape}: it must be (H, W) or (T, H, W)")
    return values[0] if len(values) == 1 else np.median(values, axis=0)


def _compare(file: FITSImages, name: str, exposures: Mapping[Path, float]) -> None:
    own = keywords.exposure_seconds(file.header, file.path, file.is_cube, None)
    other = [path for path, time in exposures.items() if own is not None and abs(own - time) > _SAME * time]
    if other:
        warnings.warn(
            f"the {name} {file.path} was exposed for {own:.4g} s and the frames of {other[0]} for "
            f"{exposures[other[0]]:.4g} s: dark current grows with time, so take a {name} of the same exposure",
            stacklevel=4,
        )
