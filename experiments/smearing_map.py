"""What long exposures and wide bands cost a restoration that has to find the aberrations, beyond what is predicted.

    python experiments/smearing_map.py                    # 180 restorations: an hour of one core
    python experiments/smearing_map.py --draws 2          # fewer of each
    python experiments/smearing_map.py --smoke            # everything, tiny, in seconds

Each draw is another mask, scene, turbulence and noise, and is restored from instants in narrow light, from ever longer
exposures and from ever wider bands, with the same photons in each frame. The library's defaults with one start are told
the read-out noise and the band, not how long a frame lasts. What is predicted is `TurbulentMSE` for the first mask.

The table, the figure and the numbers go to a new folder, and with them smearing.json, which `torchmask plan`
interpolates (torchmask/planning/smearing.json). Every restoration is kept in --sweep, from which a run that was stopped
goes on.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from mask_vs_full_options import DIAMETER, WAVELENGTH
from smearing_map_report import figure, markdown, summarise, table_of
from success_map import (
    FILL_FACTOR,
    HOLES,
    READOUT_NOISE,
    choose_masks,
    of_mask,
    restore_known,
    scene_of,
    score,
)
from trade import criterion

import torchmask
from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase
from torchmask.cli.options import SweepOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.sweep import run_tasks
from torchmask.grid import Grid
from torchmask.io import write_json
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation

WIND, OUTER_SCALE = 10.0, 20.0  # in m/s, of which only T / tau0 counts, and in D
FIRST = 100  # draw: scenes and turbulence are others than those of `success_map`, `exposure` and `band`
OVERSAMPLING = 1.25  # of all bands


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """What is restored."""

    exposures: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Exposure times of a frame, T / tau0, of which the first is the reference."""
    widths: tuple[float, ...] = (0.02, 0.1, 0.2, 0.4)
    """Widths of the band over the wavelength, of which the first is the reference."""
    photons: tuple[float, ...] = (1e5, 1e6, 1e7)
    """Electrons per frame through the mask, the same at all exposures and widths."""
    searched: tuple[float, ...] = (1e5, 1e6)
    """Those of them at which the aberrations are searched for; at the others PSFs are known."""
    draws: int = 5
    """Draws of mask, scene, turbulence and noise."""
    d_over_r0: float = 4.0
    """Strength of the turbulence, D / r0."""
    n_frames: int = 8
    """Number of frames."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 400
    """Maximum number of iterations of a restoration."""


def observe(task: Mapping[str, Any]) -> Observation:
    """Frames of a task, end to end."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    width = task["width"] * WAVELENGTH
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"], OVERSAMPLING if width else 1.0)
    layers = Layers.from_fractions(DIAMETER / task["d_over_r0"], WAVELENGTH, (0.0,), (1.0,), [(WIND, 0.0)])
    return simulate_observation(
        *(scene_of(task["draw"], grid.shape, task["n_photons"]), mask, grid),
        *(LayeredPhase(layers, WAVELENGTH, OUTER_SCALE * DIAMETER), Detector(READOUT_NOISE), task["n_frames"]),
        torch.Generator().manual_seed(task["draw"]),
        conditions=Conditions(
            exposure_time=task["exposure"] * layers.tau0(WAVELENGTH),
            band=Band.top_hat(WAVELENGTH, width, 5) if width else None,
        ),
    )


def measure(task: Mapping[str, Any]) -> dict[str, Any]:
    """Restore with unknown aberrations, and score."""
    observation = observe(task)
    width = task["width"] * WAVELENGTH
    told = Band.top_hat(WAVELENGTH, width, 3) if width else Band.of([WAVELENGTH])
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid),
        readout_noise=READOUT_NOISE,
        wavelengths=told.wavelengths,
        weights=told.shares,
        max_iterations=task["iterations"],
        dtype=torch.float32,
    )
    blind = method.restore(observation.frames)
    return {
        "score": score(observation, blind.object),
        "chi_square": float(blind.chi_square.mean()),
        "iterations": len(blind.cost),
        "seconds": blind.seconds,
    }


def measure_known(task: Mapping[str, Any]) -> dict[str, Any]:
    """Restore with the true PSFs of the whole exposure and band, and score."""
    observation = observe(task)
    return {"known": score(observation, restore_known(observation))}


def predict(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the score that the criterion predicts for known PSFs, at each flux of a task."""
    mask, kept, scores = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER), None, []
    told = {"instrument": "mask", "readout_noise": READOUT_NOISE, "outer_scale": OUTER_SCALE}
    told |= {"band": task["width"], "oversampling": OVERSAMPLING} if task["width"] else {}
    for photons in task["photons"]:
        lit = criterion({**task, **told, "n_photons": photons})
        kept = kept or lit  # whose tables of turbulence hold at any flux
        kept.load_state_dict(lit.state_dict())
        scores.append(math.sqrt(float(kept.relative(mask))))
    return {"scores": scores}


def restore(options: Options, masks: Sequence[SparseAperture], callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each draw, flux and amount, with its score where aberrations were searched for."""
    cases = [("exposure", length, 0.0) for length in options.exposures]
    cases += [("width", 0.0, width) for width in options.widths]
    names = ("d_over_r0", "n_frames", "n_pixels", "iterations")
    common = {name: getattr(options, name) for name in names} | {"torchmask": torchmask.__version__}
    folder, settings = options.sweep / "tasks", options.keywords(callback)
    told = [
        common | {"photons": options.photons, "exposure": exposure, "width": width} | of_mask(masks[0])
        for _, exposure, width in cases
    ]
    predicted = run_tasks(predict, told, folder, stage="smearing_predicted", **settings)
    rows, tasks = [], []
    for (i, mask), photons, k in itertools.product(enumerate(masks), options.photons, range(len(cases))):
        axis, exposure, width = cases[k]
        draw = {"draw": FIRST + i, "n_photons": photons, "exposure": exposure, "width": width}
        expected = predicted[k]["scores"][options.photons.index(photons)]
        rows.append({"axis": axis, "predicted": expected} | draw)
        tasks.append(common | draw | of_mask(mask))
    known = run_tasks(measure_known, tasks, folder, stage="smearing_known", **settings)
    rows = [row | dict(result) for row, result in zip(rows, known, strict=True)]
    searched = [k for k, row in enumerate(rows) if row["n_photons"] in options.searched]
    blind = run_tasks(measure, [tasks[k] for k in searched], folder, stage="smearing", **settings)
    for k, result in zip(searched, blind, strict=True):
        rows[k] |= dict(result)
    return rows


def setting(options: Options) -> str:
    """Return what all restorations share."""
    holes = sorted(set(itertools.islice(itertools.cycle(HOLES), options.draws)))
    number = options.draws * len(options.searched) * (len(options.exposures) + len(options.widths))
    return (
        f"{number} restorations of {options.n_frames} frames of {options.n_pixels} x {options.n_pixels} pixels, "
        f"{options.draws} draws of mask, scene, turbulence and noise at each point: searched masks of "
        f"{', '.join(map(str, holes))} holes with a fill factor of {FILL_FACTOR:g}, a satellite and spotted balls half "
        f"as wide as the field, D/r0 = {options.d_over_r0:g}, one layer of full von Karman phase with an outer scale "
        f"of {OUTER_SCALE:g} D, {READOUT_NOISE:g} electrons of read-out noise, no sky; exposures in light of one "
        f"wavelength, bands at instants. The library's defaults, told the read-out noise and the band as three "
        f"wavelengths but not the exposure, in float32, at most {options.iterations} iterations. "
        f"torchmask {torchmask.__version__}."
    )


def run(options: Options) -> None:
    """Search, restore and compare in a new folder."""
    if options.smoke:
        options = replace(options, exposures=(0.0, 2.0), widths=(0.02, 0.2), photons=(1e5, 1e6), draws=1)
        options = replace(options, n_pixels=36, n_frames=2, iterations=4)
    with new_run("smearing_map", options) as output:
        rows = restore(options, choose_masks(options.draws, options, output.callback), output.callback)
        cells, told = summarise(rows), setting(options)
        output.report(
            "smearing_map", {"setting": told, "cells": cells, "rows": rows}, markdown(told, cells), figure(cells)
        )
        write_json(output.directory / "smearing.json", table_of(cells) | {"conditions": told})


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("smearing_map", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
