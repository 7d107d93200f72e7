"""Tables for choosing the number of holes, their size and the flux, with a search for each combination.

MSE_a ignores turbulence within a hole, so by itself it would favour one hole that fills the pupil. The table therefore
makes the number of photons proportional to the collecting area, excludes holes larger than `max_hole_over_r0` times r0,
and adds the mean of `wiener_mse` under full von Karman screens, the error of a linear restoration with known OTFs.
With `conditions` the criterion is `TurbulentMSE`, which knows turbulence, exposure, band, pixels and sky.
"""

from __future__ import annotations

import csv
import io
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.design.conditions import ExposureConditions
from torchmask.design.constraint_base import Infeasible
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.rules import MaskRules
from torchmask.design.search import search_mask
from torchmask.design.space import AXES, Design, DesignSpace
from torchmask.design.sweep import run_tasks
from torchmask.design.turbulent import TurbulentMSE
from torchmask.design.workers import require_backend
from torchmask.grid import ARCSEC, Grid
from torchmask.io import atomic_write, from_json, to_json, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import OTF
from torchmask.record import Callback
from torchmask.spectra import NoisePSD, PowerLawPSD

_FRAMES_AT_ONCE = 20  # largest number of OTFs held in memory
_HEADINGS = {
    "n_subapertures": "N",
    "n_frames": "K",
    "diameter_over_r0": "D/r0",
    "subaperture_diameter": "d [m]",
    "photons_per_frame": "photons/frame",
    "wiener_error": "±",
}
_RESULTS = ("relative_mse", "above_floor", "wiener_mse", "wiener_error")
_COLUMNS = tuple(field.name for field in fields(Design) if field.name != "centers")


@dataclass(frozen=True)
class DesignTable:
    """A design table with rows in the order of the axes, which `print` shows as Markdown, its conditions above."""

    space: DesignSpace
    rows: tuple[Design, ...]
    conditions: ExposureConditions | None = None

    def aperture(self, row: Design) -> SparseAperture:
        """Return the mask of a row. Raises ValueError if it is infeasible."""
        if row.infeasible is not None:
            raise ValueError(f"there is no mask in this row: {row.infeasible}")
        return SparseAperture(
            torch.tensor(row.centers, dtype=torch.float64), row.subaperture_diameter, self.space.mask_diameter
        )

    def csv(self) -> str:
        """Return the table as CSV, without centres, with a line of names first and missing values empty."""
        text = io.StringIO()
        writer = csv.DictWriter(text, _COLUMNS, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(row) for row in self.rows)
        return text.getvalue()

    def __str__(self) -> str:
        names = [name for name in _COLUMNS if any(getattr(row, name) is not None for row in self.rows)]
        shared = [n for n in names if n in AXES and len({getattr(row, n) for row in self.rows}) == 1]
        names = [name for name in names if name not in shared]
        cells = [[_HEADINGS.get(name, name) for name in names]]
        cells += [[_cell(name, getattr(row, name)) for name in names] for row in self.rows]
        widths = [max(3, *map(len, column)) for column in zip(*cells, strict=True)]
        cells.insert(1, ["-" * width for width in widths])
        lines = [" | ".join(map(str.ljust, line, widths)) for line in cells]
        same = ", ".join(f"{_HEADINGS.get(name, name)} = {_cell(name, getattr(self.rows[0], name))}" for name in shared)
        above = [f"{self._heading()}.", *([f"In all rows: {same}."] if same else []), ""]
        return "\n".join([*above, *(f"| {line} |" for line in lines)])

    def _heading(self) -> str:
        """Return what holds for every row besides the axes, and by which criterion masks are searched."""
        space, rules = self.space, {field.name: getattr(self.space, field.name) for field in fields(MaskRules)}
        scale = f"pixels of {space.grid.pixel_scale / ARCSEC:.4g} arcsec at {1e9 * space.grid.wavelength:.4g} nm"
        told = [
            f"D = {space.mask_diameter:g} m",
            "pixels of wavelength / (2 D)" if space.wavelength is None else scale,
            f"{space.n_pixels} x {space.n_pixels} pixels with read-out noise of {space.readout_noise:g} electrons rms",
            f"photons at N d^2 / D^2 = {space.reference_fill_factor:g}",
            f"p = {space.exponent:g}, knee {space.knee:.4g} cycles/pixel",
            f"criterion: {self._criterion()}",
            f"{space.method} search",
        ]
        told += [f"{name.replace('_', ' ')} {value}" for name, value in rules.items() if value]
        return "; ".join(told)

    def _criterion(self) -> str:
        outer = f"outer scale {self.space.outer_scale:g} m"
        if self.conditions is None:
            drawn = f", then measured under screens of {outer}" if self.space.diameter_over_r0 else ""
            return f"asymptotic, instants of independent pistons{drawn}"
        known, band = self.conditions, self.conditions.wavelengths or ()
        wind = known.wind if isinstance(known.wind, tuple) else (known.wind,)
        colours = f"{len(band)} wavelengths from {1e9 * min(band):.4g} to {1e9 * max(band):.4g} nm" if band else ""
        told = (
            f"exposure {1e3 * known.exposure:.4g} ms",
            f"wind {' '.join(f'{speed:g}' for speed in wind)} m/s",
            colours or "one wavelength",
            f"pixel fill {known.pixel_fill:g}",
            f"sky {known.sky:.4g} electrons per pixel and frame",
        )
        return ", ".join(("turbulent", outer, *told))


def design_table(
    space: DesignSpace,
    folder: str | Path,
    *,
    conditions: ExposureConditions | None = None,
    backend: str = "loky",
    n_workers: int | None = None,
    callback: Callback | None = None,
) -> DesignTable:
    """Search for a mask for every combination of a design space, and measure it under turbulence.

    Every search and every measurement is a task whose result is saved at once: call again with the same folder to
    continue after an interruption, or to extend an axis. A combination that cannot be built has a row that says why.

    Parameters
    ----------
    space : DesignSpace
        Parameters of the table.
    folder : path
        Folder for the files of the tasks and of the table: table.md, table.csv, and table.json with the centres, which
        are written last and replace those of an earlier call.
    conditions : ExposureConditions, optional
        Exposure, band, pixels and sky, the sky at the reference fill factor: masks are then searched and measured by
        `TurbulentMSE` at the r0 of the row, without screens. None: by `AsymptoticMSE`.
    backend : {"loky", "ray"}
        Processes on this machine, or a Ray cluster; see `torchmask.design.sweep.run_tasks`.
    n_workers : int, optional
        Number of tasks that run at a time, each on one torch thread; by default one per core.
    callback : callable, optional
        Receives a `Record` after each task, of stage "design/table/search" or "design/table/turbulence".

    Raises
    ------
    ValueError
        Before any work, as `run_tasks` and `TurbulentMSE` do, if no combination can be built, and for conditions of a
        space without turbulence.

    Examples
    --------
    >>> import tempfile
    >>> space = DesignSpace(n_subapertures=(3, 6), fill_factor=(0.1,), n_frequencies=64, n_draws=2, budget=500)
    >>> table = design_table(space, tempfile.mkdtemp(), n_workers=1)
    >>> [row.n_subapertures for row in table.rows if row.relative_mse < 0.3]
    [6]
    """
    require_backend(backend, n_workers)
    rows = list(space.designs())
    if all(row.infeasible for row in rows):
        raise ValueError(f"no combination can be built; the reason for the first one: {rows[0].infeasible}")
    options: dict[str, Any] = {"backend": backend, "n_workers": n_workers, "callback": callback}

    feasible = [k for k, row in enumerate(rows) if not row.infeasible]
    if conditions is not None and not space.diameter_over_r0:
        raise ValueError("diameter_over_r0 is (): the conditions of an exposure need turbulence, D / r0")
    searches = [_search_task(space, rows[k], conditions) for k in feasible]
    _criterion(to_json(searches[0]))  # raises for conditions that cannot be
    found = run_tasks(search, searches, Path(folder) / "tasks", stage="design/table/search", **options)
    for k, result in zip(feasible, found, strict=True):
        rows[k] = replace(rows[k], **{**result, "centers": tuple(map(tuple, result["centers"]))})

    drawn = conditions is None and bool(space.diameter_over_r0)
    built = [k for k in feasible if drawn and not rows[k].infeasible]
    trials = [_turbulence_task(space, rows[k]) for k in built]
    measured = run_tasks(measure, trials, Path(folder) / "tasks", stage="design/table/turbulence", **options)
    for k, result in zip(built, measured, strict=True):
        rows[k] = replace(rows[k], **result)

    table = DesignTable(space, tuple(rows), conditions)
    write_json(Path(folder) / "table.json", table, replace=True)
    with atomic_write(Path(folder) / "table.csv", replace=True) as file:
        file.write(table.csv().encode())
    with atomic_write(Path(folder) / "table.md", replace=True) as file:
        file.write(f"{table}\n".encode())
    return table


def _scene(space: DesignSpace, row: Design) -> dict[str, Any]:
    """Return the values on which searches and measurements depend besides the mask."""
    names = ("mask_diameter", "n_pixels", "n_frequencies", "exponent", "knee", "readout_noise")
    return {name: getattr(space, name) for name in names} | {
        "wavelength": space.grid.wavelength,
        "pixel_scale": space.grid.pixel_scale,
        "photons_per_frame": row.photons_per_frame,
        "n_frames": row.n_frames,
        "seed": row.seed,
    }


def _search_task(space: DesignSpace, row: Design, conditions: ExposureConditions | None) -> dict[str, Any]:
    own: dict[str, Any] = {"n_subapertures": row.n_subapertures, "fill_factor": row.fill_factor}
    own["rules"] = {field.name: getattr(space, field.name) for field in fields(MaskRules)}
    if conditions is not None:
        own["conditions"] = asdict(conditions.with_light(row.fill_factor / space.reference_fill_factor))
        own |= {"diameter_over_r0": row.diameter_over_r0, "outer_scale": space.outer_scale}
    return _scene(space, row) | own | {"method": space.method, "budget": space.budget}


def _turbulence_task(space: DesignSpace, row: Design) -> dict[str, Any]:
    own = {name: getattr(row, name) for name in ("centers", "subaperture_diameter", "diameter_over_r0")}
    return (
        _scene(space, row) | own | {name: getattr(space, name) for name in ("outer_scale", "n_draws", "oversampling")}
    )


def _criterion(task: dict[str, Any]) -> AsymptoticMSE:
    grid = Grid(task["n_frequencies"], task["pixel_scale"], task["wavelength"])
    photons = task["photons_per_frame"]
    object_psd = PowerLawPSD(task["exponent"], photons, task["knee"])
    noise_psd = NoisePSD(photons, task["readout_noise"], task["n_pixels"] ** 2)
    if "conditions" not in task:
        return AsymptoticMSE(grid, object_psd, noise_psd, task["n_frames"])
    conditions = from_json(ExposureConditions, task["conditions"])
    r0 = task["mask_diameter"] / task["diameter_over_r0"]
    return TurbulentMSE(grid, object_psd, noise_psd, task["n_frames"], **conditions.keywords(r0, task["outer_scale"]))


def search(task: dict[str, Any]) -> dict[str, Any]:
    """Run the task of a search: find the best mask for one combination, or say why there is none."""
    criterion = _criterion(task)
    names = ("n_subapertures", "mask_diameter", "fill_factor", "method", "seed", "budget")
    rules = from_json(MaskRules, task["rules"]).constraints()
    try:
        result = search_mask(criterion, **{name: task[name] for name in names}, constraints=rules)
    except Infeasible as error:
        return {"centers": [], "infeasible": str(error)}
    return {
        "centers": result.aperture.centers,
        "relative_mse": result.relative_mse,
        "above_floor": result.relative_mse - criterion.relative_floor(task["mask_diameter"]),
    }


def measure(task: dict[str, Any]) -> dict[str, Any]:
    """Run the task of a measurement: mean and standard error of a mask's relative `wiener_mse` under turbulence."""
    criterion = _criterion(task)
    centers = torch.tensor(task["centers"], dtype=torch.float64)
    mask = SparseAperture(centers, task["subaperture_diameter"], task["mask_diameter"])
    otf = OTF(mask, criterion.grid, task["oversampling"])
    samples = otf.samples()
    turbulence = TurbulencePhase(task["mask_diameter"] / task["diameter_over_r0"], task["outer_scale"])
    generator = torch.Generator().manual_seed(task["seed"])
    values = []
    for _ in range(task["n_draws"]):
        power = torch.zeros(criterion.grid.shape, dtype=torch.float64)
        for first in range(0, task["n_frames"], _FRAMES_AT_ONCE):
            phase = turbulence(samples, min(_FRAMES_AT_ONCE, task["n_frames"] - first), generator)
            power += (otf(phase).abs() ** 2).sum(0)
        values.append(wiener_mse(power.sqrt()[None], criterion.object_psd, criterion.noise_psd))
    relative = torch.stack(values) / criterion.object_psd.mean()
    return {"wiener_mse": relative.mean(), "wiener_error": relative.std() / math.sqrt(len(values))}


def _cell(name: str, value: Any) -> str:
    if value is None:
        return ""
    if name in _RESULTS:
        return f"{value:#.4g}"  # with trailing zeros
    return f"{value:.4g}" if isinstance(value, float) else str(value)
