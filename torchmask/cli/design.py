"""`torchmask design`: search a mask."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from torchmask.cli.options import RunOptions, SearchOptions
from torchmask.cli.report import log_design
from torchmask.cli.run import new_run
from torchmask.design.constraint_base import Constraint, project
from torchmask.design.constraints import InsideDisc, KeepOutDisc, KeepOutSegment, MinimumGap, NoOverlap
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.drawing import save_svg
from torchmask.design.manufacture import save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.search import SearchResult, search_mask
from torchmask.grid import Grid
from torchmask.io import write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback, Record, fan_out
from torchmask.spectra import NoisePSD, PowerLawPSD


@dataclass(frozen=True, kw_only=True)
class Options(SearchOptions, RunOptions):
    """Search the positions of the holes that minimise the error of the restored image.

    Writes mask.json (for `torchmask simulate` and `restore`), mask.svg (in millimetres, life-size), figures,
    metrics.json, config.yaml and the log to a new folder.
    """

    mask_diameter: float = 1.0
    """Of the disc that the mask is cut from, D [m]."""
    wavelength: float = 550e-9
    """Of the observation [m]."""
    n_photons: float = 1e7
    """Electrons per frame through the mask."""
    n_frames: int = 20
    """Short exposures that the restoration will have."""
    readout_noise: float = 0.0
    """Electrons rms per pixel and frame."""
    method: Literal["hybrid", "cma"] = "hybrid"
    """Descents and basin hopping on a coarse grid, which finds better masks, or CMA-ES, which is published."""
    min_gap: float = 0.0
    """Solid material between any two holes, at least [m]."""
    central_obstruction: float = 0.0
    """Diameter of the disc in the middle that no hole may reach [m]."""
    spiders: tuple[tuple[float, float, float, float, float], ...] = ()
    """Bars that no hole may reach, five numbers each: from x y to x y, width [m]."""
    seed: int = 0
    """Of the search."""


def make_criterion(search: SearchOptions, grid: Grid, noise: NoisePSD, n_frames: int) -> AsymptoticMSE:
    """The asymptotic MSE that the options ask for."""
    return AsymptoticMSE(grid, PowerLawPSD(search.exponent, noise.n_photons, search.knee), noise, n_frames=n_frames)


def search(
    options: SearchOptions,
    criterion: AsymptoticMSE,
    mask_diameter: float,
    seed: int,
    callback: Callback,
    constraints: Sequence[Constraint] = (),
) -> SearchResult:
    """Search as the options say."""
    return search_mask(
        criterion,
        options.n_subapertures,
        mask_diameter,
        options.fill_factor,
        method=options.method,
        refine=options.refine,
        budget=options.budget,
        seed=seed,
        constraints=constraints,
        callback=callback,
    )


def run(options: Options) -> None:
    """Search, and write the mask; interrupted, the best mask so far."""
    criterion = make_criterion(
        options,
        Grid.nyquist(options.mask_diameter, options.wavelength, options.n_frequencies),
        NoisePSD(options.n_photons, options.readout_noise),
        options.n_frames,
    )
    rules = constraints(options)
    last: list[Record] = []
    with new_run("design", options, options.seed) as output:
        started = time.perf_counter()

        def keep(record: Record) -> None:
            last[:] = [record]

        try:
            callback = fan_out(keep, output.callback)
            result = search(options, criterion, options.mask_diameter, options.seed, callback, rules)
        except KeyboardInterrupt:
            if last:
                _save_interrupted(output.directory, options, last[0], rules)
            raise
        seconds = time.perf_counter() - started
        _save_mask(output.directory, result.aperture)
        log_design(result, criterion.grid, output.logger, rules)
        table = metrics(result, criterion) | {"evaluations": result.evaluations, "seconds": seconds}
        write_json(output.directory / "metrics.json", table)
        output.summary.append(
            f"{result.aperture.n_subapertures} holes of {result.aperture.subaperture_diameter:.4g} m: relative MSE "
            f"{result.relative_mse:.5g}, {table['relative_mse_above_floor']:.5g} above what no mask of this diameter "
            f"can avoid; {result.evaluations} evaluations, {seconds:.0f} s"
        )


def constraints(options: Options) -> list[Constraint]:
    """The rules that the options ask for beside the mask disc and the overlap."""
    rules: list[Constraint] = []
    if options.min_gap:
        rules.append(MinimumGap(options.min_gap))
    if options.central_obstruction:
        rules.append(KeepOutDisc(options.central_obstruction))
    return rules + [KeepOutSegment((x, y), (to_x, to_y), width) for x, y, to_x, to_y, width in options.spiders]


def metrics(result: SearchResult, criterion: AsymptoticMSE) -> dict[str, object]:
    """What metrics.json says of a mask: errors, hole size, baselines."""
    aperture = result.aperture
    floor = float(criterion.floor(aperture.mask_diameter) / criterion.object_psd.mean())
    table: dict[str, object] = {
        "mse": result.mse,
        "relative_mse": result.relative_mse,
        "relative_mse_above_floor": result.relative_mse - floor,
        "subaperture_diameter": aperture.subaperture_diameter,
        "fill_factor": aperture.fill_factor,
    }
    if aperture.n_subapertures > 1:
        table["redundancy"] = asdict(analyse_redundancy(aperture))
    return table


def _save_mask(directory: Path, aperture: SparseAperture) -> None:
    save_json(directory / "mask.json", aperture)
    save_svg(directory / "mask.svg", aperture)


def _save_interrupted(directory: Path, options: Options, record: Record, rules: Sequence[Constraint]) -> None:
    """The best mask so far, moved onto the rules, which a search may break by a little on its way."""
    diameter = hole_diameter(options.n_subapertures, options.mask_diameter, options.fill_factor)
    best = SparseAperture(record.arrays["centers"], diameter, options.mask_diameter)
    try:
        _save_mask(directory, project(best, (InsideDisc(), NoOverlap(), *rules)))
    except ValueError as error:  # its centres are still in the checkpoint
        warnings.warn(f"the best mask so far is not feasible, and not written: {error}", stacklevel=2)
