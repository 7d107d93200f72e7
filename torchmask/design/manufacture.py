"""From a mask to the workshop and back: JSON, DXF and SVG drawings, FITS amplitude maps.

JSON and FITS hold metres in the pupil. Drawings are in millimetres on the plate, `scale` millimetres for each metre of
the pupil: 1000 is life-size, and a mask for a re-imaged pupil of 10 mm on an 8 m telescope has scale 10 / 8. They
show the mask as the pupil coordinates do, x to the right and y up.
"""

from __future__ import annotations

import io
import json
import math
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.io import atomic_write
from torchmask.optics.aperture import SparseAperture

_FORMAT = "torchmask mask, version 1"
_DTYPES = {"float64": torch.float64, "float32": torch.float32}


def save_json(path: str | Path, aperture: SparseAperture) -> None:
    """Write a mask as JSON, in metres and radians; `load_mask` gives back every bit of it.

    Raises
    ------
    ValueError
        If `path` exists, its folder does not, or the aperture is a population of masks.
    """
    centers = _one_mask(aperture)
    record = {
        "format": _FORMAT,
        "units": {"length": "m", "angle": "rad"},
        "shape": aperture.shape,
        "orientation": aperture.orientation,
        "subaperture_diameter": aperture.subaperture_diameter,
        "mask_diameter": aperture.mask_diameter,
        "dtype": str(centers.dtype).removeprefix("torch."),
        "centers": centers.tolist(),
    }
    with atomic_write(path) as file:
        file.write(json.dumps(record, indent=1, allow_nan=False).encode())


def save_dxf(path: str | Path, aperture: SparseAperture, scale: float = 1000.0) -> None:
    """Write a DXF drawing: holes as circles or closed polylines on layer HOLES, the mask's rim on layer OUTLINE.

    Parameters
    ----------
    path : str or Path
    aperture : SparseAperture
    scale : float
        Millimetres on the plate for one metre of the pupil; the drawing remembers it for `load_mask`.

    Raises
    ------
    ValueError
        As `save_json`, and if `scale` is not finite and positive.
    """
    import ezdxf
    import ezdxf.units

    centers = _one_mask(aperture).double() * _checked(scale)
    drawing = ezdxf.new("R2010", units=ezdxf.units.MM)  # pyright: ignore[reportPrivateImportUsage]
    drawing.header.custom_vars.append("torchmask mm per m", repr(float(scale)))
    for layer in ("HOLES", "OUTLINE"):
        drawing.layers.add(layer)
    plate = drawing.modelspace()
    plate.add_circle((0, 0), aperture.mask_diameter * scale / 2, dxfattribs={"layer": "OUTLINE"})
    for x, y in centers.tolist():
        if aperture.shape == "disc":
            plate.add_circle((x, y), aperture.subaperture_diameter * scale / 2, dxfattribs={"layer": "HOLES"})
        else:
            corners = [(x + dx, y + dy) for dx, dy in _hexagon_corners(aperture, scale)]
            plate.add_lwpolyline(corners, close=True, dxfattribs={"layer": "HOLES"})
    text = io.StringIO()
    drawing.write(text)
    with atomic_write(path) as file:
        file.write(text.getvalue().encode(drawing.output_encoding))


def save_svg(path: str | Path, aperture: SparseAperture, scale: float = 1000.0) -> None:
    """Write an SVG drawing in true size: user units are millimetres, the rim and the holes are hairlines.

    SVG's y axis points down, so y is written with its sign reversed and the picture shows y up. Same arguments and
    errors as `save_dxf`.
    """
    centers = _one_mask(aperture).double() * _checked(scale)
    width = 1.02 * scale * max(aperture.mask_diameter, _span(aperture))
    svg = ElementTree.Element(
        "svg",
        xmlns="http://www.w3.org/2000/svg",
        width=f"{width}mm",
        height=f"{width}mm",
        viewBox=f"{-width / 2} {-width / 2} {width} {width}",
    )
    ElementTree.SubElement(svg, "title").text = f"Aperture mask of {aperture.n_subapertures} holes"
    ElementTree.SubElement(svg, "desc").text = f"Millimetres on the plate, {scale!r} for each metre of the pupil."
    style = {"fill": "none", "stroke": "black", "stroke-width": f"{width / 2000}"}
    radius = f"{aperture.mask_diameter * scale / 2}"
    ElementTree.SubElement(svg, "circle", {"id": "outline", "cx": "0", "cy": "0", "r": radius, **style})
    holes = ElementTree.SubElement(svg, "g", {"id": "holes", **style})
    for x, y in centers.tolist():
        if aperture.shape == "disc":
            hole = {"cx": f"{x}", "cy": f"{-y}", "r": f"{aperture.subaperture_diameter * scale / 2}"}
            ElementTree.SubElement(holes, "circle", hole)
        else:
            corners = " ".join(f"{x + dx},{-(y + dy)}" for dx, dy in _hexagon_corners(aperture, scale))
            ElementTree.SubElement(holes, "polygon", points=corners)
    with atomic_write(path) as file:
        ElementTree.ElementTree(svg).write(file, encoding="utf-8", xml_declaration=True)


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
    from astropy.io import fits

    centers = _one_mask(aperture)
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
    columns = {"X": centers[:, 0].tolist(), "Y": centers[:, 1].tolist()}
    for key in ("subaperture_diameter", "mask_diameter", "orientation"):
        columns[key.upper()] = [getattr(aperture, key)] * aperture.n_subapertures
    units = {"ORIENTATION": "rad"}
    table = fits.BinTableHDU.from_columns(
        [fits.Column(key, "D", unit=units.get(key, "m"), array=values) for key, values in columns.items()], name="HOLES"
    )
    table.header["SHAPE"] = aperture.shape
    table.header["NUMTYPE"] = (str(centers.dtype).removeprefix("torch."), "type of X and Y in memory")
    content = io.BytesIO()
    fits.HDUList([image, table]).writeto(content)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def amplitude_map(aperture: SparseAperture, n_pixels: int) -> tuple[Tensor, float]:
    """Open fraction of each pixel (n_pixels, n_pixels) of a square that holds mask and rim, and the pixel's size [m].

    Raises ValueError if a hole is narrower than two pixels.
    """
    _one_mask(aperture)
    width = max(aperture.mask_diameter, _span(aperture))
    needed = math.ceil(2 * width / aperture.subaperture_diameter) + 2
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


def load_mask(path: str | Path) -> SparseAperture:
    """Read a mask that `save_json`, `save_dxf` or `save_fits` wrote; the suffix of `path` says which.

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
    readers: dict[str, Callable[[Path], dict[str, Any]]] = {
        ".json": _read_json,
        ".dxf": _read_dxf,
        ".fits": _read_fits,
    }
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path} is none of the mask files that can be read: {', '.join(readers)}")
    if not path.is_file():
        raise ValueError(f"there is no mask file {path}")
    try:
        arguments = readers[path.suffix.lower()](path)
        return SparseAperture(**arguments)
    except (ValueError, TypeError, LookupError, OSError) as error:
        raise ValueError(f"{path} is no mask that can be read: {error}") from error


def _read_json(path: Path) -> dict[str, Any]:
    record = json.loads(path.read_text(encoding="utf-8"))
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        raise ValueError(f"it does not say {_FORMAT!r} under 'format'")
    keys = ("subaperture_diameter", "mask_diameter", "shape", "orientation", "centers", "dtype")
    missing = [key for key in keys if key not in record]
    if missing:
        raise ValueError(f"it lacks {', '.join(missing)}")
    arguments = {key: record[key] for key in keys}
    dtype = _dtype(arguments.pop("dtype"))
    arguments["centers"] = torch.tensor(arguments["centers"], dtype=torch.float64).to(dtype)
    return arguments


def _read_dxf(path: Path) -> dict[str, Any]:
    import ezdxf

    try:
        drawing = ezdxf.readfile(path)  # pyright: ignore[reportPrivateImportUsage]
    except (ezdxf.DXFError, StopIteration) as error:  # pyright: ignore[reportPrivateImportUsage]
        raise ValueError(str(error) or "the drawing ends too early") from error
    noted = drawing.header.custom_vars.get("torchmask mm per m")
    if noted is None:
        raise ValueError("the drawing does not say how many millimetres stand for a metre of the pupil")
    scale = _checked(float(noted))
    plate = drawing.modelspace()
    rims = list(plate.query('CIRCLE[layer=="OUTLINE"]'))
    if len(rims) != 1:
        raise ValueError(f"layer OUTLINE holds {len(rims)} circles: one is needed, the rim of the mask")
    discs = [(e.dxf.center.x, e.dxf.center.y, 2 * e.dxf.radius, 0.0) for e in plate.query('CIRCLE[layer=="HOLES"]')]
    hexagons = [_measure_hexagon(list(e.vertices())) for e in plate.query('LWPOLYLINE[layer=="HOLES"]')]  # type: ignore[attr-defined]
    if bool(discs) == bool(hexagons):
        raise ValueError(f"layer HOLES holds {len(discs)} circles and {len(hexagons)} polylines: one kind is needed")
    holes = torch.tensor(discs or hexagons, dtype=torch.float64)
    if (holes[:, 2:] - holes[0, 2:]).abs().max() > 1e-6:
        raise ValueError("its holes differ by more than 1 nm or 1e-6 rad: only masks of equal holes are known")
    return {
        "centers": holes[:, :2] / scale,
        "subaperture_diameter": float(holes[0, 2]) / scale,
        "mask_diameter": 2 * rims[0].dxf.radius / scale,
        "shape": "disc" if discs else "hexagon",
        "orientation": float(holes[0, 3]),
    }


def _read_fits(path: Path) -> dict[str, Any]:
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        warnings.simplefilter("error", AstropyWarning)  # such as that of a truncated file
        try:
            with fits.open(io.BytesIO(path.read_bytes())) as content:
                table, header = content["HOLES"].data, content["HOLES"].header  # type: ignore[attr-defined]
                shape, dtype = header["SHAPE"], _dtype(header["NUMTYPE"])
                columns = {key: torch.tensor(table[key].tolist(), dtype=torch.float64) for key in table.names}
        except (AstropyWarning, fits.VerifyError) as problem:
            raise ValueError(str(problem)) from problem
    arguments: dict[str, Any] = {
        key: float(columns[key.upper()][0]) for key in ("subaperture_diameter", "mask_diameter", "orientation")
    }
    centers = torch.stack([columns["X"], columns["Y"]], dim=-1).to(dtype)
    return {"centers": centers, "shape": shape, **arguments}


def _dtype(name: str) -> torch.dtype:
    if name not in _DTYPES:
        raise ValueError(f"its numbers are {name}: known are {', '.join(_DTYPES)}")
    return _DTYPES[name]


def _one_mask(aperture: SparseAperture) -> Tensor:
    if not isinstance(aperture, SparseAperture):
        raise TypeError(f"a SparseAperture is needed, not {type(aperture).__name__}")
    if aperture.centers.ndim != 2:
        raise ValueError(
            f"centers has shape {tuple(aperture.centers.shape)}: a file holds one mask, (n_subapertures, 2)"
        )
    return aperture.centers.detach().cpu()


def _checked(scale: float) -> float:
    if not (math.isfinite(scale) and scale > 0):
        raise ValueError(
            f"scale is {scale}: it must be finite and positive, in mm on the plate for a metre of the pupil"
        )
    return scale


def _span(aperture: SparseAperture) -> float:
    """Diameter of the circle about the origin that holds every hole [m]."""
    outer = aperture.subaperture_diameter * (1 if aperture.shape == "disc" else 2 / math.sqrt(3))
    return 2 * float(torch.linalg.vector_norm(aperture.centers.detach(), dim=-1).max()) + outer


def _hexagon_corners(aperture: SparseAperture, scale: float) -> list[tuple[float, float]]:
    """Corners about the centre [mm], counter-clockwise; the normal of the first side points along the orientation."""
    radius = scale * aperture.subaperture_diameter / math.sqrt(3)
    angles = [aperture.orientation + (k - 0.5) * math.pi / 3 for k in range(6)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def _measure_hexagon(corners: list[Any]) -> tuple[float, float, float, float]:
    """(x, y, width flat to flat, orientation) of a drawn hexagon."""
    if len(corners) != 6:
        raise ValueError(f"a polyline on layer HOLES has {len(corners)} corners: hexagons have 6")
    points = torch.tensor([(corner[0], corner[1]) for corner in corners], dtype=torch.float64)
    center = points.mean(0)
    radii = (points - center).norm(dim=-1)
    if radii.max() - radii.min() > 1e-6:
        raise ValueError("a polyline on layer HOLES is no regular hexagon, its corners differ by more than 1 nm")
    normal = (points[0] + points[1]) / 2 - center
    return float(center[0]), float(center[1]), 2 * float(normal.norm()), math.atan2(float(normal[1]), float(normal[0]))
