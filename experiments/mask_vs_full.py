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

The figure, the table and the numbers go to a new folder, runs/<name>/; every restoration is kept in --sweep, so that a
run that was stopped, or a wider grid, goes on from there.
"""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
import tyro
from scipy.stats import t as student
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.design.manufacture import load_mask
from torchmask.design.space import DesignSpace
from torchmask.design.sweep import run_tasks
from torchmask.design.table import design_table
from torchmask.grid import Grid
from torchmask.io import atomic_write, write_json
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture, FullAperture, PupilSamples, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.zernike import zernike_basis
from torchmask.progress import Progress
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIAMETER, WAVELENGTH = 1.0, 550e-9  # [m]; only ratios to them matter
INSTRUMENTS = {"mask": "mask", "full": "full pupil"}
TRUE_MODES = {"mask": 36, "full": 351}  # by which the true aberrations are given, per sub-aperture
CONFIDENCE = 0.95
VIEWS = {"satellite, oblique": (25.0, -30.0, 15.0), "satellite, front": (0.0, 0.0, 0.0)}


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    photons: tuple[float, ...] = (1e5, 1e6, 1e7)
    """Electrons per frame through the mask."""
    d_over_r0: tuple[float, ...] = (3.0, 7.0, 15.0)
    """Strengths of the turbulence, D / r0."""
    seeds: tuple[int, ...] = (0, 1)
    """Of the turbulence and the noise."""
    views: int = 2
    """How many of the two views of the packaged satellite are scenes: 0, 1 or 2."""
    scenes: tuple[Path, ...] = ()
    """Further scenes: meshes (.obj, .stl, .ply, .glb ...) or images (.npz, .png, .fits)."""
    n_frames: int = 10
    """Short exposures, T."""
    n_pixels: int = 96
    """Of the image, per side."""
    iterations: int = 600
    """At most, of every restoration."""
    restarts: int = 1
    """Restorations of the full pupil."""
    mask: Path | None = None
    """A mask to use (.json, .dxf or .fits); None: the best that a search finds."""
    n_subapertures: int = 11
    """Holes of the mask that is searched."""
    fill_factor: float = 0.15
    """Its collecting area N d^2 / D^2."""
    budget: int = 20_000
    """Evaluations of the search."""
    readout_noise: float = 1.5
    """Electrons rms per pixel and frame."""
    outer_scale: float = 20.0
    """Of the turbulence, in units of D."""
    workers: int | None = None
    """Processes at a time; None: one per core."""
    backend: Literal["loky", "ray"] = "loky"
    """This machine or a Ray cluster."""
    full: bool = False
    """The whole grid, for hours on many cores."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""
    sweep: Path = Path("runs/sweep")
    """Where the search and all restorations are kept, to go on after an interruption."""


def with_presets(config: Config) -> Config:
    """The config that runs: `full` and `smoke` replace what they stand for."""
    if config.full and config.smoke:
        raise ValueError("full and smoke are both given: choose one")
    if config.full:
        whole = {"photons": (1e4, 1e5, 1e6, 1e7, 1e8), "d_over_r0": (3.0, 5.0, 7.0, 10.0, 15.0)}
        whole |= {"seeds": (0, 1, 2, 3, 4), "n_frames": 20, "n_pixels": 128, "iterations": 1000, "restarts": 2}
        config = dataclasses.replace(config, **whole)
    if config.smoke:
        tiny: dict[str, Any] = {"photons": (1e5, 1e6), "d_over_r0": (3.0,), "seeds": (0, 1), "views": 1, "n_frames": 2}
        tiny |= {"n_pixels": 48, "iterations": 8, "n_subapertures": 5, "budget": 200}
        config = dataclasses.replace(config, **tiny)
    _check(config)
    return config


def _check(config: Config) -> None:
    for name in ("photons", "d_over_r0", "seeds"):
        values = getattr(config, name)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{name} is {values}: it must hold at least one value, and none twice")
    for name in ("n_frames", "iterations", "restarts"):
        if getattr(config, name) < 1:
            raise ValueError(f"{name} is {getattr(config, name)}: it must be at least 1")
    if config.restarts > config.n_frames:
        raise ValueError(f"restarts is {config.restarts}: {config.n_frames} frames have no more starts than that")
    if not 0 <= config.views <= len(VIEWS) or not (config.views or config.scenes):
        raise ValueError(f"views is {config.views}: it must be 0 to {len(VIEWS)}, and 0 only with other scenes")
    names = [path.name for path in config.scenes]
    if len(set(names)) < len(names):
        raise ValueError(f"scenes are named {', '.join(names)}: give each file a name of its own")


class RecordedTurbulence(TurbulencePhase):
    """Turbulence that keeps the aberrations it draws: `coefficients` (T, N, J) of the aperture's own modes [rad]."""

    def __init__(self, r0: float, outer_scale: float, aperture: Aperture, n_modes: int) -> None:
        super().__init__(r0, outer_scale)
        self.aperture, self.n_modes = aperture, n_modes
        self.coefficients: Tensor | None = None

    def forward(self, samples: PupilSamples, n_frames: int, generator: torch.Generator | None = None) -> Tensor:
        phase = super().forward(samples, n_frames, generator)
        basis = zernike_basis(samples, self.aperture, self.n_modes)
        root = samples.weights.sqrt()[..., None]
        # Weighted least squares: phases of all frames are the columns.
        fit = torch.linalg.lstsq(root * basis, root * phase.permute(1, 2, 0), driver="gelsd").solution
        self.coefficients = fit.permute(2, 0, 1).contiguous()
        return phase


def instrument(task: Mapping[str, Any]) -> Aperture:
    """The mask, or the full pupil that reaches as far."""
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
    turbulence = RecordedTurbulence(
        DIAMETER / task["d_over_r0"], task["outer_scale"] * DIAMETER, aperture, TRUE_MODES[task["instrument"]]
    )
    generator = torch.Generator().manual_seed(task["seed"])
    detector = Detector(task["readout_noise"])
    observation = simulate_observation(scene, aperture, grid, turbulence, detector, task["n_frames"], generator)
    assert turbulence.coefficients is not None
    return observation, turbulence.coefficients


def measure(task: dict[str, Any]) -> dict[str, Any]:
    """The task of one restoration: `start` counts the starts of a myopic one, "truth" gives it the aberrations.

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


def choose_mask(config: Config, progress: Progress) -> SparseAperture:
    """The mask of --mask, or the one that a search finds for the reference case."""
    if config.mask is not None:
        mask = load_mask(config.mask)
        if mask.shape != "disc" or not math.isclose(mask.mask_diameter, DIAMETER, rel_tol=1e-6):
            raise ValueError(
                f"{config.mask} has {mask.shape} holes in {mask.mask_diameter:g} m: discs in {DIAMETER:g} m are needed"
            )
        return mask
    space = DesignSpace(
        n_subapertures=(config.n_subapertures,),
        fill_factor=(config.fill_factor,),
        reference_fill_factor=config.fill_factor,
        diameter_over_r0=(),
        n_pixels=64 if config.smoke else 256,
        budget=config.budget,
    )
    table = design_table(space, config.sweep, backend=config.backend, n_workers=config.workers, callback=progress)
    return table.aperture(table.rows[0])


def scenes(config: Config) -> dict[str, dict[str, Any]]:
    """Names of the scenes and what they are; a file counts by its content."""
    found: dict[str, dict[str, Any]] = {
        name: {"path": None, "attitude": attitude} for name, attitude in list(VIEWS.items())[: config.views]
    }
    for path in config.scenes:
        if not path.is_file():
            raise ValueError(f"there is no scene {path}")
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        found[path.name] = {"path": str(path), "attitude": None, "sha256": digest}
    return found


def sweep(config: Config, mask: SparseAperture, progress: Progress) -> list[dict[str, Any]]:
    """One row per draw (scene, seed, photons, D/r0) and instrument."""
    common = {name: getattr(config, name) for name in ("n_frames", "n_pixels", "iterations", "readout_noise")}
    common |= {"outer_scale": config.outer_scale, "torchmask": version("torchmask")}
    common |= {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter}
    rows, tasks = [], []
    draws = itertools.product(config.d_over_r0, config.photons, scenes(config).items(), config.seeds, INSTRUMENTS)
    for strength, photons, (name, scene), seed, which in draws:
        draw = {"instrument": which, "n_photons": photons, "d_over_r0": strength, "seed": seed}
        rows.append(draw | {"scene": name})
        starts = ["truth", *range(config.restarts if which == "full" else 1)]
        tasks.append([common | draw | {"scene": scene, "start": start} for start in starts])
    results = iter(
        run_tasks(
            measure,
            list(itertools.chain(*tasks)),
            config.sweep / "tasks",
            stage="mask_vs_full",
            backend=config.backend,
            n_workers=config.workers,
            callback=progress,
        )
    )
    for row, own in zip(rows, tasks, strict=True):
        floor, *starts = (next(results) for _ in own)
        best = min(starts, key=lambda result: result["chi_square"])  # all that an observer could choose by
        row |= best | {"floor": floor["score"], "scores_of_starts": [start["score"] for start in starts]}
    return rows


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One row per D/r0 and photons: geometric means over draws, and the paired ratio mask / full.

    The interval is Student's, of the mean logarithm; `verdict` is the instrument it leaves no doubt about, if any.
    """
    cells = []
    for strength, photons in dict.fromkeys((row["d_over_r0"], row["n_photons"]) for row in rows):
        own = [row for row in rows if (row["d_over_r0"], row["n_photons"]) == (strength, photons)]
        cell: dict[str, Any] = {"d_over_r0": strength, "n_photons": photons}
        logs = {}
        for which in INSTRUMENTS:
            for key in ("score", "floor", "mean_frame"):
                logs[key, which] = np.log([row[key] for row in own if row["instrument"] == which])
                cell[f"{which}_{key}"] = float(np.exp(logs[key, which].mean()))
            cell[f"{which}_blindness"] = cell[f"{which}_score"] / cell[f"{which}_floor"]
            cell[f"{which}_low"], cell[f"{which}_high"] = interval(logs["score", which], 0.683)
        paired = logs["score", "mask"] - logs["score", "full"]
        low, high = interval(paired, CONFIDENCE)
        cell |= {"ratio": float(np.exp(paired.mean())), "ratio_low": low, "ratio_high": high, "n_draws": len(paired)}
        cell["floor_ratio"] = cell["mask_floor"] / cell["full_floor"]
        cell["verdict"] = "mask" if high < 1 else "full" if low > 1 else None
        cells.append(cell)
    return cells


def interval(logs: np.ndarray, confidence: float) -> tuple[float, float]:
    """Student's interval of the mean of logarithms, as a factor; unlimited for a single draw."""
    if len(logs) < 2:
        return 0.0, math.inf
    reach = student.ppf((1 + confidence) / 2, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
    return float(np.exp(logs.mean() - reach)), float(np.exp(logs.mean() + reach))


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """Where the mask wins, where not, and why, in sentences made from the numbers."""
    lines = []
    for cell in cells:
        verdict = {
            "mask": "the mask wins",
            "full": "the full pupil wins",
            None: "undecided" if cell["n_draws"] > 1 else "undecided (one draw)",
        }[cell["verdict"]]
        reach = "" if cell["n_draws"] < 2 else f", {cell['ratio_low']:.2f} to {cell['ratio_high']:.2f}"
        ahead = "mask" if cell["floor_ratio"] < 1 else "full pupil"
        lines.append(
            f"D/r0 = {cell['d_over_r0']:g}, {cell['n_photons']:.0e} photons: {verdict}. Score mask / full "
            f"{cell['ratio']:.2f} ({cell['n_draws']} draws{reach}). With the true aberrations the {ahead} is ahead "
            f"({cell['floor_ratio']:.2f}); not knowing them costs the mask a factor {cell['mask_blindness']:.2f}, the "
            f"full pupil {cell['full_blindness']:.2f}."
        )
    count = {key: sum(cell["verdict"] == key for cell in cells) for key in ("mask", "full", None)}
    lines.append(
        f"Of {len(cells)} settings, the mask wins {count['mask']}, the full pupil {count['full']}, and {count[None]} "
        f"are undecided at {100 * CONFIDENCE:g} % confidence."
    )
    return lines


def markdown(config: Config, mask: SparseAperture, cells: Sequence[Mapping[str, Any]]) -> str:
    """The numbers, for readers."""
    n_scenes, light = len(scenes(config)), FullAperture(mask.extent).area / mask.area
    kept = f"Of {config.restarts} restorations of the full pupil the lowest chi-square is kept. "
    lines = [
        "# Mask against full pupil",
        "",
        f"{mask.n_subapertures} holes, fill factor {mask.fill_factor:.3g}; the full pupil reaches as far and gets "
        f"{light:.2f} times the photons. {config.n_frames} frames of {config.n_pixels} x {config.n_pixels} pixels, "
        f"{config.readout_noise:g} electrons of read-out noise, outer scale {config.outer_scale:g} D, {n_scenes} "
        f"scenes, {len(config.seeds)} seeds. At most {config.iterations} iterations. "
        f"{kept if config.restarts > 1 else ''}Scores are relative errors up to the diffraction limit, geometric "
        "means over draws; the floor knows the true aberrations; the ratio is paired, with its interval at "
        f"{100 * CONFIDENCE:g} %.",
        "",
        *(f"- {line}" for line in findings(cells)),
        "",
        "| D/r0 | photons | mask | full | mask / full | interval | mask's floor | full's floor | mean frame, mask | "
        "mean frame, full |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for cell in cells:
        values = [cell["mask_score"], cell["full_score"], cell["ratio"]]
        rest = [cell[key] for key in ("mask_floor", "full_floor", "mask_mean_frame", "full_mean_frame")]
        lines.append(
            f"| {cell['d_over_r0']:g} | {cell['n_photons']:.0e} | "
            + " | ".join(f"{value:.3f}" for value in values)
            + f" | {cell['ratio_low']:.2f} to {cell['ratio_high']:.2f} | "
            + " | ".join(f"{value:.3f}" for value in rest)
            + " |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Scores against photons, one column per strength of turbulence, and the ratio below."""
    from matplotlib.ticker import LogLocator, NullLocator

    strengths = list(dict.fromkeys(cell["d_over_r0"] for cell in cells))
    sheet = new_figure(1.2 + 2.7 * len(strengths), 5.4)
    axes = sheet.subplots(2, len(strengths), sharex=True, sharey="row", squeeze=False, height_ratios=[1.5, 1])
    for strength, (top, bottom) in zip(strengths, axes.T, strict=True):
        panel(top, bottom, [cell for cell in cells if cell["d_over_r0"] == strength])
        top.set(title=f"D/r$_0$ = {strength:g}", xscale="log", yscale="log")
        bottom.set(yscale="log", xlabel="photons per frame through the mask")
    for ax in axes[:, 0]:
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_locator(NullLocator())
    # The row shares one axis, which must hold the bars of all its panels.
    seen = [cell[key] for cell in cells for key in ("ratio", "ratio_low", "ratio_high") if 0 < cell[key] < math.inf]
    axes[1, 0].set_ylim(0.8 * min([*seen, 1.0]), 1.25 * max([*seen, 1.0]))
    axes[0, 0].set_ylabel("score (0 is perfect)")
    axes[1, 0].set_ylabel("score, mask / full pupil")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    sheet.legend(handles, labels, loc="outside upper left", ncols=min(4, 2 * len(strengths)))
    return sheet


def panel(top: Axes, bottom: Axes, cells: Sequence[Mapping[str, Any]]) -> None:
    """One strength of turbulence: scores and floors above, the paired ratio below."""
    photons = [cell["n_photons"] for cell in cells]
    style: dict[str, Any] = {"markersize": 4, "capsize": 2, "linewidth": 1.2}
    for (which, label), color, marker in zip(INSTRUMENTS.items(), COLORS, "os", strict=False):
        values = np.array([cell[f"{which}_score"] for cell in cells])
        bars = _bars(values, [cell[f"{which}_low"] for cell in cells], [cell[f"{which}_high"] for cell in cells])
        top.errorbar(photons, values, bars, color=color, marker=marker, label=label, **style)
        floors = [cell[f"{which}_floor"] for cell in cells]
        top.plot(photons, floors, "--", color=color, linewidth=0.9, label=f"{label}, true aberrations")
    ratio = np.array([cell["ratio"] for cell in cells])
    bars = _bars(ratio, [cell["ratio_low"] for cell in cells], [cell["ratio_high"] for cell in cells])
    bottom.axhspan(1e-9, 1, color=COLORS[0], alpha=0.07, linewidth=0)
    bottom.axhline(1, color=FAINT, linewidth=0.8)
    bottom.errorbar(photons, ratio, bars, color="#222222", marker="o", **style)
    bottom.text(0.03, 0.04, "the mask wins", color=COLORS[0], fontsize=7, transform=bottom.transAxes)


def _bars(values: np.ndarray, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Lengths of error bars; none where an interval is unlimited."""
    lengths = np.array([values - np.array(low), np.array(high) - values])
    return np.where(np.isfinite(high), lengths, 0.0)


def run(config: Config, directory: Path, progress: Progress) -> list[str]:
    """Search, restore, compare, and write everything to `directory`; returns the findings."""
    scenes(config)  # a missing file is told before any work
    mask = choose_mask(config, progress)
    rows = sweep(config, mask, progress)
    cells = summarise(rows)
    directory.mkdir(parents=True)
    write_json(
        directory / "mask_vs_full.json",
        {
            "config": config,
            "torchmask": version("torchmask"),
            "mask": {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter},
            "findings": findings(cells),
            "cells": cells,
            "rows": rows,
        },
    )
    with atomic_write(directory / "mask_vs_full.md") as file:
        file.write(markdown(config, mask, cells).encode())
    with atomic_write(directory / "mask_vs_full.png") as file:
        figure(cells).savefig(file, format="png", dpi=150)
    return findings(cells)


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("mask_vs_full-%Y%m%d-%H%M%S"))
    try:
        config = with_presets(config)
        if directory.exists():
            raise ValueError(f"{directory} exists and is not overwritten: choose another --name")
        if directory.resolve() in (config.sweep.resolve(), *config.sweep.resolve().parents):
            raise ValueError(f"--sweep {config.sweep} lies in the folder of this run: keep restorations elsewhere")
        with Progress() as progress:
            lines = run(config, directory, progress)
    except KeyboardInterrupt:
        print(f"\ninterrupted: call again with --sweep {config.sweep} to go on", file=sys.stderr)
        return 130
    except ValueError as error:
        print(f"mask_vs_full: {error}", file=sys.stderr)
        return 2
    print(*lines, f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
