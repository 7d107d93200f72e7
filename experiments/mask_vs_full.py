"""Where a mask gives the better image, and where the full pupil does, over flux and turbulence.

    python experiments/mask_vs_full.py                             # a reduced grid: half an hour on two cores
    python experiments/mask_vs_full.py --full                      # photons 1e4 to 1e8, D/r0 3 to 15, five seeds
    python experiments/mask_vs_full.py --scenes model.obj          # further scenes: meshes or images
    python experiments/mask_vs_full.py --smoke                     # everything, tiny, in seconds

Both instruments look at the same scene through the same screens, and both are restored by the library's defaults with
equal iterations. The full pupil reaches as far as the mask and receives photons in proportion to its area. Its many
modes make many local minima, so each of its frames begins with 16 candidates, and of --restarts restorations the one
that fits its frames best is kept; the mask starts from zero aberrations, once. The floor of each instrument is the same
restoration with the true aberrations given. What is found follows from the numbers, by the paired ratio of scores over
scenes and seeds.

The figure, the table and the numbers go to a new folder; every restoration is kept in --sweep, so that a
run that was stopped, or a wider grid, goes on from there.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from mask_vs_full_options import DIAMETER, WAVELENGTH, MaskSearchOptions, Options, check, scenes, with_presets
from mask_vs_full_report import INSTRUMENTS, figure, findings, markdown, summarise
from torch import Tensor

import torchmask
from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.manufacture import load_mask
from torchmask.design.space import DesignSpace
from torchmask.design.sweep import run_tasks
from torchmask.design.table import design_table
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.observation import PHASE_OVERSAMPLING, Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.overlaps import check_overlaps
from torchmask.optics.pupil import Aperture
from torchmask.optics.shapes import Disc
from torchmask.optics.zernike import zernike_basis
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

TRUE_MODES = {"mask": 36, "full": 351}  # by which the true aberrations are given, per sub-aperture


def instrument(task: Mapping[str, Any]) -> Aperture:
    """Return the mask, or the full pupil that reaches as far."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    return mask if task["instrument"] == "mask" else FullAperture(mask.extent)


def observe(task: Mapping[str, Any]) -> tuple[Observation, Tensor]:
    """Short exposures end to end, with the full phase, and the aberrations (T, N, J) behind them [rad rms]."""
    aperture = instrument(task)
    mask = instrument({**task, "instrument": "mask"})
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    path, attitude = task["scene"]["path"], task["scene"]["attitude"]
    options = SceneOptions(Path(path) if path else None, tuple(attitude) if attitude else None, size=0.5)
    scene = make_scene(grid.shape, task["n_photons"] * aperture.area / mask.area, options)
    turbulence = TurbulencePhase(DIAMETER / task["d_over_r0"], task["outer_scale"] * DIAMETER)
    detector, generator = Detector(task["readout_noise"]), torch.Generator().manual_seed(task["seed"])
    observation = simulate_observation(
        scene, aperture, grid, turbulence, detector, task["n_frames"], generator, keep_phases=True
    )
    return observation, fit_modes(observation, TRUE_MODES[task["instrument"]])


def fit_modes(observation: Observation, n_modes: int) -> Tensor:
    """Zernike coefficients (T, N, J) [rad rms] of the phases of an observation, by weighted least squares."""
    assert observation.phases is not None
    samples = observation.aperture.samples(observation.grid, PHASE_OVERSAMPLING)
    basis = zernike_basis(samples, observation.aperture, n_modes)
    root = samples.weights.sqrt()[..., None]
    # Phases of all frames are the columns.
    fit = torch.linalg.lstsq(root * basis, root * observation.phases.permute(1, 2, 0), driver="gelsd").solution
    return fit.permute(2, 0, 1).contiguous()


def measure(task: dict[str, Any]) -> dict[str, Any]:
    """Return the task of one restoration: `start` counts the starts of a myopic one, "truth" gives it the aberrations.

    The starting aberrations of a full pupil belong to the place of a frame in the stack, so the frames turned round by
    some places have another start each.
    """
    observation, truth = observe(task)
    aperture, grid, frames = observation.aperture, observation.grid, observation.frames
    if task["start"] == "truth":
        # No prior weighs aberrations that are known.
        method = MyopicDeconvolution(
            aperture, grid, truth.shape[-1], aberration_prior=False, max_iterations=task["iterations"]
        )
        result = method.restore(frames, coefficients=truth)
    else:
        method = MyopicDeconvolution(aperture, grid, max_iterations=task["iterations"])
        result = method.restore(frames.roll(task["start"], dims=0))
    assert observation.object is not None
    cutoff = grid.cutoff(DIAMETER)
    return {
        "score": relative_error(result.object, observation.object, cutoff),
        "mean_frame": relative_error(frames.mean(0), observation.object, cutoff),
        "chi_square": float(result.chi_square.mean()),
        "iterations": len(result.cost),
        "converged": result.converged,
        "seconds": result.seconds,
    }


def choose_mask(options: MaskSearchOptions, callback: Callback) -> SparseAperture:
    """Return the mask of --mask, or the one that a search finds for the reference case."""
    if options.mask is not None:
        mask = load_mask(options.mask)
        if mask.shape != Disc() or not math.isclose(mask.mask_diameter, DIAMETER, rel_tol=1e-6):
            raise ValueError(
                f"{options.mask} has {mask.shape} holes in {mask.mask_diameter:g} m: discs in {DIAMETER:g} m are needed"
            )
        check_overlaps(mask)
        return mask
    space = DesignSpace(
        n_subapertures=(options.n_subapertures,),
        fill_factor=(options.fill_factor,),
        reference_fill_factor=options.fill_factor,
        diameter_over_r0=(),
        n_frequencies=64 if options.smoke else 256,
        budget=options.budget,
    )
    table = design_table(space, options.sweep, **options.keywords(callback))
    return table.aperture(table.rows[0])


def sweep(options: Options, mask: SparseAperture, callback: Callback) -> list[dict[str, Any]]:
    """Return one row per draw (scene, seed, photons, D/r0) and instrument."""
    common = {name: getattr(options, name) for name in ("n_frames", "n_pixels", "iterations", "readout_noise")}
    common |= {"outer_scale": options.outer_scale, "torchmask": torchmask.__version__}
    common |= {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter}
    rows, tasks = [], []
    draws = itertools.product(options.d_over_r0, options.photons, scenes(options).items(), options.seeds, INSTRUMENTS)
    for strength, photons, (name, scene), seed, which in draws:
        draw = {"instrument": which, "n_photons": photons, "d_over_r0": strength, "seed": seed}
        rows.append(draw | {"scene": name})
        starts = ["truth", *range(options.restarts if which == "full" else 1)]
        tasks.append([common | draw | {"scene": scene, "start": start} for start in starts])
    results = iter(
        run_tasks(
            measure,
            list(itertools.chain(*tasks)),
            options.sweep / "tasks",
            stage="mask_vs_full",
            **options.keywords(callback),
        )
    )
    for row, own in zip(rows, tasks, strict=True):
        floor, *starts = (next(results) for _ in own)
        best = min(starts, key=lambda result: result["chi_square"])  # all that an observer could choose by
        row |= best | {"floor": floor["score"], "scores_of_starts": [start["score"] for start in starts]}
    return rows


def setting(options: Options, mask: SparseAperture) -> str:
    """Return a sentence on what all draws share."""
    light = FullAperture(mask.extent).area / mask.area
    kept = f" Of {options.restarts} restorations of the full pupil the lowest chi-square is kept."
    return (
        f"{mask.n_subapertures} holes, fill factor {mask.fill_factor:.3g}; the full pupil reaches as far and gets "
        f"{light:.2f} times the photons. {options.n_frames} frames of {options.n_pixels} x {options.n_pixels} pixels, "
        f"{options.readout_noise:g} electrons of read-out noise, outer scale {options.outer_scale:g} D, "
        f"{len(scenes(options))} scenes, {len(options.seeds)} seeds. At most {options.iterations} iterations."
        f"{kept if options.restarts > 1 else ''}"
    )


def run(options: Options) -> None:
    """Search, restore, compare, in a new folder."""
    options = with_presets(options)
    check(options)
    with new_run("mask_vs_full", options) as output:
        mask = choose_mask(options, output.callback)
        rows = sweep(options, mask, output.callback)
        cells = summarise(rows)
        found = findings(cells)
        numbers = {
            "torchmask": torchmask.__version__,
            "mask": {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter},
            "findings": found,
            "cells": cells,
            "rows": rows,
        }
        output.report("mask_vs_full", numbers, markdown(setting(options, mask), found, cells), figure(cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("mask_vs_full", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
