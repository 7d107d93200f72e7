"""`torchmask table`: a searched mask for each combination of hole number, hole size, light and turbulence."""

from __future__ import annotations

import dataclasses
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from torchmask.cli.criterion_options import ExposureOptions, exposure_options
from torchmask.cli.instrument_used import INSTRUMENT
from torchmask.cli.options import DebugOptions, WorkerOptions
from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table
from torchmask.instrument.instrument import Instrument
from torchmask.progress import Progress


@dataclass(frozen=True, kw_only=True)
class Options(ExposureOptions, DesignSpace, WorkerOptions, DebugOptions):
    """Compare numbers of holes, hole sizes, numbers of photons and frames, and turbulence, in one table.

    Each combination is a row, with a mask of its own, searched as by `torchmask design`, and its error. Writes one file
    for each search, table.md, table.csv, table.json with the positions of the holes, and what --instrument says to the
    folder. The same command again goes on where it was stopped, and a longer list only computes what is new.
    """

    folder: tyro.conf.Positional[Path]
    """Folder for the table and its parts, such as runs/table."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets, with the light of the reference fill factor."""
        return cls(
            folder=Path("runs/table"),
            mask_diameter=known.telescope.diameter,
            central_obstruction=known.telescope.central_obstruction,
            spiders=known.telescope.spiders,
            wavelength=known.mean_wavelength,
            n_pixels=known.camera.n_pixels,
            pixel_scale=known.pixel_scale,
            n_photons=(known.photons(math.pi / 4 * cls.reference_fill_factor * known.telescope.diameter**2),),
            n_frames=(known.frames,),
            diameter_over_r0=(known.telescope.diameter / known.site.r0,),
            outer_scale=known.site.outer_scale,
            readout_noise=known.camera.readout_noise,
            exponent=known.source.exponent,
            knee=known.knee,
            **exposure_options(known),
        )


def run(options: Options) -> None:
    """Fill the table, or go on with it."""
    wavelength = options.needed_wavelength(options.wavelength, {"--pixel-scale": options.pixel_scale is not None})
    if wavelength is not None:
        options.require_its_wavelength(wavelength)
    values: dict[str, Any] = {item.name: getattr(options, item.name) for item in dataclasses.fields(DesignSpace)}
    values["wavelength"] = wavelength
    space = DesignSpace(**values)
    area = math.pi / 4 * space.reference_fill_factor * space.mask_diameter**2
    conditions = options.conditions(space.grid.wavelength, area)
    try:
        with Progress() as progress:
            table = design_table(space, options.folder, conditions=conditions, **options.keywords(progress))
    except KeyboardInterrupt:
        print(f"\ncall again with {options.folder} to go on", file=sys.stderr)
        raise
    known = options.known_instrument()
    if known is not None:
        known.save(options.folder / INSTRUMENT, replace=True)
    print(table, f"\nwritten to {options.folder}", sep="\n")
