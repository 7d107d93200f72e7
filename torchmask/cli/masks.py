"""`torchmask masks`: the catalogue."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro

from torchmask.cli.options import CatalogOptions, DebugOptions, is_mask_file, load_mask_file, require_apart
from torchmask.design.drawing import LIFE_SIZE, save_dxf, save_svg
from torchmask.design.manufacture import mask_wavelength, save_fits, save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.io import atomic_write
from torchmask.numbers import require_diameter
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.overlaps import describe_overlaps, find_overlaps
from torchmask.viz import figures as viz

_ANY_SIZE = (1.0, 0.1)  # mask diameter [m] and fill factor at which a mask without a size of its own is shown


@dataclass(frozen=True, kw_only=True)
class Options(CatalogOptions, DebugOptions):
    """List the catalogue of masks, or show one mask from the catalogue or a file, and write it to a file.

    A mask of the catalogue that has no size of its own is shown in a disc of 1 m; if no source gives the size of the
    holes, the fill factor is 0.1.
    """

    name: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|FILE")] = None
    """Mask to show, by its name in the catalogue or its file (.json, .dxf, .fits); None: list the catalogue."""
    out: Path | None = None
    """New file for the mask (.json, .dxf, .svg, .fits) or for its picture (.png)."""
    scale: float | None = None
    """Scale of a drawing (.dxf, .svg): millimetres on the plate for each metre of the pupil; None: 1000, full size."""


def run(options: Options) -> None:
    """Print the list, or one mask."""
    if options.name is not None:
        show(options.name, options)
        return
    for name in ("out", "scale", "mask_diameter", "fill_factor", "mirrored"):
        if (value := getattr(options, name)) is not None and value is not False:
            raise ValueError(f"--{name.replace('_', '-')} is for one mask: give its name or file")
    print(listing())


def listing() -> str:
    """Return a line for each mask of the catalogue."""
    rows = [("name", "holes", "shape", "hole [m]", "pupil [m]", "note")]
    for name in catalog.names():
        mask = catalog.entry(name)
        hole, pupil = ("-" if size is None else f"{size:.4g}" for size in (mask.hole_diameter, mask.pupil_diameter))
        note = textwrap.shorten(mask.note, 60, placeholder=" ...")
        rows.append((name, f"{mask.n_subapertures}", mask.shape.name, hole, pupil, note))
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    align = ("<", ">", "<", ">", ">")
    lines = [
        "  ".join(f"{cell:{side}{width}}" for cell, side, width in zip(row, align, widths, strict=False))
        + f"  {row[-1]}"
        for row in rows
    ]
    return "\n".join([*lines, "", "`torchmask masks NAME` shows one; -: no size of its own, or none published"])


def show(name: str, options: Options) -> None:
    """Print the properties of a mask, and write it to a file if --out is given."""
    if options.scale is not None and options.out is None:
        raise ValueError("--scale is for a drawing: give --out with a file that ends in .dxf or .svg")
    if is_mask_file(Path(name)):
        entry, aperture, wavelength = None, load_mask_file(name, options), mask_wavelength(name)
    else:
        entry, wavelength = catalog.entry(name), None
        aperture = _from_catalog(entry, options)
    if options.out is not None:
        write(options.out, require_apart(name, aperture, options.allow_overlap), options.scale, wavelength)
    print(describe(aperture, entry))
    if wavelength is not None:
        print(f"for light of {wavelength:.4g} m")
    if options.out is not None:
        print(f"written to {options.out}")


def _from_catalog(mask: catalog.CatalogEntry, options: Options) -> SparseAperture:
    """Return the mask as built or as the options say, with default sizes where the catalogue has none."""
    require_diameter("--mask-diameter", options.mask_diameter)
    diameter, fill = options.mask_diameter, options.fill_factor
    if mask.pupil_diameter is None and diameter is None:
        diameter = _ANY_SIZE[0]
    if (mask.pupil_diameter is None or mask.hole_diameter is None) and fill is None:
        fill = _ANY_SIZE[1]
    return SparseAperture.from_catalog(mask.name, diameter, fill, options.mirrored)


def describe(aperture: SparseAperture, mask: catalog.CatalogEntry | None = None) -> str:
    """Describe the size, holes and baselines of a mask, with its entry in the catalogue."""
    lines = [
        f"{'mask' if mask is None else mask.name}: {aperture.n_subapertures} {aperture.shape.plural} of "
        f"{aperture.subaperture_diameter:.4g} m in {aperture.mask_diameter:.4g} m, fill factor "
        f"{aperture.fill_factor:.4g}",
    ]
    if mask is not None:
        sources = {"source": mask.source, "holes from": mask.hole_source, "note": mask.note}
        lines += [textwrap.fill(f"{key}: {text}", 100, subsequent_indent="  ") for key, text in sources.items() if text]
    if overlaps := find_overlaps(aperture):
        lines += ["", describe_overlaps(aperture, overlaps)]
    if aperture.n_subapertures > 1:
        lines += ["", str(analyse_redundancy(aperture))]
    lines += ["", "centres (x, y) [m]", *(f"{x:11.6f} {y:11.6f}" for x, y in aperture.centers.tolist())]
    return "\n".join(lines)


def write(path: Path, aperture: SparseAperture, scale: float | None = None, wavelength: float | None = None) -> None:
    """Write a mask, or its picture, to a new file whose suffix sets the format.

    `scale` applies to drawings; a .json file contains the wavelength [m]. Whether holes overlap is not looked at.
    """
    drawings = {".dxf": save_dxf, ".svg": save_svg}
    others = {".json": partial(save_json, wavelength=wavelength), ".fits": save_fits, ".png": _save_png}
    kind = path.suffix.lower()
    if kind in drawings:
        drawings[kind](path, aperture, LIFE_SIZE if scale is None else scale, allow_overlap=True)
    elif kind not in others:
        raise ValueError(f"{path} does not end in one of {', '.join([*drawings, *others])}")
    elif scale is not None:
        raise ValueError(f"--scale is for drawings (.dxf, .svg), but {path} is in metres in the pupil: leave it out")
    else:
        others[kind](path, aperture)


def _save_png(path: Path, aperture: SparseAperture) -> None:
    with atomic_write(path) as file:
        viz.mask_figure(aperture).savefig(file, format="png", dpi=160)
