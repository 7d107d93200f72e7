"""Where a blind restoration succeeds, over the size of the holes, the light and the number of frames.

    python experiments/success_map.py                    # 368 restorations: over three hours of one core
    python experiments/success_map.py --draws 2 2 2 1    # fewer of each
    python experiments/success_map.py --pupil full --d-over-r0 2 4 7 10 --photons 1e5 1e6 1e7 1e8 \\
        --frames 5 10 1 --draws 3 3 2                    # 128 restorations through the full pupil
    python experiments/success_map.py --smoke            # everything, tiny, in seconds

Each draw is another mask (but for the full pupil), scene, turbulence and noise, and goes through every combination of
d/r0, photons and frames. The frames are made end to end with the full von Karman phase. They are restored by the
library's defaults, told the read-out noise alone. The reference is the better of two that know more: the positive
object of least total variation for the true PSFs, and the library's for the true aberrations. A restoration succeeds
where its score is within 1.3 of that. The Cramer-Rao bound of a mask's first draw stands beside.

The figure, the table and the numbers go to a new folder, and with them success_mask.json or success_full.json, the
counts that `torchmask plan` interpolates (in torchmask/planning). Make smearing_map anew after it, which counts on
its `level`. Every restoration is kept in --sweep, from which a run that was stopped goes on.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
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
from mask_vs_full import fit_modes
from mask_vs_full_options import DIAMETER, WAVELENGTH
from observing import SIZE
from scipy.optimize import minimize
from success_map_report import KEYS, figure, markdown, summarise
from torch import Tensor

import torchmask
from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.options import SweepOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.sweep import run_tasks
from torchmask.grid import Grid
from torchmask.io import write_json
from torchmask.observation import Observation
from torchmask.optics.detector import Detector
from torchmask.optics.pupil import Aperture
from torchmask.planning.bounds import myopic_bound
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.variation import TotalVariation
from torchmask.simulation.exposures import simulate_observation
from torchmask.spectra import NoisePSD, PowerLawPSD

TRUE_MODES = {"mask": 36, "full": 351}  # by which the true aberrations are given, per hole or of the full pupil


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """What is restored."""

    pupil: Literal["mask", "full"] = "mask"
    """What the frames are taken through: a mask, another for each draw, or the full pupil."""
    d_over_r0: tuple[float, ...] = (0.5, 0.8, 1.1, 1.5)
    """Diameter of a hole, or of the full pupil, over r0."""
    photons: tuple[float, ...] = (1e4, 1e5, 1e6, 1e7)
    """Electrons per frame through the mask or the full pupil."""
    frames: tuple[int, ...] = (5, 10, 20, 1)
    """Numbers of short exposures."""
    draws: tuple[int, ...] = (7, 7, 6, 3)
    """Draws of mask, scene, turbulence and noise for each of the numbers of frames."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 4000
    """Maximum number of iterations of a restoration."""


def observe(task: Mapping[str, Any]) -> Observation:
    """Frames of a task, end to end."""
    aperture, grid = aperture_of(task), Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    scene = scene_of(task["draw"], grid.shape, task["n_photons"])
    return simulate_observation(
        *(scene, aperture, grid, TurbulencePhase(aperture.subaperture_diameter / task["d_over_r0"], OUTER_SCALE)),
        *(Detector(READOUT_NOISE), task["n_frames"], torch.Generator().manual_seed(task["draw"])),
        keep_phases=True,
    )


def measure(task: Mapping[str, Any]) -> dict[str, Any]:
    """Restore with unknown aberrations, and with the true PSFs, and score both."""
    observation = observe(task)
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid),
        readout_noise=READOUT_NOISE,
        max_iterations=task["iterations"],
    )
    blind = method.restore(observation.frames)
    return {
        "score": score(observation, blind.object),
        "known": score(observation, restore_known(observation)),
        "chi_square": float(blind.chi_square.mean()),
        "iterations": len(blind.cost),
        "seconds": blind.seconds,
    }


def measure_given(task: Mapping[str, Any]) -> dict[str, Any]:
    """Return the score of the library's restoration where the true aberrations are given, by many modes of each hole or
    of the full pupil.

    Unlike the true PSFs, which end at the edge of the field, it knows of the light that leaves it.
    """
    observation, n_modes = observe(task), TRUE_MODES[task["pupil"]]
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid, n_modes),
        readout_noise=READOUT_NOISE,
        aberration_prior=False,  # no prior weighs aberrations that are known
        max_iterations=task["iterations"],
    )
    restored = method.restore(observation.frames, coefficients=fit_modes(observation, n_modes))
    return {"known": score(observation, restored.object)}


def restore_known(observation: Observation) -> Tensor:
    """Return the object (H, W) that minimises the library's cost for the true PSFs, with circular convolution.

    The frames enter by two sums over them, so that the time does not depend on their number.
    """
    assert observation.psfs is not None
    mean = float(observation.frames.mean())
    frames, variance = observation.frames.double() / mean, (mean + READOUT_NOISE**2) / mean**2
    shape = observation.grid.shape
    otfs = torch.fft.rfft2(observation.psfs.double().roll([-(side // 2) for side in shape], dims=(-2, -1)))
    power = (otfs.abs() ** 2).sum(0) / variance
    matched = torch.fft.irfft2((otfs.conj() * torch.fft.rfft2(frames)).sum(0) / variance, s=shape)
    prior = TotalVariation()

    def value_and_gradient(pixels: np.ndarray) -> tuple[float, np.ndarray]:
        image = torch.from_numpy(pixels).reshape(shape)
        blurred = torch.fft.irfft2(power * torch.fft.rfft2(image), s=shape)
        penalty, slope = prior.value_and_gradient(image)
        value = (image * (blurred / 2 - matched)).sum() + penalty
        return float(value), (blurred - matched + slope).flatten().numpy()

    start = frames.mean(0).clamp(min=0).flatten().numpy()
    bounds, options = [(0.0, None)] * start.size, {"maxiter": 1000, "maxcor": 20}
    found = minimize(value_and_gradient, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return torch.from_numpy(found.x).reshape(shape)


def restore(options: Options, pupils: Sequence[Aperture], callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each restoration; all combinations of one draw come before the next draw."""
    draws = [
        {"draw": draw, "n_frames": n_frames, "n_photons": photons, "d_over_r0": size}
        for draw in range(max(options.draws))
        for n_frames, most in zip(options.frames, options.draws, strict=True)
        for photons, size in itertools.product(options.photons, options.d_over_r0)
        if draw < most
    ]
    common = {"n_pixels": options.n_pixels, "iterations": options.iterations, "torchmask": torchmask.__version__}
    tasks = [common | draw | of_pupil(pupils[draw["draw"]]) for draw in draws]
    folder, settings = options.sweep / "tasks", options.keywords(callback)
    results = run_tasks(measure, tasks, folder, stage="success", **settings)
    given = run_tasks(measure_given, tasks, folder, stage="given", **settings)
    predicted = predictions(options, pupils, callback)
    return [
        draw
        | dict(result)
        | {"known": min(result["known"], reference["known"]), "known_psfs": result["known"]}
        | {"predicted": predicted[tuple(draw[name] for name in ("draw", *KEYS))]}
        for draw, result, reference in zip(draws, results, given, strict=True)
    ]


def predictions(options: Options, pupils: Sequence[Aperture], callback: Callback) -> dict[tuple[Any, ...], float]:
    """Return the score that the criterion predicts for known PSFs, by draw, frames, photons and d/r0."""
    common = {"n_pixels": options.n_pixels, "photons": options.photons, "torchmask": torchmask.__version__}
    cases = list(itertools.product(range(len(pupils)), options.frames, options.d_over_r0))
    tasks = []
    for draw, n_frames, size in cases:
        strength = size * DIAMETER / pupils[draw].subaperture_diameter  # D / r0
        tasks.append(common | of_pupil(pupils[draw]) | {"n_frames": n_frames, "d_over_r0": strength})
    found = run_tasks(predict, tasks, options.sweep / "tasks", stage="predicted", **options.keywords(callback))
    return {
        (draw, n_frames, photons, size): score
        for (draw, n_frames, size), row in zip(cases, found, strict=True)
        for photons, score in zip(options.photons, row["scores"], strict=True)
    }


def bound(task: Mapping[str, Any]) -> dict[str, Any]:
    """By what unknown aberrations raise the score of the first draw at least, by the local Cramer-Rao bound."""
    aperture, grid = aperture_of(task), Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    photons, r0 = task["n_photons"], aperture.subaperture_diameter / task["d_over_r0"]
    signal, noise = PowerLawPSD(1.5, photons, 1 / (SIZE * task["n_pixels"])), NoisePSD(photons, READOUT_NOISE)
    found = myopic_bound(
        *(scene_of(0, grid.shape, photons), aperture, grid, signal, noise, task["n_frames"]),
        r0=r0,
        outer_scale=OUTER_SCALE,
        generator=torch.Generator().manual_seed(0),
    )
    floor = float(AsymptoticMSE(grid, signal, noise, 1).floor(DIAMETER) / signal(grid).mean())  # no score counts it
    return {"factor": math.sqrt((found.unknown - floor) / (found.known - floor))}


def bounds(options: Options, pupil: Aperture, callback: Callback) -> dict[tuple[Any, ...], float]:
    """Return the factor of `bound` by frames, photons and d/r0, for the sizes that the figure shows; none of a full
    pupil, which leaves too little above the floor for a ratio."""
    if pupil.is_full:
        return {}
    keys = list(itertools.product(options.frames, options.photons, shown(options)))
    tasks = [dict(zip(KEYS, key, strict=True)) | {"n_pixels": options.n_pixels} | of_pupil(pupil) for key in keys]
    found = run_tasks(bound, tasks, options.sweep / "tasks", stage="bound", **options.keywords(callback))
    return {key: row["factor"] for key, row in zip(keys, found, strict=True)}


def shown(options: Options) -> list[float]:
    """Return the d/r0 of the figure's rows."""
    return sorted({options.d_over_r0[len(options.d_over_r0) // 3], options.d_over_r0[-1]})


def table_of(options: Options, cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what `torchmask.planning.success` reads."""
    axes = dict(zip(KEYS, map(sorted, (options.frames, options.photons, options.d_over_r0)), strict=True))
    shape = tuple(map(len, axes.values()))
    tables = {
        name: np.reshape([cell[name] for cell in cells], shape).tolist()
        for name in ("tried", "succeeded", "cost", "level")
    }
    return axes | tables | {"conditions": setting(options, cells)}


def setting(options: Options, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return what all restorations share."""
    holes = ", ".join(map(str, sorted(set(itertools.islice(itertools.cycle(HOLES), max(options.draws))))))
    few, many = min(options.draws), max(options.draws)
    mask = options.pupil == "mask"
    pupil = f"searched masks of {holes} holes with a fill factor of {FILL_FACTOR:g}" if mask else "a full pupil"
    return (
        f"{sum(cell['tried'] for cell in cells)} restorations of {options.n_pixels} x {options.n_pixels} pixels, {few} "
        f"to {many} draws of {'mask, ' * mask}scene, turbulence and noise at each point: {pupil}, a satellite and "
        f"spotted balls half as wide as the field, full von Karman phase with an outer scale of "
        f"{OUTER_SCALE / DIAMETER:g} D, independent snapshots, {READOUT_NOISE:g} electrons of read-out noise, no sky. "
        f"The library's defaults, told the read-out noise, in float32, at most {options.iterations} iterations. "
        f"torchmask {torchmask.__version__}."
    )


def run(options: Options) -> None:
    """Search, restore and compare in a new folder."""
    if options.smoke:
        options = replace(options, d_over_r0=(0.5, 1.0), photons=(1e6, 1e7), frames=(1, 2), draws=(1, 1))
        options = replace(options, n_pixels=36, iterations=4)
    with new_run("success_map", options) as output:
        pupils = choose_pupils(options.pupil, max(options.draws), options, output.callback)
        rows = restore(options, pupils, output.callback)
        cells = summarise(rows, bounds(options, pupils[0], output.callback))
        numbers = {"setting": setting(options, cells), "cells": cells, "rows": rows}
        output.report(
            "success_map", numbers, markdown(setting(options, cells), cells), figure(rows, cells, shown(options))
        )
        write_json(output.directory / f"success_{options.pupil}.json", table_of(options, cells))


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("success_map", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
