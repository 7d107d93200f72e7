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
from torchmask.cli.criterion_options import ExposureOptions, exposure_options, rules_of, vanes_beside_file
from torchmask.cli.instrument_used import INSTRUMENT, with_light
from torchmask.cli.options import ConfigOptions, WorkerOptions, pixel_angle
from torchmask.design.conditions import ExposureConditions
from torchmask.design.space import AXES, DesignSpace
from torchmask.design.table import design_table
from torchmask.folders import free_name
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
    """Angle on the sky of one pixel [arcsec]; None: from --instrument, or else the largest without aliasing for D, at
    the wavelength."""
    wavelength: float | None = None
    """Wavelength of the observation [m], needed with a pixel scale; None: from --instrument, or none, as errors with
    pixels of wavelength / (2 D) depend on no wavelength."""
    n_photons: tuple[float, ...] | None = None  # pyright: ignore[reportIncompatibleVariableOverride] -- it may follow
    """Electrons per frame at the reference fill factor; at others they are in proportion to N d^2. None: from
    --instrument, or else 1e7."""
    n_frames: tuple[int, ...] | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Numbers of exposures, K; None: from --instrument, or else 20."""
    diameter_over_r0: tuple[float, ...] | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Strengths of turbulence, D / r0; None: from --instrument, or else 7. If empty, only MSE_a is computed, without a
    limit on d / r0."""
    knee: float | None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    """Frequency below which the object's spectrum is flat [cycles/pixel]; None: from --instrument, or else 1/64."""

    def __post_init__(self) -> None:
        """Leave all checks to the space that the options make, as some of its values follow from others."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets; all others follow from it."""
        return cls(
            folder=Path("runs/table"),
            mask_diameter=known.telescope.diameter,
            central_obstruction=known.telescope.central_obstruction,
            spiders=known.telescope.spiders,
            n_pixels=known.camera.n_pixels,
            outer_scale=known.site.outer_scale,
            readout_noise=known.camera.readout_noise,
            exponent=known.source.exponent,
            **exposure_options(known),
        )

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, but axes of several values."""
        names = ("mask_diameter", "central_obstruction", "outer_scale", "wavelength", "n_pixels", "pixel_scale_arcsec")
        given = {name: getattr(self, name) for name in (*names, "readout_noise", "exponent", "knee")}
        strength = _only(self.diameter_over_r0)
        given |= {"n_frames": _only(self.n_frames), "r0": self.mask_diameter / strength if strength else None}
        return super().beside_file() | vanes_beside_file(self) | given

    @property
    def reference_area(self) -> float:
        """Open area to which photons and sky belong [m^2]."""
        return math.pi / 4 * self.reference_fill_factor * self.mask_diameter**2


def _only(axis: tuple[Any, ...] | None) -> Any:
    """Return the value of an axis that has one, or else None."""
    return axis[0] if axis is not None and len(axis) == 1 else None


def run(options: Options) -> None:
    """Fill the table, or go on with it."""
    require_table_folder(options.folder)
    space = space_of(options)
    conditions = options.conditions(space.grid.wavelength, options.reference_area)
    require_rows_kept(options.folder, space, conditions)
    kept = kept_instrument(options)
    try:
        with Progress() as progress:
            table = design_table(space, options.folder, conditions=conditions, **options.keywords(progress))
    except KeyboardInterrupt:
        print(f"\ncall again with {options.folder} to go on", file=sys.stderr)
        raise
    save_config(options.folder / CONFIG, "table", options, replace=True)  # that of a table with fewer rows
    if kept is not None:
        kept.save(options.folder / INSTRUMENT, replace=True)
    print(table, f"\nwritten to {options.folder}", sep="\n")


def space_of(options: Options) -> DesignSpace:
    """Return the parameters of the table. Raises ValueError for another wavelength than that of --instrument."""
    quoted = {"--pixel-scale-arcsec": options.pixel_scale_arcsec is not None}
    wavelength = options.needed_wavelength(options.wavelength, quoted)
    known, used = options.known_instrument(), options.used_instrument()
    values: dict[str, Any] = {} if used is None else follow(used, options.reference_area)
    told = {item.name: getattr(options, item.name) for item in dataclasses.fields(DesignSpace)}
    values |= {name: value for name, value in told.items() if value is not None}
    values |= dataclasses.asdict(rules_of(options, known, used))
    values["wavelength"] = wavelength
    if options.pixel_scale_arcsec is not None:
        values["pixel_scale"] = pixel_angle(options.pixel_scale_arcsec)
    return DesignSpace(**values)


def follow(used: Instrument, area: float) -> dict[str, Any]:
    """Return what follows from an instrument for a table, unless it is given; `area` [m^2] is that of its light."""
    return {
        "n_photons": (used.photons(area),),
        "n_frames": (used.frames,),
        "diameter_over_r0": (used.telescope.diameter / used.site.r0,),
        "pixel_scale": used.pixel_scale,
        "knee": used.knee,
    }


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


def kept_instrument(options: Options) -> Instrument | None:
    """Return the instrument of the table, for its folder; None without a file.

    Of an axis with several values it keeps the file's.
    """
    used = options.used_instrument()
    return used and with_light(used, options.reference_area, _only(options.n_photons), options.sky)
