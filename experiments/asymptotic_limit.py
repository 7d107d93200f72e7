"""How fast the Wiener MSE of K short exposures falls to MSE_a, its limit for many, by Monte Carlo.

    python experiments/asymptotic_limit.py                       # Golay-6 and a mask of 11 holes, K = 1 to 100
    python experiments/asymptotic_limit.py --d-over-r0 3         # other turbulence
    python experiments/asymptotic_limit.py --smoke               # everything, tiny, in seconds

Two models of the exposures: an independent uniform piston on each hole, as MSE_a assumes, with OTFs in closed form; and
full von Karman screens, with all that they do inside the holes and all that neighbouring holes share. In the piston
model the mean MSE is never below MSE_a (Jensen). The picture and the numbers go to a new folder, runs/<name>/; the
draws are kept in --sweep, one file for each batch, so that a run that was stopped goes on.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import scipy.sparse
import torch
import tyro

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.design.criterion import AsymptoticMSE, wiener_mse
from torchmask.design.space import DesignSpace
from torchmask.design.sweep import run_tasks
from torchmask.design.table import design_table
from torchmask.grid import Grid
from torchmask.io import atomic_write, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import OTF, subaperture_otf
from torchmask.progress import Progress
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIAMETER = 1.0  # of the masks [m]: nothing here depends on it but r0 and the outer scale
WAVELENGTH = 550e-9
MODELS = {"pistons": "random pistons", "von_karman": "von Karman screens"}
_GROUPS = 10  # sets of K exposures taken from one stack, at most
_FRAMES = 20  # OTFs held in memory


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    frames: tuple[int, ...] = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)
    """Numbers of exposures K."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Of the turbulence, in units of D."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    n_photons: float = 1e7
    """Per exposure."""
    exponent: float = 1.5
    """Of the power-law power spectrum of the object."""
    n_pixels: int = 256
    """Of the image, per side."""
    oversampling: int = 2
    """Of the pupil under von Karman screens; the numbers say what error it leaves."""
    n_subapertures: int = 11
    """Holes of the mask that is searched, beside Golay-6."""
    budget: int = 20_000
    """Evaluations of that search."""
    piston_stacks: int = 200
    """Stacks of max(K) exposures drawn with random pistons."""
    screen_stacks: int = 20
    """Stacks drawn with von Karman screens."""
    seed: int = 0
    """Of the search and the draws."""
    workers: int | None = None
    """Processes at a time; None: one per core."""
    backend: Literal["loky", "ray"] = "loky"
    """This machine or a Ray cluster."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""
    sweep: Path = Path("runs/sweep")
    """Where searches and draws are kept, to go on after an interruption."""


def tiny(config: Config) -> Config:
    """What --smoke stands for."""
    small = {"frames": (1, 2, 4), "n_pixels": 64, "n_subapertures": 4, "budget": 200}
    return dataclasses.replace(config, **small, piston_stacks=4, screen_stacks=4)


class PistonOTFs:
    """|OTF|^2 of a mask for any pistons, in closed form: the overlaps of all pairs of holes, computed once."""

    def __init__(self, mask: SparseAperture, grid: Grid) -> None:
        n = mask.n_subapertures
        nu_y, nu_x = grid.frequencies(torch.float64)
        self.first, self.second = torch.nonzero(~torch.eye(n, dtype=torch.bool), as_tuple=True)
        columns = []
        for baseline in [torch.zeros(2), *((mask.centers[self.first] - mask.centers[self.second]) / grid.period)]:
            dx, dy = nu_x - baseline[0], nu_y - baseline[1]
            shift = torch.stack(torch.broadcast_tensors(dx - dx.round(), dy - dy.round()), dim=-1)
            columns.append(scipy.sparse.csc_array(subaperture_otf(shift * grid.period, mask).reshape(-1, 1).numpy()))
        self.alone = columns[0].toarray()
        self.pairs = scipy.sparse.hstack(columns[1:]).tocsr() / n
        self.shape = grid.shape

    def power(self, pistons: torch.Tensor) -> torch.Tensor:
        """|h|^2 (F, H, W) for pistons (F, N) [rad]."""
        delta = (pistons[:, self.second] - pistons[:, self.first]).T.numpy()
        power = (self.alone + self.pairs @ np.cos(delta)) ** 2 + (self.pairs @ np.sin(delta)) ** 2
        return torch.from_numpy(power.T).unflatten(1, self.shape)


def uniform_pistons(n_frames: int, n: int, generator: torch.Generator) -> torch.Tensor:
    """(F, N) [rad]."""
    return 2 * math.pi * torch.rand(n_frames, n, dtype=torch.float64, generator=generator)


def criterion(task: dict[str, Any], n_frames: int) -> AsymptoticMSE:
    """MSE_a for K exposures."""
    photons = task["n_photons"]
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    return AsymptoticMSE(grid, PowerLawPSD(task["exponent"], photons), NoisePSD(photons), n_frames)


def draw(task: dict[str, Any]) -> dict[str, Any]:
    """Some stacks of exposures: for each K the relative Wiener MSE of independent sets of K of them."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    limit = criterion(task, 1)
    generator = torch.Generator().manual_seed(task["seed"])
    n_frames = max(task["frames"])
    if task["model"] == "pistons":
        closed = PistonOTFs(mask, limit.grid)
    else:
        otf = OTF(mask, limit.grid, task["oversampling"])
        samples = otf.samples()
        turbulence = TurbulencePhase(DIAMETER / task["d_over_r0"], task["outer_scale"])
    values: dict[int, list[float]] = {k: [] for k in task["frames"]}
    for _ in range(task["n_stacks"]):
        if task["model"] == "pistons":
            power = closed.power(uniform_pistons(n_frames, mask.n_subapertures, generator))
        else:
            chunks = [min(_FRAMES, n_frames - first) for first in range(0, n_frames, _FRAMES)]
            power = torch.cat([otf(turbulence(samples, chunk, generator)).abs() ** 2 for chunk in chunks])
        for k, found in values.items():
            sets = min(n_frames // k, _GROUPS)
            summed = power[: sets * k].unflatten(0, (sets, k)).sum(1)
            # The error depends on the sum of |h_k|^2 alone: one OTF with that square stands for K.
            errors = wiener_mse(summed.sqrt()[:, None], limit.object_psd, limit.noise_psd)
            found += (errors / limit.object_psd.mean()).tolist()
    return {"mean": float(np.mean(values[n_frames])), "values": values}


def sampling_error(task: dict[str, Any]) -> float:
    """By how much the sampled pupil changes the Wiener MSE of 20 exposures: relative, the same pistons in both."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    limit = criterion(task, 1)
    pistons = uniform_pistons(_FRAMES, mask.n_subapertures, torch.Generator().manual_seed(task["seed"]))
    exact = PistonOTFs(mask, limit.grid).power(pistons).sqrt()
    otf = OTF(mask, limit.grid, task["oversampling"])
    sampled = otf(pistons[..., None].expand(-1, -1, otf.samples().weights.shape[-1]))
    psds = (limit.object_psd, limit.noise_psd)
    return float(wiener_mse(sampled, *psds) / wiener_mse(exact, *psds)) - 1


def masks(config: Config, options: dict[str, Any]) -> dict[str, SparseAperture]:
    """Golay-6 and a mask of this library's own."""
    space = DesignSpace(
        n_subapertures=(config.n_subapertures,),
        fill_factor=(config.fill_factor,),
        n_photons=(config.n_photons,),
        reference_fill_factor=config.fill_factor,
        diameter_over_r0=(),
        seed=(config.seed,),
        n_pixels=config.n_pixels,
        exponent=config.exponent,
        budget=config.budget,
    )
    table = design_table(space, config.sweep, **options)
    own = table.aperture(table.rows[0])
    return {
        "Golay-6": SparseAperture.from_catalog("golay6", DIAMETER, config.fill_factor),
        f"N = {config.n_subapertures}": own,
    }


def tasks(config: Config, mask: SparseAperture) -> list[dict[str, Any]]:
    """The draws of both models for one mask, in batches of about equal time."""
    shared = ("frames", "n_photons", "exponent", "n_pixels", "oversampling", "d_over_r0")
    common = {name: getattr(config, name) for name in shared} | {
        "centers": mask.centers.tolist(),
        "subaperture_diameter": mask.subaperture_diameter,
        "outer_scale": config.outer_scale * DIAMETER,
    }
    batches = []
    for model, total, size in (("pistons", config.piston_stacks, 10), ("von_karman", config.screen_stacks, 2)):
        for first in range(0, total, size):
            seed = int(np.random.SeedSequence([config.seed, first]).generate_state(1)[0])
            batches.append(common | {"model": model, "n_stacks": min(size, total - first), "seed": seed})
    return batches


def run(config: Config, progress: Progress) -> list[dict[str, Any]]:
    """A row for each mask, model and K: MSE_a, the mean of the draws and its standard error, both relative."""
    options: dict[str, Any] = {"backend": config.backend, "n_workers": config.workers, "callback": progress}
    batches = {name: tasks(config, mask) for name, mask in masks(config, options).items()}
    flat = [(name, task) for name, own in batches.items() for task in own]
    results = run_tasks(draw, [task for _, task in flat], config.sweep / "tasks", stage="asymptotic_limit", **options)
    rows = []
    for name, own in batches.items():
        mask = SparseAperture(own[0]["centers"], own[0]["subaperture_diameter"], DIAMETER)
        bias = sampling_error(own[0])
        for model in MODELS:
            drawn = [r["values"] for (n, t), r in zip(flat, results, strict=True) if (n, t["model"]) == (name, model)]
            for k in config.frames:
                values = np.concatenate([batch[str(k)] for batch in drawn])
                limit = float(criterion(own[0], k).relative(mask))
                error = values.std(ddof=1) / math.sqrt(len(values))
                row = {"mask": name, "model": model, "n_frames": k, "mse_a": limit, "wiener_mse": values.mean()}
                row |= {"standard_error": error, "ratio": values.mean() / limit, "ratio_error": error / limit}
                row |= {"n_draws": len(values), "sampling_error": 0.0 if model == "pistons" else bias}
                rows.append(row)
    return rows


def findings(config: Config, rows: Sequence[dict[str, Any]]) -> list[str]:
    """What the numbers say, in sentences."""
    pistons = [row for row in rows if row["model"] == "pistons"]
    worst = min(pistons, key=lambda row: (row["ratio"] - 1) / row["ratio_error"])
    sigmas = (worst["ratio"] - 1) / worst["ratio_error"]
    verdict = "never below 1 within its error" if sigmas > -3 else "BELOW 1 BY MORE THAN ITS ERROR"
    lines = [
        f"Random pistons: the ratio is {verdict} (Jensen); nearest at {worst['mask']}, K = {worst['n_frames']}: "
        f"{worst['ratio']:.6f} ± {worst['ratio_error']:.6f} ({sigmas:+.1f} standard errors from 1)."
    ]
    for row in pistons:
        if row["n_frames"] in (min(config.frames), 10, max(config.frames)):
            lines.append(
                f"Random pistons, {row['mask']}, K = {row['n_frames']}: {row['ratio']:.6f} ± {row['ratio_error']:.6f}."
            )
    for name in dict.fromkeys(row["mask"] for row in rows):
        screens = [row for row in rows if row["mask"] == name and row["model"] == "von_karman"]
        low, high = min(screens, key=lambda row: row["ratio"]), max(screens, key=lambda row: row["ratio"])
        sampling = round(100 * low["sampling_error"], 2) + 0.0  # no "-0.00"
        lines.append(
            f"Von Karman screens, D/r0 = {config.d_over_r0:g}, {name}: the ratio goes from {low['ratio']:.4f} at "
            f"K = {low['n_frames']} to {high['ratio']:.4f} at K = {high['n_frames']}, of which the sampling of the "
            f"pupil makes about {sampling:+.2f} %. Jensen does not bind here: these OTFs are not those of independent "
            "uniform pistons."
        )
    return lines


def markdown(config: Config, rows: Sequence[dict[str, Any]]) -> str:
    """The numbers, for readers."""
    lines = [
        "# The Wiener MSE of K exposures against its asymptotic limit",
        "",
        f"p = {config.exponent:g}, {config.n_photons:g} photons per exposure, N d^2 / D^2 = {config.fill_factor:g}, "
        f"{config.n_pixels} frequencies a side, outer scale {config.outer_scale:g} D. Relative MSE; ± is one standard "
        "error of independent draws.",
        "",
        *(f"- {line}" for line in findings(config, rows)),
        "",
        "| mask | model | K | MSE_a | Wiener MSE | ratio | draws |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['mask']} | {MODELS[row['model']]} | {row['n_frames']} | {row['mse_a']:.6f} | "
            f"{row['wiener_mse']:.6f} ± {row['standard_error']:.6f} | {row['ratio']:.6f} ± {row['ratio_error']:.6f} | "
            f"{row['n_draws']} |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(config: Config, rows: Sequence[dict[str, Any]]) -> Figure:
    """The errors against K, and by how much they exceed the limit; where they do not, there is no point below."""
    names = list(dict.fromkeys(row["mask"] for row in rows))
    sheet = new_figure(4.1 * len(names), 5.4)
    axes = sheet.subplots(2, len(names), sharex=True, squeeze=False, height_ratios=[1.2, 1])
    for name, (top, bottom) in zip(names, axes.T, strict=True):
        own = [row for row in rows if row["mask"] == name]
        panel(top, bottom, own)
        top.set(title=name, xscale="log")
    axes[0, 0].set_ylabel("relative MSE")
    axes[1, 0].set_ylabel("excess over MSE$_a$ [%]")
    axes[0, 0].legend()
    for ax in axes[1]:
        ax.set(xlabel="exposures K", yscale="log", ylim=(2e-4, 20))
        ax.axhline(0.1, color=FAINT, linewidth=0.8, zorder=0)
        ax.set_yticks([1e-3, 1e-2, 0.1, 1, 10])
        ax.yaxis.set_major_formatter("{x:g}")
        ax.set_xticks([k for k in (1, 2, 5, 10, 20, 50, 100, 200, 500) if k <= max(config.frames)])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
    sheet.suptitle(
        f"Many short exposures reach MSE$_a$ (von Karman screens: D/r$_0$ = {config.d_over_r0:g})", x=0.02, ha="left"
    )
    return sheet


def panel(top: Axes, bottom: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """One mask: MSE above, excess below."""
    for model, color, marker in zip(MODELS, COLORS, "os", strict=False):
        own = [row for row in rows if row["model"] == model]
        k = [row["n_frames"] for row in own]
        if model == "pistons":
            top.plot(k, [row["mse_a"] for row in own], color=FAINT, label="MSE$_a$")
        style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 4, "linestyle": "none", "capsize": 2}
        top.errorbar(
            k, [r["wiener_mse"] for r in own], [r["standard_error"] for r in own], label=MODELS[model], **style
        )
        style |= {"linestyle": "-", "linewidth": 0.8}
        excess = [100 * (row["ratio"] - 1) for row in own]
        bottom.errorbar(k, excess, [100 * row["ratio_error"] for row in own], **style)


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("asymptotic_limit-%Y%m%d-%H%M%S"))
    if config.smoke:
        config = tiny(config)
    try:
        if directory.exists():
            raise ValueError(f"{directory} exists and is not overwritten: choose another --name")
        with Progress() as progress:
            rows = run(config, progress)
        directory.mkdir(parents=True)
        write_json(directory / "asymptotic_limit.json", {"config": config, "rows": rows})
        with atomic_write(directory / "asymptotic_limit.md") as file:
            file.write(markdown(config, rows).encode())
        with atomic_write(directory / "asymptotic_limit.png") as file:
            figure(config, rows).savefig(file, format="png")
    except KeyboardInterrupt:
        print(f"\ninterrupted: call again with --sweep {config.sweep} to go on", file=sys.stderr)
        return 130
    except ValueError as error:
        print(f"asymptotic_limit: {error}", file=sys.stderr)
        return 2
    print(*findings(config, rows), f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
