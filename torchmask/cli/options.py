"""Options shared by several commands. The text below each option is its help."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from torchmask.design.manufacture import load_mask, mask_wavelength
from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Telescope
from torchmask.numbers import require_diameter
from torchmask.optics import catalog, overlaps
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.record import Callback

DEFAULT_PHOTONS = 1e7  # per frame, if neither an option nor an instrument says it
FULL = "full"  # name of a full pupil
_SAME = 0.01  # relative difference of wavelengths that changes nothing else
MASK_SUFFIXES = (".json", ".dxf", ".fits")


@dataclass(frozen=True, kw_only=True)
class DebugOptions:
    """Option that shows the traceback of an error."""

    debug: tyro.conf.FlagCreatePairsOff[bool] = False
    """Show the traceback of an error."""


@dataclass(frozen=True, kw_only=True)
class ConfigOptions(DebugOptions):
    """Option that takes other options from a file."""

    config: Path | None = None
    """config.yaml of an earlier run, whose values are used for all options not given here."""


@dataclass(frozen=True, kw_only=True)
class InstrumentOptions:
    """File with what is known of an observation; each command has an `of_instrument` that turns it into options."""

    instrument: Path | None = None
    """An instrument.json of `torchmask plan`, or a YAML file with its keys; used for all options not given here."""

    def known_instrument(self) -> Instrument | None:
        """Return the instrument of the file, None without one."""
        return None if self.instrument is None else Instrument.load(self.instrument)

    def require_its_wavelength(self, wavelength: float) -> None:
        """Raise ValueError for another wavelength [m] than that of the instrument, for which it says r0 and light."""
        known = self.known_instrument()
        if known is not None and abs(wavelength / known.mean_wavelength - 1) > _SAME:
            raise ValueError(
                f"--wavelength is {wavelength:.4g} m, but r0 and light of --instrument {self.instrument} are those at "
                f"{known.mean_wavelength:.4g} m: change the wavelength there, with r0 and magnitude"
            )


@dataclass(frozen=True, kw_only=True)
class RunOptions(ConfigOptions):
    """Option that names the folder of the results."""

    out: Path | None = None
    """New folder for the results, such as runs/first; None: runs/COMMAND-date-time."""


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions(RunOptions):
    """Options of an experiment."""

    smoke: bool = False
    """Run with everything tiny, to test that it works."""


@dataclass(frozen=True, kw_only=True)
class WorkerOptions:
    """Options of commands that run many tasks."""

    workers: int | None = None
    """Number of processes at a time; None: one per core."""
    backend: Literal["loky", "ray"] = "loky"
    """Where tasks run: loky for this machine, ray for a Ray cluster."""

    def keywords(self, callback: Callback) -> dict[str, Any]:
        """Return the arguments for `run_tasks` and `design_table`."""
        return {"n_workers": self.workers, "backend": self.backend, "callback": callback}


@dataclass(frozen=True, kw_only=True)
class SweepOptions(WorkerOptions, ExperimentOptions):
    """An experiment of many independent tasks."""

    sweep: Path = Path("runs/sweep")
    """Folder for finished tasks, from which an interrupted run continues and which other runs share."""


def pixel_angle(arcsec: float | None) -> float | None:
    """Return the angle of --pixel-scale-arcsec [rad]. Raises ValueError unless it is finite and positive."""
    if arcsec is None:
        return None
    if not (math.isfinite(arcsec) and arcsec > 0):
        raise ValueError(f"--pixel-scale-arcsec is {arcsec:g}: it must be finite and positive, in arcsec")
    return arcsec * ARCSEC


@dataclass(frozen=True)
class SearchOptions:
    """The search for the mask, and the criterion it minimises."""

    n_subapertures: int = 11
    """Number of holes, N."""
    fill_factor: float = 0.15
    """Fill factor N d^2 / D^2, of holes of diameter d in a mask of diameter D."""
    method: Literal["cma", "hybrid"] = "cma"
    """Search method: CMA-ES, or descents and basin hopping on a coarse grid, which finds better masks."""
    refine: bool = True
    """Refine the result by gradient descent on the same criterion."""
    budget: int | None = None
    """Evaluations of the search, to which the refinement adds its own; None: 20000 for cma, 100000 for hybrid
    (minutes), fewer above 11 holes."""
    n_frequencies: int = 256
    """Frequencies per side of the criterion's grid."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    knee: float | None = None
    """Frequency below which that spectrum is flat [cycles/pixel], one over the object's size in pixels; None: 1/64, or
    that of the scene that `codesign` simulates."""


@dataclass(frozen=True, kw_only=True)
class CatalogOptions:
    """Size of a mask from the catalogue, and whether its holes may overlap."""

    mask_diameter: float | None = None
    """Diameter D of a mask from the catalogue [m]; None: as built."""
    fill_factor: float | None = None
    """Fill factor N d^2 / D^2 of a mask from the catalogue; None: as built. Golay arrays need diameter and factor."""
    mirrored: bool = False
    """Reverse x of a mask from the catalogue, for instruments that look from the other side."""
    allow_overlap: bool = False
    """Accept a mask whose holes overlap, as in some real masks; models count the light in overlaps twice."""


@dataclass(frozen=True, kw_only=True)
class MaskOptions(CatalogOptions):
    """The aperture."""

    mask: Annotated[Path | None, tyro.conf.arg(metavar="FILE|NAME|full")] = None
    """Mask file (.json, .dxf, .fits), name from `torchmask masks`, or `full` for a full pupil of --mask-diameter."""
    mask_diameter: float | None = None
    """Diameter D of a mask from the catalogue or of a full pupil [m]; None: as built."""
    central_obstruction: float | None = None
    """Diameter of the central obstruction of a full pupil [m]; None: that of the instrument, or else 0."""
    vane_width: float | None = None
    """Width of the vanes of a full pupil, which hold its secondary mirror [m]; None: that of the instrument, or else
    0."""
    vane_angles: tuple[float, ...] | None = None
    """Direction of each vane of a full pupil from its centre to its rim, counterclockwise from +x [degrees]; None:
    those of the instrument, or else no vanes."""


_PUPIL = ("central_obstruction", "vane_width", "vane_angles")  # of a full pupil, in `MaskOptions` and `Telescope`


_BEYOND = 1.05  # times the telescope's diameter, by which nominal pupils of real masks differ from it


def load_aperture(options: MaskOptions, telescope: Telescope | None = None) -> Aperture:
    """Return the aperture of `options.mask`, float64.

    A full pupil, and a pattern of the catalogue that has no size, are those of the telescope where the options say
    nothing else. Raises ValueError if the aperture is missing, unknown, invalid, or wider than the telescope, or the
    diameter is not that of a telescope or a mask in m.
    """
    require_diameter("--mask-diameter", options.mask_diameter)
    aperture = _find_aperture(options, telescope)
    if telescope is not None and aperture.mask_diameter > _BEYOND * telescope.diameter:
        raise ValueError(
            f"--mask {options.mask} is for a pupil of {aperture.mask_diameter:.4g} m, but the telescope has "
            f"{telescope.diameter:.4g} m: give another mask or telescope, or --mask-diameter to a mask of the catalogue"
        )
    return aperture


def _find_aperture(options: MaskOptions, telescope: Telescope | None) -> Aperture:
    if options.mask is None:
        raise ValueError(
            f"--mask is missing: give a mask file ({', '.join(MASK_SUFFIXES)}), a name from `torchmask masks`, or "
            f"{FULL}"
        )
    name = str(options.mask)
    if name == FULL:
        return _full_pupil(options, telescope)
    for option in _PUPIL:
        if getattr(options, option):
            option = option.replace("_", "-")
            raise ValueError(f"--{option} is for a full pupil (--mask full): leave it out for a mask")
    if is_mask_file(options.mask):
        return require_apart(name, load_mask_file(options.mask, options), options.allow_overlap)
    diameter = options.mask_diameter
    if telescope is not None and diameter is None and name in catalog.names():
        diameter = telescope.diameter if catalog.entry(name).pupil_diameter is None else None
    try:
        mask = SparseAperture.from_catalog(name, diameter, options.fill_factor, options.mirrored)
    except ValueError as error:
        raise ValueError(f"--mask {name}: {error}") from error
    return require_apart(name, mask, options.allow_overlap)


def _full_pupil(options: MaskOptions, telescope: Telescope | None) -> FullAperture:
    diameter = options.mask_diameter
    if telescope is None:
        if diameter is None:
            raise ValueError("a full pupil needs --mask-diameter [m]")
        FullAperture(diameter)  # raises for an invalid diameter, before it is divided by
        telescope = Telescope(diameter=diameter)
    told = {name: getattr(options, name) for name in _PUPIL if getattr(options, name) is not None}
    obstruction = told.get("central_obstruction", telescope.central_obstruction)
    if diameter is None:
        diameter = telescope.diameter
    if not 0 <= obstruction < diameter:
        raise ValueError(
            f"--central-obstruction is {obstruction:g} m: it must be at least 0 and less than --mask-diameter, "
            f"{diameter:g} m"
        )
    return replace(telescope, diameter=diameter, **told).pupil()


def mask_file_wavelength(options: MaskOptions) -> float | None:
    """Return the wavelength [m] in the file of the mask, or None if it has none."""
    return mask_wavelength(options.mask) if options.mask is not None and is_mask_file(options.mask) else None


def is_mask_file(path: Path) -> bool:
    """Return whether `path` is a file, of whatever kind, rather than a name in the catalogue, which has no suffix."""
    return path.is_file() or path.suffix != ""


def load_mask_file(path: str | Path, options: CatalogOptions) -> SparseAperture:
    """Return the mask in a file. Raises ValueError if options for masks of the catalogue are given."""
    if options.mask_diameter is not None or options.fill_factor is not None or options.mirrored:
        raise ValueError(
            f"--mask-diameter, --fill-factor and --mirrored are for masks from the catalogue: {path} is a file"
        )
    return load_mask(path)


def require_apart(name: str, mask: SparseAperture, allow_overlap: bool) -> SparseAperture:
    """Return the mask, or raise ValueError if its holes overlap, unless that is allowed."""
    try:
        overlaps.require_apart(mask, allow_overlap)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from error
    return mask
