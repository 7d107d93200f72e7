"""`torchmask view`: show the content of a file or a run folder as text and figures."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import tyro

from torchmask.cli.masks import describe
from torchmask.cli.options import DebugOptions
from torchmask.cli.report import restored_figure
from torchmask.data.fits import read_fits
from torchmask.design.manufacture import load_mask
from torchmask.grid import ARCSEC
from torchmask.io import atomic_write, load_npz, read_json
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.sky import pixel_matrix
from torchmask.restoration.result import RestorationResult
from torchmask.spectra import NYQUIST
from torchmask.tracking import read_metrics
from torchmask.viz import figures as viz
from torchmask.viz.comparison import comparison_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_RESULTS = ("restored.npz", "result.npz", "stack.npz", "mask.json")  # of a run, of which the first that exists is shown


@dataclass(frozen=True, kw_only=True)
class Options(DebugOptions):
    """Describe and draw the content of a file: a mask, a stack, a restored image, a run folder or its checkpoint."""

    path: tyro.conf.Positional[Path]
    """Mask (.json, .dxf, .fits), stack or result (.npz), image or cube (.fits), or run folder."""
    out: Path | None = None
    """New .png file; None: named after the input, in the current folder. NAME-uv.png shows the baselines of a mask."""


class View(NamedTuple):
    """A view of a file.

    text : description
    figures : figures, by the suffix of their file names
    """

    text: str
    figures: dict[str, Figure]


def run(options: Options) -> None:
    """Print the text and write the figures."""
    if options.out is not None and options.out.suffix.lower() != ".png":
        raise ValueError(f"{options.out} does not end in .png")
    view = view_path(options.path)
    names = _names(options.out, view) if options.out else _free_names(options.path.resolve().stem, view)
    taken = [str(path) for path in names.values() if path.exists()]
    if taken:
        raise ValueError(f"{' and '.join(taken)} exists and is not overwritten: choose another name or move it away")
    print(view.text)
    for suffix, figure in view.figures.items():
        with atomic_write(names[suffix]) as file:
            figure.savefig(file, format="png", dpi=160)
        print(f"written to {names[suffix]}")


def view_path(path: Path) -> View:
    """Return the view of a file or folder. Raises ValueError if it is missing, damaged or of an unknown kind."""
    if path.is_dir():
        return _view_run(path)
    viewers: dict[str, Callable[[Path], View]] = {
        ".json": _view_mask,
        ".dxf": _view_mask,
        ".fits": _view_fits,
        ".npz": _view_npz,
    }
    if not path.is_file():
        raise ValueError(f"there is no file or folder {path}")
    if path.suffix.lower() not in viewers:
        raise ValueError(f"{path} is of an unknown kind: files that can be viewed end in {', '.join(viewers)}")
    return viewers[path.suffix.lower()](path)


def _view_mask(path: Path) -> View:
    return _mask_view(load_mask(path))


def _mask_view(mask: SparseAperture) -> View:
    return View(describe(mask), {"": viz.mask_figure(mask), "-uv": viz.uv_coverage_figure(mask)})


def _view_fits(path: Path) -> View:
    from astropy.io import fits

    try:
        with fits.open(path) as content:
            is_mask = "HOLES" in content
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is not a FITS file, or is damaged: {error}") from error
    if is_mask:
        return _view_mask(path)
    images = read_fits(path)
    count, rows, columns = images.values.shape
    what = "image" if count == 1 else f"{count} images"
    lines = [f"{what} of {rows} x {columns} pixels, {100 * images.valid.mean():.4g} % of them valid"]
    keys = ("OBJECT", "TELESCOP", "INSTRUME", "FILTER", "WAVELEN", "PIXELSCL", "BUNIT", "CHISQ", "NOISE")
    lines += [f"{key} = {images.header[key]}" for key in keys if key in images.header]
    scale = images.header.get("PIXELSCL")
    angle = scale * ARCSEC if isinstance(scale, float) else None
    sky = pixel_matrix(images.header)
    if angle is None and sky is not None:
        angle = math.sqrt(abs(np.linalg.det(sky)))
    shown: dict[str, Any] = {"pixel_scale": angle, "unit": str(images.header.get("BUNIT", "")), "sky": sky}
    if count == 1:
        return View("\n".join(lines), {"": restored_figure(images.values[0], title="image", **shown)})
    return View("\n".join(lines), {"": viz.frames_figure(images.values, **shown)})


def _view_npz(path: Path) -> View:
    stored = load_npz(path)
    if {"object", "residuals", "coefficients"} <= stored.keys():
        result = RestorationResult.load(path)
        figure = restored_figure(result.object, residuals=result.residuals, sky=_orientation_beside(path))
        return View(result.summary(), {"": figure})
    if "frames" in stored:
        return _stack_view(Observation.load(path))
    if {"scene", "mask_object", "full_object"} <= stored.keys():
        return _codesign_view(stored)
    image = stored.get("object", stored.get("image"))
    if image is not None and image.ndim == 2:
        step = f", step {stored['step']}" if "step" in stored else ""
        return View(
            f"image of {image.shape[0]} x {image.shape[1]} pixels{step}", {"": restored_figure(image, title="image")}
        )
    text = "\n".join(f"{name}: {array.dtype} {array.shape}" for name, array in stored.items())
    return View(f"arrays without a figure\n{text}", {})


def _orientation_beside(path: Path) -> Any | None:
    """Return the matrix from pixels to the sky of the FITS file beside an .npz file, or None."""
    image = path.with_suffix(".fits")
    return pixel_matrix(read_fits(image).header) if image.is_file() else None


def _stack_view(observation: Observation) -> View:
    frames, grid, aperture = observation.frames, observation.grid, observation.aperture
    noise = observation.readout_noise
    lines = [
        f"{len(frames)} frames of {grid.shape[0]} x {grid.shape[1]} pixels of {grid.pixel_scale / ARCSEC:.4g} arcsec, "
        f"{grid.wavelength:.4g} m",
        f"{float(frames.sum((1, 2)).mean()):.4g} electrons per frame, read-out noise "
        + ("unknown" if noise is None else f"{noise:.3g} electrons rms"),
        f"{aperture.n_subapertures} {aperture.shape}s of {aperture.subaperture_diameter:.4g} m in "
        f"{aperture.mask_diameter:.4g} m",
    ]
    if observation.pixel is not None:
        lines.append(f"pixels: {observation.pixel}")
    if observation.r0 is not None:
        lines.append(f"simulated, r0 {observation.r0:.4g} m, {observation.n_photons or 0:.4g} photons per frame")
    return View(
        "\n".join(lines),
        {
            "": viz.frames_figure(
                frames, pixel_scale=grid.pixel_scale, sky=observation.sky_matrix, numbers=observation.frame_numbers
            ),
            "-mask": viz.mask_figure(aperture),
        },
    )


def _codesign_view(stored: dict[str, Any]) -> View:
    names = ("mask", "full")
    pictures = {name: (stored[f"{name}_frames"][0], stored[f"{name}_object"]) for name in names}
    text = f"relative MSE of the mask {stored['relative_mse']:.5g}"
    return View(text, {"": comparison_figure(stored["scene"], pictures, NYQUIST)})


def _view_run(folder: Path) -> View:
    """Describe a run by its log and its tables, and show its result or else its last checkpoint."""
    tables = [path for path in sorted(folder.glob("*.md")) if path.with_suffix(".json").is_file()]
    texts = [f"{path}:\n{path.read_text(encoding='utf-8').strip()}" for path in tables]
    if tables and not (folder / "metrics.jsonl").is_file():  # of `torchmask table`, which has no log
        return View("\n\n".join(texts), {})
    log, there = _log(folder), _results(folder)
    if not there:
        return View("\n\n".join([log, *texts]) if texts else f"{log}\nit has no results yet", {})
    result = view_path(there[0])
    return View("\n\n".join([log, *texts, f"{there[0]}:\n{result.text}"]), result.figures)


def _log(folder: Path) -> str:
    """Return how a run ended, the last values of each stage, and the stacks that it restored, if several."""
    rows = read_metrics(folder)  # raises ValueError if this is not a run folder
    status = read_json(folder / "status.json")
    last: dict[str, dict[str, Any]] = {}
    for row in rows:
        before = last.get(row["stage"], row)
        same = before["scalars"] if before["step"] == row["step"] else {}  # final values are logged one by one
        last[row["stage"]] = row | {"scalars": same | row["scalars"]}
    lines = [f"{folder}: {status['status']} after {status['seconds']:.0f} s"]
    if status.get("error"):
        lines.append(status["error"])
    for stage, row in last.items():
        budget = f"/{row['n_steps']}" if "n_steps" in row else ""
        values = ", ".join(f"{name} {value:.5g}" for name, value in row["scalars"].items() if value is not None)
        lines.append(f"  {stage} {row['step']}{budget}: {values}")
    if len(stacks := _restored(folder)) > 1:
        lines.append(f"{len(stacks)} stacks: {', '.join(str(path) for path in stacks)}")
    return "\n".join(lines)


def _restored(folder: Path) -> list[Path]:
    """Return the results of a run that restored several stacks."""
    return sorted(folder.glob("*/restored.npz"))


def _results(folder: Path) -> list[Path]:
    """Return the files of a run that can be shown: its results, then its checkpoints from the last one."""
    results = [folder / name for name in _RESULTS if (folder / name).is_file()]
    checkpoints = (folder / "checkpoints").glob("*.npz")
    last_first = sorted(checkpoints, key=lambda path: path.stat().st_mtime, reverse=True)
    return [*results, *_restored(folder), *last_first]


def _names(path: Path, view: View) -> dict[str, Path]:
    return {suffix: path.with_name(f"{path.stem}{suffix}.png") for suffix in view.figures}


def _free_names(stem: str, view: View) -> dict[str, Path]:
    """Return names in the current folder from `stem`, or the first of stem-2, stem-3, ... for which all are free."""
    for number in itertools.count(1):
        names = _names(Path(f"{stem}.png" if number == 1 else f"{stem}-{number}.png"), view)
        if not any(path.exists() for path in names.values()):
            return names
    raise AssertionError  # count never ends
