"""How many holes: the N with the least error once the aberrations have to be found, over flux and turbulence.

    python experiments/number_of_holes.py                      # N = 3 to 90: twelve minutes of one core
    python experiments/number_of_holes.py --strengths 5        # another D / r0
    python experiments/number_of_holes.py --smoke              # everything, tiny, in seconds

At constant collecting area fewer holes are larger ones, which hold more aberrations to be found. The error for known
PSFs is that of TurbulentMSE at the best mask of the searches at any flux; what a blind restoration loses is measured
(torchmask.planning.success), at the size of the holes, the flux and the number of frames.

Table and numbers go to a new folder; searches and errors are kept in --sweep, from which a run that was stopped goes
on.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from searched_masks import SearchedMaskOptions, design_space

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.sweep import run_tasks
from torchmask.design.table import design_table
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.planning.success import success_map
from torchmask.record import Callback
from torchmask.spectra import NoisePSD, PowerLawPSD

DIAMETER, WAVELENGTH, OUTER_SCALE = 1.0, 550e-9, 20.0  # [m]; only ratios to them matter
FLAT = 0.05  # errors within so much of the least count as equal


@dataclass(frozen=True, kw_only=True)
class Options(SearchedMaskOptions):
    """What the errors depend on."""

    n_subapertures: tuple[int, ...] = (*range(3, 21), 24, 30, 40, 60, 90)
    """Numbers of holes, N."""
    photons: tuple[float, ...] = (1e5, 1e6, 1e7)
    """Electrons per frame."""
    strengths: tuple[float, ...] = (4.0, 7.0, 10.0)
    """Strengths of the turbulence, D / r0."""
    n_frames: int = 10
    """Number K of exposures."""
    n_pixels: int = 128
    """Number of samples per side of the frequency grid."""
    seed: tuple[int, ...] = (0,)
    """Seeds of the searches; at each flux the best of all masks is used."""
    budget: int = 10_000
    """Number of evaluations of each search."""


def predict(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the relative error for known PSFs of the best of the task's masks, and the floor, at each flux."""
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    masks = [SparseAperture(centers, task["subaperture_diameter"], DIAMETER) for centers in task["masks"]]
    kept, errors, floors = None, [], []
    for photons in task["photons"]:
        psds = PowerLawPSD(task["exponent"], photons), NoisePSD(photons)
        criterion = TurbulentMSE(grid, *psds, task["n_frames"], r0=DIAMETER / task["strength"], outer_scale=OUTER_SCALE)
        kept = kept or criterion  # whose tables of turbulence hold at any flux
        kept.load_state_dict(criterion.state_dict())
        errors.append(min(float(kept.relative(mask)) for mask in masks))
        floors.append(float(kept.floor(DIAMETER) / kept.object_psd.mean()))
    return {"errors": errors, "floors": floors}


def measure(options: Options, callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each strength, flux and N, with the error for known PSFs and for unknown ones."""
    table = design_table(design_space(options, n_photons=options.photons), options.sweep, **options.keywords(callback))
    common = {name: getattr(options, name) for name in ("photons", "n_frames", "n_pixels", "exponent")}
    keys, tasks = list(itertools.product(options.strengths, options.n_subapertures)), []
    for strength, n in keys:
        found = [table.aperture(row) for row in table.rows if row.n_subapertures == n]
        masks = {"masks": [mask.centers.tolist() for mask in found]}
        tasks.append(common | masks | {"strength": strength, "subaperture_diameter": found[0].subaperture_diameter})
    results = run_tasks(predict, tasks, options.sweep / "tasks", stage="holes", **options.keywords(callback))
    rows = []
    for (strength, n), task, result in zip(keys, tasks, results, strict=True):
        size = task["subaperture_diameter"] / DIAMETER * strength
        for photons, known, floor in zip(options.photons, result["errors"], result["floors"], strict=True):
            # the question is what unknown aberrations add to the criterion, not how known PSFs compare with it
            blind = replace(success_map().outlook(size, photons, options.n_frames), restored=1.0)
            row = {"d_over_r0_tried": "d_over_r0" not in blind.outside, "success": blind.success, "cost": blind.cost}
            row |= {"strength": strength, "n_photons": photons, "n_subapertures": n, "d_over_r0": size, "known": known}
            rows.append(row | {"blind": blind.mse(known, known - floor)})
    return rows


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each strength and flux: the best N, known and blind, which others are as good, and what 11 costs."""
    cells = []
    for strength, photons in dict.fromkeys((row["strength"], row["n_photons"]) for row in rows):
        own = [row for row in rows if (row["strength"], row["n_photons"]) == (strength, photons)]
        cell: dict[str, Any] = {"strength": strength, "n_photons": photons}
        for kind in ("known", "blind"):
            best = min(own, key=lambda row: row[kind])
            equal = [row["n_subapertures"] for row in own if row[kind] <= (1 + FLAT) * best[kind]]
            cell |= {kind: best["n_subapertures"], f"{kind}_error": best[kind], f"{kind}_equal": equal}
            cell |= {f"{kind}_11": next((r[kind] / best[kind] for r in own if r["n_subapertures"] == 11), None)}
            if kind == "blind":
                cell |= {name: best[name] for name in ("d_over_r0", "cost", "success")}
        cells.append(cell)
    return cells


def markdown(options: Options, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = [
        "# The number of holes",
        "",
        f"Relative MSE at a fill factor of {options.fill_factor:g}, K = {options.n_frames}, p = {options.exponent:g}, "
        f"{options.n_pixels} frequencies a side, searches of {options.budget} evaluations; in brackets all N within "
        f"{100 * FLAT:.0f} % of the least; below N = 11, its error over that.",
        "",
        "| D/r0 | photons | N, known PSFs | error | N = 11 | N, blind | error | N = 11 | d/r0 there | cost | success |",
        "|---" * 11 + "|",
    ]
    for cell in cells:
        texts = [f"{cell['strength']:g}", f"{cell['n_photons']:.0e}".replace("e+0", "e")]
        for kind in ("known", "blind"):
            eleven = "-" if cell[f"{kind}_11"] is None else f"{cell[f'{kind}_11']:.2f}"
            texts += [f"{cell[kind]} ({ranges(cell[f'{kind}_equal'])})", f"{cell[f'{kind}_error']:.4f}", eleven]
        texts += [f"{cell['d_over_r0']:.2f}", f"{cell['cost']:.2f}", f"{100 * cell['success']:.0f} %"]
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def ranges(numbers: Sequence[int]) -> str:
    """Whole numbers in rising order as text, runs of them shortened: 3, 5-8."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][-1] + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def run(options: Options) -> None:
    """Search, predict and compare in a new folder."""
    if options.smoke:
        options = replace(options, n_subapertures=(5, 8), photons=(1e6,), strengths=(5.0,), n_pixels=32, budget=64)
    with new_run("number_of_holes", options) as output:
        rows = measure(options, output.callback)
        cells = summarise(rows)
        text = markdown(options, cells)
        output.report("number_of_holes", {"cells": cells, "rows": rows}, text)
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("number_of_holes", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
