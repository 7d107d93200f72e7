"""What restorations that have to find the aberrations attain in long exposures and wide bands, over what is predicted.

    python experiments/smearing_map.py                    # 320 restorations: an hour and a half of one core
    python experiments/smearing_map.py --draws 2          # fewer of each
    python experiments/smearing_map.py --pupil full --exposures 0 1 2 4 8 --photons 1e5 1e6 1e7 1e8 \\
        --draws 3                                         # the full pupil
    python experiments/smearing_map.py --smoke            # everything, tiny, in seconds

Each draw is another mask (but for the full pupil), scene, turbulence and noise, and is restored from instants in
narrow light, from ever longer exposures and from ever wider bands, with the same photons in each frame. The library's
defaults are told the read-out noise and the band, not how long a frame lasts. What is predicted is `TurbulentMSE` for
instants in narrow light and known PSFs, times what `success_map` says that unknown ones cost: measure that map first.

The table, the figure and the numbers go to a new folder, and with them smearing_mask.json or smearing_full.json, which
`torchmask plan` interpolates (in torchmask/planning). Every restoration is kept in --sweep, from which a run that was
stopped goes on.
"""

from __future__ import annotations

import itertools
import math
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from map_draws import (
    FILL_FACTOR,
    HOLES,
    OUTER_SCALE,
    READOUT_NOISE,
    aperture_of,
    choose_pupils,
    of_pupil,
    predict,
    scene_of,
    score,
)
from mask_vs_full_options import DIAMETER, WAVELENGTH
from smearing_map_report import figure, markdown, summarise, table_of

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
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.optics.pupil import Aperture
from torchmask.planning.success import success_map
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation

WIND = 10.0  # in m/s; only T / tau0 counts
FIRST = 100  # draw: scenes and turbulence are others than those of `success_map`, `exposure` and `band`
OVERSAMPLING = 1.25  # of all bands
N_SIMULATED, N_TOLD = 5, 3  # wavelengths of a band, of the light and in the restoration


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """What is restored."""

    pupil: Literal["mask", "full"] = "mask"
    """What the frames are taken through: a mask, another for each draw, or the full pupil."""
    exposures: tuple[float, ...] = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Exposure times of a frame, T / tau0, of which the first is an instant."""
    widths: tuple[float, ...] = (0.02, 0.1, 0.2, 0.4)
    """Widths of the band over the wavelength, of which the first is narrow."""
    photons: tuple[float, ...] = (1e4, 1e5, 1e6, 1e7)
    """Electrons per frame through the mask or the full pupil, the same at all exposures and widths."""
    draws: int = 8
    """Draws of mask, scene, turbulence and noise."""
    d_over_r0: float = 4.0
    """Strength of the turbulence, D / r0."""
    n_frames: int = 8
    """Number of frames."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 4000
    """Maximum number of iterations of a restoration."""


def observe(task: Mapping[str, Any]) -> Observation:
    """Frames of a task, end to end."""
    width = task["width"] * WAVELENGTH
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"], OVERSAMPLING if width else 1.0)
    layers = Layers.from_fractions(DIAMETER / task["d_over_r0"], WAVELENGTH, (0.0,), (1.0,), [(WIND, 0.0)])
    return simulate_observation(
        *(scene_of(task["draw"], grid.shape, task["n_photons"]), aperture_of(task), grid),
        *(LayeredPhase(layers, WAVELENGTH, OUTER_SCALE), Detector(READOUT_NOISE), task["n_frames"]),
        torch.Generator().manual_seed(task["draw"]),
        conditions=Conditions(
            exposure_time=task["exposure"] * layers.tau0(WAVELENGTH),
            band=Band.top_hat(WAVELENGTH, width, N_SIMULATED) if width else None,
        ),
    )


def measure(task: Mapping[str, Any]) -> dict[str, Any]:
    """Restore, and score."""
    observation = observe(task)
    width = task["width"] * WAVELENGTH
    told = Band.top_hat(WAVELENGTH, width, N_TOLD) if width else Band.of([WAVELENGTH])
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid),
        readout_noise=READOUT_NOISE,
        wavelengths=told.wavelengths,
        weights=told.shares,
        max_iterations=task["iterations"],
    )
    blind = method.restore(observation.frames)
    return {
        "score": score(observation, blind.object),
        "chi_square": float(blind.chi_square.mean()),
        "iterations": len(blind.cost),
        "seconds": blind.seconds,
    }


def expect(options: Options, pupils: Sequence[Aperture], callback: Callback) -> list[dict[float, float]]:
    """Return what a plan expects of instants in narrow light but for the tables measured here, at each flux.

    For each pupil it is that of exposures, whose pixels are coarser, and then that of bands.
    """
    names = ("d_over_r0", "n_frames", "n_pixels", "photons")
    common = {name: getattr(options, name) for name in names} | {"torchmask": torchmask.__version__}
    tasks: list[dict[str, Any]] = [
        common | {"oversampling": finer} | of_pupil(pupil) for pupil in pupils for finer in (1.0, OVERSAMPLING)
    ]
    found = run_tasks(predict, tasks, options.sweep / "tasks", stage="smearing_predicted", **options.keywords(callback))
    expected = []
    for task, row in zip(tasks, found, strict=True):
        size = aperture_of(task).subaperture_diameter / DIAMETER * options.d_over_r0
        with warnings.catch_warnings(action="ignore", category=UserWarning):  # beyond it, the nearest edge is taken
            outlooks = [
                success_map(options.pupil).outlook(size, photons, options.n_frames) for photons in options.photons
            ]
        scores = [math.sqrt(one.mse(s**2, s**2)) for one, s in zip(outlooks, row["scores"], strict=True)]
        expected.append(dict(zip(options.photons, scores, strict=True)))
    return expected


def restore(options: Options, pupils: Sequence[Aperture], callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each draw, flux and amount, with its score and the one expected of instants in narrow light."""
    cases = [("exposure", length, 0.0) for length in options.exposures]
    cases += [("width", 0.0, width) for width in options.widths]
    names = ("d_over_r0", "n_frames", "n_pixels", "iterations")
    common = {name: getattr(options, name) for name in names} | {"torchmask": torchmask.__version__}
    expected, rows, tasks = expect(options, pupils, callback), [], []
    for (i, pupil), photons, (axis, exposure, width) in itertools.product(enumerate(pupils), options.photons, cases):
        draw = {"draw": FIRST + i, "n_photons": photons, "exposure": exposure, "width": width}
        rows.append(draw | {"axis": axis, "expected": expected[2 * i + (axis == "width")][photons]})
        tasks.append(common | draw | of_pupil(pupil))
    found = run_tasks(measure, tasks, options.sweep / "tasks", stage="smearing", **options.keywords(callback))
    return [row | dict(result) for row, result in zip(rows, found, strict=True)]


def setting(options: Options) -> str:
    """Return what all restorations share."""
    mask, holes = options.pupil == "mask", sorted(set(itertools.islice(itertools.cycle(HOLES), options.draws)))
    searched = f"searched masks of {', '.join(map(str, holes))} holes with a fill factor of {FILL_FACTOR:g}"
    number = options.draws * len(options.photons) * (len(options.exposures) + len(options.widths))
    return (
        f"{number} restorations of {options.n_frames} frames of {options.n_pixels} x {options.n_pixels} pixels, "
        f"{options.draws} draws of {'mask, ' * mask}scene, turbulence and noise at each point: "
        f"{searched if mask else 'a full pupil'}, a satellite and spotted balls half as wide as the field, D/r0 = "
        f"{options.d_over_r0:g}, one layer of full von Karman phase with an outer scale of "
        f"{OUTER_SCALE / DIAMETER:g} D, {READOUT_NOISE:g} electrons of read-out noise, no sky; exposures in light of "
        f"one wavelength, bands at instants. The library's defaults, told the read-out noise and the band as three "
        f"wavelengths but not the exposure, in float32, at most {options.iterations} iterations. "
        f"torchmask {torchmask.__version__}."
    )


def run(options: Options) -> None:
    """Search, restore and compare in a new folder."""
    if options.smoke:
        options = replace(options, exposures=(0.0, 2.0), widths=(0.02, 0.2), photons=(1e5, 1e6), draws=1)
        options = replace(options, n_pixels=36, n_frames=2, iterations=4)
    with new_run("smearing_map", options) as output:
        rows = restore(options, choose_pupils(options.pupil, options.draws, options, output.callback), output.callback)
        cells, told = summarise(rows), setting(options)
        output.report(
            "smearing_map", {"setting": told, "cells": cells, "rows": rows}, markdown(told, cells), figure(cells)
        )
        table = table_of(cells, options.d_over_r0) | {"conditions": told}
        write_json(output.directory / f"smearing_{options.pupil}.json", table)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("smearing_map", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
