"""Mask files: JSON for archives, FITS for programs that model optics from images, and drawings for the workshop.

JSON and FITS files are in metres in the pupil, drawings (`torchmask.design.drawing`) in millimetres on the plate.
"""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Callable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.design.drawing import load_dxf, require_one_mask
from torchmask.grid import Grid
from torchmask.io import atomic_write, extra
from torchmask.numbers import require_wavelength, whole_number
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.records import aperture_record, read_mask

_FORMAT = "torchmask mask, version 1"
_UNITS = {"length": "m", "angle": "rad"}
_OF_SOME_SHAPES = ("orientation", "obstruction", "central_obstruction")
_DTYPES = {"float64": torch.float64, "float32": torch.float32}


def save_json(path: str | Path, aperture: SparseAperture, wavelength: float | None = None) -> None:
    """Write a mask as JSON, in metres and radians; `load_mask` reads it back exactly.

    `wavelength` [m] is that for which the mask was designed or measured; `mask_wavelength` reads it back.

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
        "units": _UNITS,
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

    Each of `n_pixels` x `n_pixels` pixels has the open fraction of its area. The origin of the pupil is the centre of
    pixel n_pixels // 2 (counted from 0), y increases with the row, and the header's linear coordinates are in metres. A
    table HOLES contains the exact mask for `load_mask`.

    Raises
    ------
    ValueError
        As `save_json` does, and if a hole is narrower than two pixels.
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
    numbers = {key: [value] * len(centers) for key, value in record.items() if isinstance(value, float | tuple)}
    columns = {"X": centers[:, 0].tolist(), "Y": centers[:, 1].tolist()} | numbers
    units = dict.fromkeys(("X", "Y", "subaperture_diameter", "mask_diameter"), "m") | {"orientation": "rad"}
    table = fits.BinTableHDU.from_columns(
        [
            fits.Column(key.upper(), f"{np.size(values[0])}D", unit=units.get(key), array=values)
            for key, values in columns.items()
        ],
        name="HOLES",
    )
    table.header["SHAPE"] = record["shape"]
    table.header["NUMTYPE"] = (str(centers.dtype).removeprefix("torch."), "type of X and Y in memory")
    content = io.BytesIO()
    fits.HDUList([image, table]).writeto(content)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def amplitude_map(aperture: SparseAperture, n_pixels: int) -> tuple[Tensor, float]:
    """Return the open fraction (n_pixels, n_pixels) of each pixel of a square around the mask, and the pixel size [m].

    Raises ValueError if a hole is narrower than two pixels.
    """
    require_one_mask(aperture)
    width, needed = max(aperture.mask_diameter, 2 * aperture.reach), least_pixels(aperture)
    n_pixels = whole_number("n_pixels", n_pixels, needed, note=" for a hole to span two pixels")
    step = width / (n_pixels - 2)
    # The pupil raster of a field of twice the width is wide enough for the spatial frequencies of any aperture.
    samples = aperture.samples(Grid(2 * n_pixels, 1 / (2 * n_pixels * step), 1.0))
    raster = torch.zeros(samples.raster, dtype=samples.weights.dtype, device=samples.weights.device)
    raster.view(-1).index_add_(0, samples.index.flatten(), samples.weights.detach().flatten())
    start = n_pixels - n_pixels // 2
    inner = torch.fft.fftshift(raster)[start : start + n_pixels, start : start + n_pixels]
    return inner.clamp(max=1), step  # overlapping holes are counted once


def least_pixels(aperture: SparseAperture) -> int:
    """Return the number of pixels a side that `save_fits` needs for a hole to span two."""
    return math.ceil(2 * max(aperture.mask_diameter, 2 * aperture.reach) / aperture.subaperture_diameter) + 2


def load_mask(path: str | Path) -> SparseAperture:
    """Read a mask written by `save_json`, `save_fits` or `save_dxf`, depending on the suffix of `path`.

    JSON and FITS files are read exactly. A drawing is read as float64, to the rounding of its decimal numbers, far
    below a nanometre, and includes changes made in a CAD program.

    Raises
    ------
    ValueError
        If the file is missing, damaged, of another kind, or does not describe a known kind of mask.

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
        raise ValueError(f"{path} is not a mask file that can be read: its name must end in {', '.join(readers)}")
    if not path.is_file():
        raise ValueError(f"there is no mask file {path}")
    try:
        mask = readers[path.suffix.lower()](path)
        require_one_mask(mask)
        return mask
    except (ValueError, TypeError, LookupError, OSError) as error:
        raise ValueError(f"{path} cannot be read as a mask: {error}") from error


def mask_wavelength(path: str | Path) -> float | None:
    """Return the wavelength [m] in a mask file, or None if it has none; only JSON files can have one.

    Raises
    ------
    ValueError
        If `load_mask` cannot read the file, or its wavelength is not that of light in metres.

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
    if value is not None and type(value) not in (int, float):
        raise ValueError(f"{path}: its wavelength is {value!r}: it must be a number, in m")
    require_wavelength(f"{path}: its wavelength", value)
    return value


def _read_json(path: Path) -> SparseAperture:
    record = _json_record(path)
    needed = ("shape", "subaperture_diameter", "mask_diameter", "centers", "dtype")
    missing = [key for key in needed if key not in record]
    if missing:
        raise ValueError(f"it lacks {', '.join(map(repr, missing))}")
    for name, unit in (("subaperture_diameter", "m"), ("mask_diameter", "m"), ("orientation", "rad")):
        if type(value := record.get(name, 0.0)) not in (int, float):
            raise ValueError(f"its {name} is {value!r}: it must be a number, in {unit}")
    centers = torch.tensor(record["centers"], dtype=torch.float64).to(_dtype(record["dtype"]))
    mask = read_mask(record | {"centers": centers})
    known = ["format", "units", *needed, *mask.shape.parameters, "wavelength"]
    for key, value in record.items():
        meant = get_close_matches(key.lower(), [*known, *_OF_SOME_SHAPES], n=1, cutoff=0.8)
        if key not in known and meant and value:  # files of version 0.1 have zeros for what a shape lacks
            has = f"the keys of such a mask are {', '.join(known)}"
            raise ValueError(f"it has {key!r}, which is {value!r}: {has}, and others, such as 'comment'")
    return mask


def _json_record(path: Path) -> dict[str, Any]:
    record = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise ValueError(f"its 'format' is not {_FORMAT!r}")
    if record.get("units", _UNITS) != _UNITS:
        raise ValueError(f"its 'units' are {record['units']!r}: convert its numbers to {_UNITS!r}")
    return record


def _read_fits(path: Path) -> SparseAperture:
    with extra("data"):
        from astropy.io import fits
        from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # such as the warning about a truncated file
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
