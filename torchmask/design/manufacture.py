"""Mask files: JSON for a record, FITS for programs that model optics from images, and drawings for the workshop.

JSON and FITS hold metres in the pupil; drawings (`torchmask.design.drawing`) millimetres on the plate.
"""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torchmask.design.drawing import load_dxf, require_one_mask
from torchmask.grid import Grid
from torchmask.io import atomic_write, extra
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.records import aperture_record, read_mask

_FORMAT = "torchmask mask, version 1"
_DTYPES = {"float64": torch.float64, "float32": torch.float32}


def save_json(path: str | Path, aperture: SparseAperture, wavelength: float | None = None) -> None:
    """Write a mask as JSON, in metres and radians; `load_mask` gives back every bit of it.

    `wavelength` [m] is the one that the mask was designed or measured at; `mask_wavelength` gives it back.

    Raises
    ------
    ValueError
        If `path` exists, its folder does not, the aperture is a population of masks, or the wavelength is not finite
        and positive.
    """
    centers = require_one_mask(aperture)
    if wavelength is not None and not (math.isfinite(wavelength) and wavelength > 0):
        raise ValueError(f"wavelength is {wavelength}: it must be finite and positive, in m")
    record = {
        "format": _FORMAT,
        "units": {"length": "m", "angle": "rad"},
        **aperture_record(aperture),
        "dtype": str(centers.dtype).removeprefix("torch."),
        "centers": centers.tolist(),
    }
    if wavelength is not None:
        record["wavelength"] = wavelength
    with atomic_write(path) as file:
        file.write(json.dumps(record, indent=1, allow_nan=False).encode())


def save_fits(path: str | Path, aperture: SparseAperture, n_pixels: int = 512) -> None:
    """Write a FITS map of the transmitted amplitude, for programs that model optics from images.

    Each of `n_pixels` x `n_pixels` pixels holds the open fraction of its area. The origin of the pupil is the centre of
    pixel n_pixels // 2 (counted from 0), rows go up in y, and the linear coordinates of the header are metres. A table
    HOLES holds the exact mask for `load_mask`.

    Raises
    ------
    ValueError
        As `save_json`, and if a hole is narrower than two pixels.
    """
    with extra("data"):
        from astropy.io import fits

    centers = require_one_mask(aperture)
    amplitude, step = amplitude_map(aperture, n_pixels)
    image = fits.PrimaryHDU(amplitude.numpy(force=True))
    origin = n_pixels // 2 + 1
    for axis, name in ((1, "X"), (2, "Y")):
        image.header[f"CTYPE{axis}"] = (name, "pupil plane")
        image.header[f"CUNIT{axis}"] = "m"
        image.header[f"CRPIX{axis}"] = origin
        image.header[f"CRVAL{axis}"] = 0.0
        image.header[f"CDELT{axis}"] = step
    image.header["BUNIT"] = ("", "open fraction of the pixel")
    record = aperture_record(aperture)
    numbers = {key: [value] * len(centers) for key, value in record.items() if isinstance(value, float)}
    columns = {"X": centers[:, 0].tolist(), "Y": centers[:, 1].tolist()} | numbers
    units = dict.fromkeys(("X", "Y", "subaperture_diameter", "mask_diameter"), "m") | {"orientation": "rad"}
    table = fits.BinTableHDU.from_columns(
        [fits.Column(key.upper(), "D", unit=units.get(key), array=values) for key, values in columns.items()],
        name="HOLES",
    )
    table.header["SHAPE"] = record["shape"]
    table.header["NUMTYPE"] = (str(centers.dtype).removeprefix("torch."), "type of X and Y in memory")
    content = io.BytesIO()
    fits.HDUList([image, table]).writeto(content)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def amplitude_map(aperture: SparseAperture, n_pixels: int) -> tuple[Tensor, float]:
    """Open fraction of each pixel (n_pixels, n_pixels) of a square that holds mask and rim, and the pixel's size [m].

    Raises ValueError if a hole is narrower than two pixels.
    """
    require_one_mask(aperture)
    width, needed = max(aperture.mask_diameter, 2 * aperture.reach), least_pixels(aperture)
    if n_pixels != int(n_pixels) or n_pixels < needed:
        raise ValueError(f"n_pixels is {n_pixels}: a hole must span two pixels, so at least {needed} are needed")
    step = width / (n_pixels - 2)
    # The pupil raster of a field of twice the width: wide enough for any aperture's spatial frequencies.
    samples = aperture.samples(Grid(2 * n_pixels, 1 / (2 * n_pixels * step), 1.0))
    raster = torch.zeros(samples.raster, dtype=samples.weights.dtype, device=samples.weights.device)
    raster.view(-1).index_add_(0, samples.index.flatten(), samples.weights.detach().flatten())
    start = n_pixels - n_pixels // 2
    inner = torch.fft.fftshift(raster)[start : start + n_pixels, start : start + n_pixels]
    return inner.clamp(max=1), step  # holes that overlap are open once


def least_pixels(aperture: SparseAperture) -> int:
    """Pixels a side that `save_fits` needs, so that a hole spans two."""
    return math.ceil(2 * max(aperture.mask_diameter, 2 * aperture.reach) / aperture.subaperture_diameter) + 2


def load_mask(path: str | Path) -> SparseAperture:
    """Read a mask that `save_json`, `save_fits` or `save_dxf` wrote; the suffix of `path` says which.

    JSON and FITS come back with every bit. A drawing comes back to the rounding of its decimal numbers, far below a
    nanometre, as float64, and as it is drawn: holes moved in a CAD program come back moved.

    Raises
    ------
    ValueError
        If the file is missing, damaged, of another kind, or describes no mask this library knows.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "golay6.json"
    >>> save_json(path, SparseAperture.from_catalog("golay6", 1.0, 0.15))
    >>> load_mask(path).n_subapertures
    6
    """
    path = Path(path)
    readers: dict[str, Callable[[Path], SparseAperture]] = {
        ".json": _read_json,
        ".dxf": load_dxf,
        ".fits": _read_fits,
    }
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path} is none of the mask files that can be read: {', '.join(readers)}")
    if not path.is_file():
        raise ValueError(f"there is no mask file {path}")
    try:
        return readers[path.suffix.lower()](path)
    except (ValueError, TypeError, LookupError, OSError) as error:
        raise ValueError(f"{path} is no mask that can be read: {error}") from error


def mask_wavelength(path: str | Path) -> float | None:
    """The wavelength [m] that a mask was written with; None if its file holds none, which only JSON can.

    Raises
    ------
    ValueError
        If `load_mask` could not read the file, or what it holds is no wavelength.

    Examples
    --------
    >>> import tempfile
    >>> path = Path(tempfile.mkdtemp()) / "golay6.json"
    >>> save_json(path, SparseAperture.from_catalog("golay6", 1.0, 0.15), wavelength=550e-9)
    >>> mask_wavelength(path)
    5.5e-07
    """
    path = Path(path)
    load_mask(path)
    if path.suffix.lower() != ".json":
        return None
    value = _json_record(path).get("wavelength")
    if value is not None and not (type(value) in (int, float) and math.isfinite(value) and value > 0):
        raise ValueError(f"{path}: its wavelength is {value!r}, which is no length in m")
    return value


def _read_json(path: Path) -> SparseAperture:
    record = _json_record(path)
    needed = ("shape", "subaperture_diameter", "mask_diameter", "centers", "dtype")
    missing = [key for key in needed if key not in record]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    centers = torch.tensor(record["centers"], dtype=torch.float64).to(_dtype(record["dtype"]))
    return read_mask(record | {"centers": centers})


def _json_record(path: Path) -> dict[str, Any]:
    record = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise ValueError(f"it does not say {_FORMAT!r} under 'format'")
    return record


def _read_fits(path: Path) -> SparseAperture:
    with extra("data"):
        from astropy.io import fits
        from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # such as that of a truncated file
        try:
            with fits.open(io.BytesIO(path.read_bytes())) as content:
                table, header = content["HOLES"].data, content["HOLES"].header  # type: ignore[attr-defined]
                shape, dtype = header["SHAPE"], _dtype(header["NUMTYPE"])
                columns = {name.lower(): table[name].tolist() for name in table.names}
        except (AstropyWarning, fits.VerifyError) as problem:
            raise ValueError(str(problem)) from problem
    x, y = (torch.tensor(columns.pop(name), dtype=torch.float64) for name in ("x", "y"))
    record: dict[str, Any] = {name: values[0] for name, values in columns.items()}
    return read_mask(record | {"shape": shape, "centers": torch.stack([x, y], dim=-1).to(dtype)})


def _dtype(name: str) -> torch.dtype:
    if name not in _DTYPES:
        raise ValueError(f"its numbers are {name}: known are {', '.join(_DTYPES)}")
    return _DTYPES[name]
