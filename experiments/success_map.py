"""Where a blind restoration succeeds, over the size of the holes, the light and the number of frames.

    python experiments/success_map.py                    # 272 restorations: up to an hour and a half of one core
    python experiments/success_map.py --draws 2 2 1      # fewer of each
    python experiments/success_map.py --smoke            # everything, tiny, in seconds

Each draw is another mask, scene, turbulence and noise, and goes through every combination of d/r0, photons and frames.
The frames are made end to end with the full von Karman phase. They are restored by the library's defaults, told
the read-out noise alone. The reference is the better of two that know more: the positive object of least
total variation for the true PSFs, and, for bright frames, the library's for the true aberrations. A restoration
succeeds where its score is within 1.3 of that. The Cramer-Rao bound of the first draw stands beside.

The figure, the table and the numbers go to a new folder, and with them success.json, the counts that `torchmask plan`
interpolates (torchmask/planning/success.json). Every restoration is kept in --sweep, from which a run that was stopped
goes on.
"""

from __future__ import annotations

import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from mask_vs_full import fit_modes
from scipy.optimize import minimize
from searched_masks import search_masks
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
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.planning.bounds import myopic_bound
from torchmask.record import Callback
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.priors import TotalVariation
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.spectra import NoisePSD, PowerLawPSD

DIAMETER, WAVELENGTH = 1.0, 550e-9  # [m]; only ratios to them matter
FILL_FACTOR, OUTER_SCALE, READOUT_NOISE = 0.15, 20.0, 1.5  # the second in m, the third in electrons per pixel
SIZE = 0.5  # of the scene over the field
HOLES = (10, 6, 14, 8, 12)  # of the masks, draw by draw
TRUE_MODES = 36  # by which the true aberrations are given, per hole
BRIGHT = 5e6  # electrons in all frames; in fainter ones noise hides the light that leaves the field


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """What is restored."""

    d_over_r0: tuple[float, ...] = (0.5, 0.8, 1.1, 1.5)
    """Diameter of a hole over r0."""
    photons: tuple[float, ...] = (1e4, 1e5, 1e6, 1e7)
    """Electrons per frame through the mask."""
    frames: tuple[int, ...] = (5, 10, 1)
    """Numbers of short exposures."""
    draws: tuple[int, ...] = (7, 7, 3)
    """Draws of mask, scene, turbulence and noise for each of the numbers of frames."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 4000
    """Maximum number of iterations of a restoration."""


def of_mask(mask: SparseAperture) -> dict[str, Any]:
    """Return what a task says of its mask."""
    return {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter}


def scene_of(draw: int, shape: tuple[int, int], n_photons: float) -> Tensor:
    """Return the packaged satellite in a random attitude (even draws), or a spotted ball (odd draws)."""
    generator = torch.Generator().manual_seed(1000 + draw)
    if draw % 2 == 0:
        pitch, yaw, roll = (360 * torch.rand(3, generator=generator) - 180).tolist()
        return make_scene(shape, n_photons, SceneOptions(attitude=(pitch, yaw, roll), size=SIZE))
    rows, columns = shape
    y, x = torch.meshgrid(torch.arange(rows) - rows / 2, torch.arange(columns) - columns / 2, indexing="ij")
    radius = SIZE * min(shape) / 2
    height = (1 - (x / (0.8 * radius)) ** 2 - (y / radius) ** 2).clamp(min=0).sqrt().double()  # limb darkening
    ball = height.clone()
    for _ in range(12):
        place, width, depth = torch.rand(2, generator=generator), torch.rand(1, generator=generator), 0.9
        spot = (x - radius * (2 * place[0] - 1)) ** 2 + (y - radius * (2 * place[1] - 1)) ** 2
        ball *= 1 - depth * torch.exp(-spot / (2 * (1 + 2 * width) ** 2))
    return ball * (n_photons / ball.sum())


def observe(task: Mapping[str, Any]) -> Observation:
    """Frames of a task, end to end."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    scene = scene_of(task["draw"], grid.shape, task["n_photons"])
    return simulate_observation(
        *(scene, mask, grid, TurbulencePhase(mask.subaperture_diameter / task["d_over_r0"], OUTER_SCALE)),
        *(Detector(READOUT_NOISE), task["n_frames"], torch.Generator().manual_seed(task["draw"])),
        keep_phases=True,
    )


def score(observation: Observation, image: Tensor) -> float:
    """Relative error up to the diffraction limit."""
    assert observation.object is not None
    return relative_error(image, observation.object, observation.grid.cutoff(DIAMETER))


def measure(task: Mapping[str, Any]) -> dict[str, Any]:
    """Restore with unknown aberrations, and with the true PSFs, and score both."""
    observation = observe(task)
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid),
        readout_noise=READOUT_NOISE,
        max_iterations=task["iterations"],
        dtype=torch.float32,
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
    """Return the score of the library's restoration where the true aberrations are given, by many modes of each hole.

    Unlike the true PSFs, which end at the edge of the field, it knows of the light that leaves it.
    """
    observation = observe(task)
    method = MyopicDeconvolution(
        *(observation.aperture, observation.grid, TRUE_MODES),
        readout_noise=READOUT_NOISE,
        aberration_prior=False,  # no prior weighs aberrations that are known
        max_iterations=task["iterations"],
        dtype=torch.float32,
    )
    restored = method.restore(observation.frames, coefficients=fit_modes(observation, TRUE_MODES))
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


def choose_masks(n_draws: int, options: SweepOptions, callback: Callback) -> list[SparseAperture]:
    """Return a searched mask for each draw."""
    holes = [HOLES[draw % len(HOLES)] for draw in range(n_draws)]
    masks = search_masks(holes, FILL_FACTOR, options, callback)
    return [masks[n] for n in holes]


def restore(options: Options, masks: Sequence[SparseAperture], callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each restoration; all combinations of one draw come before the next draw."""
    draws = [
        {"draw": draw, "n_frames": n_frames, "n_photons": photons, "d_over_r0": size}
        for draw in range(max(options.draws))
        for n_frames, most in zip(options.frames, options.draws, strict=True)
        for photons, size in itertools.product(options.photons, options.d_over_r0)
        if draw < most
    ]
    common = {"n_pixels": options.n_pixels, "iterations": options.iterations, "torchmask": torchmask.__version__}
    tasks = [common | draw | of_mask(masks[draw["draw"]]) for draw in draws]
    folder, settings = options.sweep / "tasks", options.keywords(callback)
    results = run_tasks(measure, tasks, folder, stage="success", **settings)
    bright = [task for task in tasks if task["n_photons"] * task["n_frames"] >= BRIGHT]
    given = iter(run_tasks(measure_given, bright, folder, stage="given", **settings))
    references = [next(given)["known"] if task in bright else math.inf for task in tasks]
    return [
        draw | dict(result) | {"known": min(result["known"], reference), "known_psfs": result["known"]}
        for draw, result, reference in zip(draws, results, references, strict=True)
    ]


def bound(task: Mapping[str, Any]) -> dict[str, Any]:
    """By what unknown aberrations raise the score of the first draw at least, by the local Cramer-Rao bound."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    photons, r0 = task["n_photons"], mask.subaperture_diameter / task["d_over_r0"]
    signal, noise = PowerLawPSD(1.5, photons, 1 / (SIZE * task["n_pixels"])), NoisePSD(photons, READOUT_NOISE)
    found = myopic_bound(
        *(scene_of(0, grid.shape, photons), mask, grid, signal, noise, task["n_frames"]),
        r0=r0,
        outer_scale=OUTER_SCALE,
        generator=torch.Generator().manual_seed(0),
    )
    floor = float(AsymptoticMSE(grid, signal, noise, 1).floor(DIAMETER) / signal(grid).mean())  # no score counts it
    return {"factor": math.sqrt((found.unknown - floor) / (found.known - floor))}


def bounds(options: Options, mask: SparseAperture, callback: Callback) -> dict[tuple[Any, ...], float]:
    """Return the factor of `bound` by frames, photons and d/r0, for the sizes that the figure shows."""
    keys = list(itertools.product(options.frames, options.photons, shown(options)))
    tasks = [dict(zip(KEYS, key, strict=True)) | {"n_pixels": options.n_pixels} | of_mask(mask) for key in keys]
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
        name: np.reshape([cell[name] for cell in cells], shape).tolist() for name in ("tried", "succeeded", "cost")
    }
    return axes | tables | {"conditions": setting(options, cells)}


def setting(options: Options, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return what all restorations share."""
    holes = sorted(set(itertools.islice(itertools.cycle(HOLES), max(options.draws))))
    few, many = min(options.draws), max(options.draws)
    return (
        f"{sum(cell['tried'] for cell in cells)} restorations of {options.n_pixels} x {options.n_pixels} pixels, {few} "
        f"to {many} draws of mask, scene, turbulence and noise at each point: searched masks of "
        f"{', '.join(map(str, holes))} holes with a fill factor of {FILL_FACTOR:g}, a satellite and spotted balls half "
        f"as wide as the field, full von Karman phase with an outer scale of {OUTER_SCALE / DIAMETER:g} D, independent "
        f"snapshots, {READOUT_NOISE:g} electrons of read-out noise, no sky. The library's defaults, told the read-out "
        f"noise, in float32, at most {options.iterations} iterations. torchmask {torchmask.__version__}."
    )


def run(options: Options) -> None:
    """Search, restore and compare in a new folder."""
    if options.smoke:
        options = replace(options, d_over_r0=(0.5, 1.0), photons=(1e6, 1e7), frames=(1, 2), draws=(1, 1), n_pixels=36)
        options = replace(options, iterations=4)
    with new_run("success_map", options) as output:
        masks = choose_masks(max(options.draws), options, output.callback)
        rows = restore(options, masks, output.callback)
        cells = summarise(rows, bounds(options, masks[0], output.callback))
        numbers = {"setting": setting(options, cells), "cells": cells, "rows": rows}
        output.report("success_map", numbers, markdown(setting(options, cells), cells), figure(rows, cells))
        write_json(output.directory / "success.json", table_of(options, cells))


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("success_map", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
