"""`torchmask design`: search a mask."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import torch

from torchmask.cli.criterion_options import ObservationOptions, observation_options
from torchmask.cli.options import RunOptions, SearchOptions
from torchmask.cli.report import log_design
from torchmask.cli.run import new_run
from torchmask.design.constraint_base import Constraint, project
from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.drawing import LIFE_SIZE, require_scale, save_dxf, save_svg
from torchmask.design.manufacture import least_pixels, save_fits, save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.room import count_holes
from torchmask.design.search import SearchResult, search_mask
from torchmask.design.tolerance import machining_tolerance
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.io import write_json
from torchmask.numbers import THROUGH_AIR, require_diameter, require_wavelength
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback, Record, fan_out

_LENGTHS = ("subaperture_diameter", "strict_hole_diameter", "shortest_baseline", "longest_baseline", "largest_gap")
_TOLERANCES = ("rms_error_tolerated", "rms_error_tolerated_standard_error")
_UNITS = {  # of metrics.json
    "mse": "electrons^2",
    **dict.fromkeys((*_LENGTHS, *_TOLERANCES), "m"),
    **dict.fromkeys(("fwhm", "fwhm_min", "fwhm_max"), "wavelength / mask_diameter"),
    "field_arcsec": "arcsec",
    "seconds": "s",
    "all others": "1",
}
_GROWTH, _SUCCESS = 0.01, 0.95  # tolerated growth of the MSE by machining errors, and fraction of masks below it


@dataclass(frozen=True, kw_only=True)
class Options(ObservationOptions, SearchOptions, RunOptions):
    """Search the positions of the holes that minimise the error of the restored image.

    Writes mask.json (for `torchmask simulate` and `restore`), mask.fits (an image in metres), the drawings mask.dxf and
    mask.svg (in millimetres), figures, metrics.json, config.yaml and the log to a new folder.
    """

    method: Literal["hybrid", "cma"] = "hybrid"
    """Search method: descents and basin hopping on a coarse grid, which finds better masks, or CMA-ES, as published."""
    scale: float = LIFE_SIZE
    """Scale of the drawings: millimetres on the plate for each metre of the pupil; 1000 is full size."""
    seed: int = 0
    """Random seed of the search."""

    @classmethod
    def of_instrument(cls, known: Instrument) -> Options:
        """Return the options that an instrument sets."""
        return cls(**observation_options(known))


def search(
    options: SearchOptions,
    criterion: AsymptoticMSE,
    mask_diameter: float,
    seed: int,
    callback: Callback,
    constraints: Sequence[Constraint] = (),
) -> SearchResult:
    """Search for a mask with these options."""
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
    """Search, and write the mask, or the best one so far if interrupted."""
    require_scale(options.scale)
    require_diameter("mask_diameter", options.mask_diameter)
    require_wavelength("wavelength", options.wavelength, *THROUGH_AIR)
    zones = options.rules()
    rules = zones.constraints()
    zones.require_on_pupil(options.mask_diameter)
    observed = options.observation(options.n_frequencies, options.fill_factor)
    criterion = observed.criterion()
    if options.r0 is not None and observed.turbulence is None:
        warn_of_wide_holes(options, options.r0)
    kept = options.kept_instrument(observed)
    last: list[Record] = []
    with new_run("design", options, options.seed) as output:
        output.keep_instrument(kept)
        started = time.perf_counter()

        def keep(record: Record) -> None:
            if not record.preparatory:
                last[:] = [record]

        try:
            callback = fan_out(keep, output.callback)
            result = search(options, criterion, options.mask_diameter, options.seed, callback, rules)
        except KeyboardInterrupt:
            if last:
                _save_interrupted(output.directory, options, last[0], rules)
            raise
        seconds = time.perf_counter() - started
        _save_mask(output.directory, result.aperture, options)
        log_design(result, criterion.grid, output.logger, rules)
        table = metrics(result, criterion) | {"evaluations": result.evaluations, "seconds": seconds}
        table["detector"] = detector(options.n_pixels, criterion.grid, options.observing_wavelength())
        table["machining"] = machining(criterion, result.aperture, options.seed, output.callback)
        if options.r0 is not None:
            table["hole_over_r0"] = result.aperture.subaperture_diameter / options.r0
        write_json(output.directory / "metrics.json", table)
        found = result.aperture
        output.summary.append(
            f"{count_holes(found.n_subapertures)} of {found.subaperture_diameter:.4g} m: relative MSE "
            f"{result.relative_mse:.5g}, {table['relative_mse_above_floor']:.5g} above what no mask of this diameter "
            f"can avoid; {result.evaluations} evaluations, {seconds:.0f} s"
        )


def warn_of_wide_holes(options: Options, r0: float) -> None:
    """Warn if holes are wider than r0, whose aberrations the criterion ignores."""
    hole = hole_diameter(options.n_subapertures, options.mask_diameter, options.fill_factor)
    if hole <= r0 * (1 + 1e-9):
        return
    enough = math.ceil(options.fill_factor * (options.mask_diameter / r0) ** 2 * (1 - 1e-9))
    warnings.warn(
        f"holes of {hole:.3g} m are {hole / r0:.2f} r0 wide: turbulence aberrates each of them, but the criterion "
        f"includes only a piston for each hole. At this fill factor, {enough} holes would not be wider than r0",
        stacklevel=2,
    )


def detector(n_pixels: int, grid: Grid, wavelength: float | None) -> dict[str, float | None]:
    """Return the size of the detector's field for metrics.json: pixels, and [arcsec] if there is a wavelength."""
    field = None if wavelength is None else n_pixels * grid.pixel_scale / ARCSEC
    return {"n_pixels": n_pixels, "field_arcsec": field}


def machining(
    criterion: AsymptoticMSE, aperture: SparseAperture, seed: int, callback: Callback
) -> dict[str, float | str]:
    """Return the machining tolerance for metrics.json: the rms error [m] of positions and diameter."""
    generator = torch.Generator().manual_seed(seed)
    found = machining_tolerance(criterion, aperture, _GROWTH, quantile=_SUCCESS, generator=generator, callback=callback)
    return {
        "error_of": found.kind,
        "growth_of_mse": _GROWTH,
        "success_probability": _SUCCESS,
        "rms_error_tolerated": found.rms,
        "rms_error_tolerated_standard_error": found.error,
    }


def metrics(result: SearchResult, criterion: AsymptoticMSE) -> dict[str, object]:
    """Return the properties of a mask for metrics.json: errors, hole size, baselines."""
    aperture = result.aperture
    table: dict[str, object] = {
        "units": _UNITS,
        "mse": result.mse,
        "relative_mse": result.relative_mse,
        "relative_mse_above_floor": result.relative_mse - criterion.relative_floor(aperture.mask_diameter),
        "subaperture_diameter": aperture.subaperture_diameter,
        "fill_factor": aperture.fill_factor,
    }
    if aperture.n_subapertures > 1:
        table["redundancy"] = asdict(analyse_redundancy(aperture))
    return table


def _save_mask(directory: Path, aperture: SparseAperture, options: Options) -> None:
    save_json(directory / "mask.json", aperture, options.observing_wavelength())
    save_fits(directory / "mask.fits", aperture, max(512, least_pixels(aperture)))
    save_svg(directory / "mask.svg", aperture, options.scale)
    save_dxf(directory / "mask.dxf", aperture, options.scale)


def _save_interrupted(directory: Path, options: Options, record: Record, rules: Sequence[Constraint]) -> None:
    """Write the best mask so far, projected onto the constraints, which a running search may violate slightly."""
    diameter = hole_diameter(options.n_subapertures, options.mask_diameter, options.fill_factor)
    best = SparseAperture(record.arrays["centers"], diameter, options.mask_diameter)
    try:
        _save_mask(directory, project(best, (InsideDisc(), NoOverlap(), *rules)), options)
    except ValueError as error:  # its centres are still in the checkpoint
        warnings.warn(f"the best mask so far is not written, because it is not feasible: {error}", stacklevel=2)
