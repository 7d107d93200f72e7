"""What `anisoplanatism`, `exposure`, `band` and `rival_modes` share.

One restoration under given conditions, and means over seeds.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from mask_vs_full import choose_mask, instrument
from mask_vs_full_options import DIAMETER, WAVELENGTH, MaskSearchOptions
from mask_vs_full_report import INSTRUMENTS, interval

import torchmask
from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase
from torchmask.design.sweep import run_tasks
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback
from torchmask.restoration.background import Background
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.schedule import Schedule
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene
from torchmask.viz.style import COLORS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

WIND = 10.0  # [m/s]; only the exposure over tau0 matters
SIZE = 0.5  # of the scene over the field of view
_MEAN = 0.683  # confidence of the bars: one standard error


@dataclass(frozen=True, kw_only=True)
class ObservingOptions(MaskSearchOptions):
    """Options of the restorations."""

    budget: int = 3000
    """Number of evaluations of the search."""
    instruments: tuple[str, ...] = ("mask", "full")
    """Instruments to compare, of mask and full; the full pupil reaches the same frequencies, with light by area."""
    d_over_r0: float = 4.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence, in units of D."""
    n_photons: float = 1e6
    """Electrons per frame through the mask; with `exposure` in tau0, with `band` in 10 percent of the wavelength."""
    readout_noise: float = 1.5
    """Read-out noise [electrons rms per pixel and frame]."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the turbulence and the noise."""
    n_frames: int = 8
    """Number of short exposures."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""
    iterations: int = 4000
    """Maximum number of iterations of a restoration."""


def smoke(options: Any, **few: Any) -> Any:
    """Return the options of a run that only shows that it runs."""
    tiny: dict[str, Any] = {"seeds": (0, 1), "n_frames": 2, "n_pixels": 32, "iterations": 4}
    tiny |= {"n_subapertures": 5, "budget": 200, "d_over_r0": 3.0, "instruments": ("mask",)}
    return dataclasses.replace(options, **tiny, **few)


def check(options: ObservingOptions, **swept: Sequence[float]) -> None:
    """Raise ValueError for what could not be simulated or restored, before any work."""
    for name, values in {**swept, "seeds": options.seeds, "instruments": options.instruments}.items():
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{name} is {values}: it must hold at least one value, and none twice")
    for name, values in swept.items():
        if not all(value > 0 for value in values):
            raise ValueError(f"{name} is {values}: all values must be positive")
    if not set(options.instruments) <= set(INSTRUMENTS):
        raise ValueError(f"instruments is {options.instruments}: known ones are {', '.join(INSTRUMENTS)}")
    for name in ("d_over_r0", "outer_scale", "n_photons", "n_frames", "iterations", "budget"):
        if not getattr(options, name) > 0:
            raise ValueError(f"{name} is {getattr(options, name)}: it must be positive")
    Detector(options.readout_noise)
    size = hole_diameter(options.n_subapertures, DIAMETER, options.fill_factor)
    hole = SparseAperture(torch.zeros(1, 2, dtype=torch.float64), size, DIAMETER)
    MyopicDeconvolution(hole, Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels))


def measure(task: Mapping[str, Any]) -> dict[str, Any]:
    """Simulate under the conditions of the task, restore by the library's defaults, and score.

    A task may say `layers` (heights [m] and their shares of the turbulence), `exposure` [tau0] and `band` [width over
    wavelength], of `n_simulated` wavelengths. The restoration is told the band, as `n_told` wavelengths; the rest it
    must bear. With `modes` it is the method as first published, with so many modes for each hole, or of the full pupil.
    """
    aperture, mask = instrument(task), instrument({**task, "instrument": "mask"})
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"], task.get("oversampling", 1.0))
    scene = make_scene(grid.shape, task["n_photons"] * aperture.area / mask.area, SceneOptions(size=SIZE))
    heights, shares = task.get("layers", ((0.0,), (1.0,)))
    r0 = DIAMETER / task["d_over_r0"]
    layers = Layers.from_fractions(r0, WAVELENGTH, heights, shares, [(WIND, 0.0)] * len(heights))
    width = task.get("band", 0.0) * WAVELENGTH
    conditions = Conditions(
        exposure_time=task.get("exposure", 0.0) * layers.tau0(WAVELENGTH),
        band=Band.top_hat(WAVELENGTH, width, task["n_simulated"]) if width else None,
    )
    observation = simulate_observation(
        *(scene, aperture, grid, LayeredPhase(layers, WAVELENGTH, task["outer_scale"] * DIAMETER)),
        *(Detector(task["readout_noise"]), task["n_frames"], torch.Generator().manual_seed(task["seed"])),
        conditions=conditions,
    )
    told = Band.top_hat(WAVELENGTH, width, task["n_told"]) if width else Band.of([WAVELENGTH])
    published = {"aberration_prior": False, "background": Background.NONE, "schedule": Schedule.plain()}
    method = MyopicDeconvolution(
        *(aperture, grid, task.get("modes")),
        **{"wavelengths": told.wavelengths, "weights": told.shares, "max_iterations": task["iterations"]},
        **(published if "modes" in task else {}),
    )
    result = method.restore(observation.frames)
    return {"score": relative_error(result.object, scene, grid.cutoff(DIAMETER)), "seconds": result.seconds}


def observe(
    options: ObservingOptions, stage: str, settings: Iterable[Mapping[str, Any]], callback: Callback
) -> list[dict[str, Any]]:
    """Return a row with `score` and `seconds` for each of the settings, instrument and seed, with one mask for all."""
    common = shared(options, callback)
    draws = [
        {**setting, "instrument": which, "seed": seed}
        for setting, which, seed in itertools.product(settings, options.instruments, options.seeds)
    ]
    results = run_tasks(
        measure, [common | draw for draw in draws], options.sweep / "tasks", stage=stage, **options.keywords(callback)
    )
    return [draw | dict(result) for draw, result in zip(draws, results, strict=True)]


def shared(options: ObservingOptions, callback: Callback) -> dict[str, Any]:
    """Return what all tasks share, with the mask."""
    mask = choose_mask(options, callback)
    names = ("d_over_r0", "outer_scale", "n_photons", "readout_noise", "n_frames", "n_pixels", "iterations")
    common = {name: getattr(options, name) for name in names} | {"torchmask": torchmask.__version__}
    return common | {"centers": mask.centers.tolist(), "subaperture_diameter": mask.subaperture_diameter}


def scores(rows: Sequence[Mapping[str, Any]], reference: Sequence[Mapping[str, Any]] = ()) -> dict[str, float]:
    """Geometric mean over the seeds with its standard error as an interval, and the paired ratio to a reference.

    The reference has the same seeds in the same order.
    """
    logs = np.log([row["score"] for row in rows])
    low, high = interval(logs, _MEAN)
    cell = {"score": float(np.exp(logs.mean())), "low": low, "high": high}
    if reference:
        paired = logs - np.log([row["score"] for row in reference])
        low, high = interval(paired, _MEAN)
        cell |= {"ratio": float(np.exp(paired.mean())), "ratio_low": low, "ratio_high": high}
    return cell


def optimum(cells: Sequence[Mapping[str, Any]], key: str) -> str:
    """Return where the score is best, and which other values are not told from it by their error bars."""
    best = min(cells, key=lambda cell: cell["score"])
    rivals = [f"{cell[key]:g}" for cell in cells if cell is not best and cell["low"] <= best["high"]]
    return f"{best[key]:g}" + (f" (not told from {', '.join(rivals)})" if rivals else "")


def setting_of(options: ObservingOptions) -> str:
    """Return a sentence on what all rows share."""
    return (
        f"{'A given mask' if options.mask else f'A mask of {options.n_subapertures} holes'}; a full pupil reaches as "
        f"far and gets the light of its area. D/r0 = {options.d_over_r0:g}, outer scale "
        f"{options.outer_scale:g} D, {options.n_photons:.0e} electrons per frame through the mask, "
        f"{options.readout_noise:g} electrons of read-out noise, {options.n_frames} frames of {options.n_pixels} x "
        f"{options.n_pixels} pixels, {len(options.seeds)} seeds, at most {options.iterations} iterations. Scores are "
        "relative errors up to the diffraction limit, geometric means over the seeds; intervals are one standard error."
    )


def table(cells: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> list[str]:
    """Lines of Markdown: the given columns of each cell, the score and its interval."""
    lines = [f"| {' | '.join(columns.values())} | instrument | score | interval |", "|---" * (len(columns) + 3) + "|"]
    for cell in cells:
        values = ["-" if cell[key] is None else f"{cell[key]:.3g}" for key in columns]
        values += [INSTRUMENTS[cell["instrument"]], f"{cell['score']:.3f}", f"{cell['low']:.3f} to {cell['high']:.3f}"]
        lines.append(f"| {' | '.join(values)} |")
    return lines


def page(
    options: ObservingOptions,
    title: str,
    found: Sequence[str],
    cells: Sequence[Mapping[str, Any]],
    columns: Mapping[str, str],
    note: str = "",
) -> str:
    """Return a page of Markdown: what all rows share, what was found, and the table."""
    lines = [f"# {title}", "", setting_of(options), *([note] if note else []), ""]
    lines += [*(f"- {line}" for line in found), "", *table(cells, columns)]
    return "\n".join(lines) + "\n"


def curves(ax: Axes, cells: Sequence[Mapping[str, Any]], key: str, value: str = "score") -> None:
    """Draw one line with error bars for each instrument."""
    ends = ("low", "high") if value == "score" else (f"{value}_low", f"{value}_high")
    for (which, label), color, marker in zip(INSTRUMENTS.items(), COLORS, "os", strict=False):
        own = [cell for cell in cells if cell["instrument"] == which]
        if own:
            x, y, low, high = (np.array([cell[name] for cell in own]) for name in (key, value, *ends))
            bars = np.where(np.isfinite(high), [y - low, high - y], 0.0)
            ax.errorbar(x, y, bars, color=color, marker=marker, markersize=4, capsize=2, linewidth=1.2, label=label)
