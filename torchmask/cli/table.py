"""`torchmask table`: a searched mask for each combination of hole number, hole size, light and turbulence."""

from __future__ import annotations

import dataclasses
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import tyro

from torchmask.cli.config import CONFIG, config_command, save_config
from torchmask.cli.criterion_options import ExposureOptions, exposure_options
from torchmask.cli.instrument_used import INSTRUMENT, instrument_used
from torchmask.cli.options import ConfigOptions, WorkerOptions, pixel_angle
from torchmask.design.conditions import ExposureConditions
from torchmask.design.space import AXES, DesignSpace
from torchmask.design.table import design_table
from torchmask.folders import free_name
from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.io import read_json, to_json
from torchmask.progress import Progress

_UNFINISHED = {"tasks", "table.json", "table.csv", "table.md"}  # all that a table has before its config.yaml


@dataclass(frozen=True, kw_only=True)
class Options(ExposureOptions, DesignSpace, WorkerOptions, ConfigOptions):
    """Compare numbers of holes, hole sizes, numbers of photons and frames, and turbulence, in one table.

    Each combination is a row, with a mask of its own, searched as by `torchmask design`, and its error. Writes one file
    for each search, table.md, table.csv, table.json with the positions of the holes, config.yaml and, with
    --instrument, instrument.json to the folder. The same command again goes on where it was stopped, and a longer list
    only computes what is new; what would drop rows is refused.
    """

    pixel_scale: ClassVar[None] = None  # pyright: ignore[reportIncompatibleVariableOverride] -- told in arcsec, below
    folder: tyro.conf.Positional[Path]
    """Folder for the table and its parts, such as runs/table."""
    pixel_scale_arcsec: float | None = None
    """Angle on the sky of one pixel [arcsec]; None: the largest without aliasing for D, at the wavelength."""

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
            pixel_scale_arcsec=known.pixel_scale / ARCSEC,
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
    require_table_folder(options.folder)
    space = space_of(options)
    area = math.pi / 4 * space.reference_fill_factor * space.mask_diameter**2
    conditions = options.conditions(space.grid.wavelength, area)
    require_rows_kept(options.folder, space, conditions)
    used = used_instrument(options, area, conditions)
    try:
        with Progress() as progress:
            table = design_table(space, options.folder, conditions=conditions, **options.keywords(progress))
    except KeyboardInterrupt:
        print(f"\ncall again with {options.folder} to go on", file=sys.stderr)
        raise
    save_config(options.folder / CONFIG, "table", options, replace=True)  # that of a table with fewer rows
    if used is not None:
        used.save(options.folder / INSTRUMENT, replace=True)
    print(table, f"\nwritten to {options.folder}", sep="\n")


def space_of(options: Options) -> DesignSpace:
    """Return the parameters of the table. Raises ValueError for another wavelength than that of --instrument."""
    quoted = {"--pixel-scale-arcsec": options.pixel_scale_arcsec is not None}
    wavelength = options.needed_wavelength(options.wavelength, quoted)
    if wavelength is not None:
        options.require_its_wavelength(wavelength)
    values: dict[str, Any] = {item.name: getattr(options, item.name) for item in dataclasses.fields(DesignSpace)}
    values |= {"wavelength": wavelength, "pixel_scale": pixel_angle(options.pixel_scale_arcsec)}
    return DesignSpace(**values)


def require_table_folder(folder: Path) -> None:
    """Raise ValueError if a folder holds anything but a table, whose files would be mixed up with it or replaced."""
    held = {path.name for path in folder.iterdir()} if folder.is_dir() else set[str]()
    command = config_command(folder / CONFIG)
    if command == "table" or held <= _UNFINISHED:
        return
    found = ", ".join(sorted(held)[:3]) + (", ..." if len(held) > 3 else "")
    what = f"a run of `torchmask {command}`" if command else f"files that are not of a table ({found})"
    raise ValueError(
        f"{folder} holds {what}, and nothing is overwritten: name a new folder, such as {free_name(folder)}, or that "
        "of a table"
    )


def require_rows_kept(folder: Path, space: DesignSpace, conditions: ExposureConditions | None) -> None:
    """Raise ValueError if a table that the folder holds has rows that this one would not have."""
    path = folder / "table.json"
    if not path.is_file():
        return
    before, now = read_json(path), to_json(space)
    axes = [{name: set(values[name]) or {None} for name in AXES} for values in (before["space"], now)]
    lost = [name for name in AXES if not axes[0][name] <= axes[1][name]]
    other = [name for name in now if name not in AXES and before["space"].get(name) != now[name]]
    was, is_now = before["conditions"], to_json(conditions)
    if was is None or is_now is None:
        other += ["criterion"] * (was != is_now)
    else:
        other += [name for name in is_now if was.get(name) != is_now[name]]
    if not (lost or other):
        return
    needs = [f"{_flag(name)} {' '.join(map(str, before['space'][name]))}" for name in lost if before["space"][name]]
    needs += [f"no {_flag(name)}" for name in lost if not before["space"][name]]
    needs += [f"the same {_flag(name)}" for name in other]
    raise ValueError(
        f"the table in {folder} has rows that this one would not have, and nothing is overwritten: give "
        f"{', '.join(needs)} beside what is new, or another folder"
    )


def _flag(name: str) -> str:
    """Return how a parameter of the table is written."""
    return "--pixel-scale-arcsec" if name == "pixel_scale" else f"--{name.replace('_', '-')}"


def used_instrument(options: Options, area: float, conditions: ExposureConditions | None) -> Instrument | None:
    """Return the instrument of the table, with what was given beside its file; None without a file.

    Of an axis with several values it keeps the file's. `area` [m^2] is that of the reference fill factor.
    """
    known = options.known_instrument()
    if known is None:
        return None
    names = ("mask_diameter", "central_obstruction", "outer_scale", "n_pixels", "pixel_fill", "readout_noise")
    frames, strength, photons = (
        axis[0] if len(axis) == 1 else None for axis in (options.n_frames, options.diameter_over_r0, options.n_photons)
    )
    given = {name: getattr(options, name) for name in (*names, "exponent", "knee")} | {
        "r0": strength and options.mask_diameter / strength,
        "wind": math.hypot(*options.wind) if options.wind else None,
        "exposure": options.exposure_time,
        "n_frames": known.frames if frames is None else frames,
        "pixel_scale": options.pixel_scale_arcsec,
    }
    used = instrument_used(known, area, given)
    sky = None if conditions is None else conditions.sky
    light = {"n_photons": _unless_same(photons, used.photons(area)), "sky": _unless_same(sky, used.sky(area))}
    return instrument_used(known, area, given | light)


def _unless_same(value: float | None, known: float) -> float | None:
    """Return a value, or None, which changes nothing, if it differs from what is known by rounding only."""
    return None if value is None or math.isclose(value, known, rel_tol=1e-9) else value
