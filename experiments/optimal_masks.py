"""The gallery of optimal masks: holes, u-v coverage and relative MSE for N = 3 to 20.

    python experiments/optimal_masks.py                                   # minutes
    python experiments/optimal_masks.py --budget 200000 --seed 0 1 2 3 4  # the best there are
    python experiments/optimal_masks.py --smoke                           # everything, tiny, in seconds

Case: D = 1 m, 550 nm, Nyquist, photon noise. The picture, the numbers and the masks themselves (JSON, for `load_mask`)
go to a new folder, runs/<name>/; the searches are kept in --sweep, one file each, so that a run that was stopped goes
on, and experiments/mse_vs_n.py shares them.
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

import tyro

from torchmask.design.manufacture import save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.space import Design, DesignSpace
from torchmask.design.table import DesignTable, design_table
from torchmask.io import atomic_write, write_json
from torchmask.optics.aperture import SparseAperture
from torchmask.progress import Progress
from torchmask.viz.style import COLORS, FAINT, INK, PALE, hole, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    n_subapertures: tuple[int, ...] = tuple(range(3, 21))
    """Numbers of holes, N."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2."""
    n_photons: float = 1e7
    """Per exposure."""
    n_frames: int = 20
    """Exposures, K."""
    exponent: float = 1.5
    """Of the power-law power spectrum of the object."""
    n_pixels: int = 256
    """Frequency grid of the criterion, per side."""
    seed: tuple[int, ...] = (0, 1)
    """Of the searches; the best is shown."""
    budget: int = 10_000
    """Evaluations of each search."""
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
    """Where searches are kept, to go on after an interruption."""


def space(config: Config) -> DesignSpace:
    """One search for each N and seed."""
    return DesignSpace(
        n_subapertures=config.n_subapertures,
        fill_factor=(config.fill_factor,),
        n_photons=(config.n_photons,),
        reference_fill_factor=config.fill_factor,
        n_frames=(config.n_frames,),
        diameter_over_r0=(),
        seed=config.seed,
        n_pixels=config.n_pixels,
        exponent=config.exponent,
        budget=config.budget,
    )


def best_of_seeds(table: DesignTable) -> list[Design]:
    """The best row of each N."""
    best: dict[int, Design] = {}
    for row in table.rows:
        if row.infeasible is not None:
            raise ValueError(f"no mask of {row.n_subapertures} holes: {row.infeasible}")
        known = best.get(row.n_subapertures)
        if known is None or error(row) < error(known):
            best[row.n_subapertures] = row
    return list(best.values())


def error(row: Design) -> float:
    """Relative MSE_a of a row that has a mask."""
    assert row.relative_mse is not None
    return row.relative_mse


def numbers(table: DesignTable) -> list[dict[str, Any]]:
    """What is written for each N."""
    rows = []
    for row in best_of_seeds(table):
        report = analyse_redundancy(table.aperture(row))
        tried = [error(other) for other in table.rows if other.n_subapertures == row.n_subapertures]
        rows.append(
            {
                "n_subapertures": row.n_subapertures,
                "relative_mse": row.relative_mse,
                "above_floor": row.above_floor,
                "scatter_of_seeds": max(tried) / min(tried) - 1,
                "seed": row.seed,
                "subaperture_diameter": row.subaperture_diameter,
                "n_baselines": report.n_baselines,
                "n_distinct": report.n_distinct,
                "uv_filling": report.uv_filling,
                "gap_fraction": report.gap_fraction,
                "fwhm": report.fwhm,
                "side_lobe": report.side_lobe,
                "centers": row.centers,
            }
        )
    return rows


def markdown(config: Config, rows: Sequence[dict[str, Any]]) -> str:
    """The numbers, for readers."""
    lines = [
        "# Optimal masks",
        "",
        f"D = 1 m, N d^2 / D^2 = {config.fill_factor:g}, p = {config.exponent:g}, {config.n_photons:g} photons, "
        f"K = {config.n_frames}, {config.n_pixels} frequencies a side; the best of {len(config.seed)} searches of "
        f"{config.budget} evaluations. `Above the floor` is what a mask can change: frequencies beyond the reach of "
        f"any mask add {rows[0]['relative_mse'] - rows[0]['above_floor']:.4f}. `Scatter`: worst over best of the "
        "searches, less 1. u-v filling and gaps: of the disc of a full pupil, and of the disc out to the highest "
        "frequency.",
        "",
        "| N | d [mm] | relative MSE | above the floor | scatter | baselines | distinct | u-v filling | gaps | "
        "FWHM [λ/D] | side lobe |",
        "|" + "---|" * 11,
    ]
    for r in rows:
        lines.append(
            f"| {r['n_subapertures']} | {1e3 * r['subaperture_diameter']:.1f} | {r['relative_mse']:.4f} | "
            f"{r['above_floor']:.4f} | {100 * r['scatter_of_seeds']:.2f} % | {r['n_baselines']} | {r['n_distinct']} | "
            f"{100 * r['uv_filling']:.1f} % | {100 * r['gap_fraction']:.1f} % | {r['fwhm']:.3f} | "
            f"{r['side_lobe']:.3f} |"
        )
    return "\n".join(lines) + "\n"


@styled
def gallery(rows: Sequence[dict[str, Any]], masks: Sequence[SparseAperture]) -> Figure:
    """Each mask above its u-v coverage."""
    columns = min(6, len(rows))
    lines = math.ceil(len(rows) / columns)
    sheet = new_figure(1.75 * columns + 0.2, 3.85 * lines + 0.5)
    axes = sheet.subplots(2 * lines, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (row, mask) in enumerate(zip(rows, masks, strict=True)):
        line, column = divmod(k, columns)
        draw_mask(axes[2 * line, column], mask)
        axes[2 * line, column].set_title(f"N = {row['n_subapertures']}", loc="center", fontweight="bold", pad=3)
        draw_coverage(axes[2 * line + 1, column], mask)
        text = f"{row['relative_mse']:.4f}\n{row['above_floor']:.4f} above floor"
        axes[2 * line + 1, column].text(0.5, -0.02, text, transform=axes[2 * line + 1, column].transAxes, **CAPTION)
    sheet.get_layout_engine().set(h_pad=0.07)  # type: ignore[union-attr]
    title = f"Optimal masks at N d²/D² = {masks[0].fill_factor:g}: holes, u-v coverage and relative MSE"
    sheet.suptitle(title, x=0.012, ha="left", fontsize=11)
    return sheet


CAPTION: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 8, "color": INK, "linespacing": 1.25}


def draw_mask(ax: Axes, mask: SparseAperture) -> None:
    """The holes in their disc."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle((0, 0), mask.mask_diameter / 2, facecolor=PALE, edgecolor=FAINT, linewidth=0.6))
    for center in mask.centers.tolist():
        ax.add_patch(hole(mask, center, 1.0, facecolor=COLORS[0], edgecolor="none"))
    half = 0.52 * mask.mask_diameter
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")


def draw_coverage(ax: Axes, mask: SparseAperture) -> None:
    """A disc of the hole's cut-off around each baseline, darker where they overlap."""
    from matplotlib.patches import Circle

    difference = (mask.centers[:, None] - mask.centers).reshape(-1, 2)
    for baseline in difference[difference.abs().sum(-1) > 0].tolist() + [[0.0, 0.0]]:
        ax.add_patch(hole(mask, baseline, 2.0, facecolor=COLORS[0], edgecolor="none", alpha=0.3))
    ax.add_patch(Circle((0, 0), mask.mask_diameter, fill=False, edgecolor=FAINT, linewidth=0.6))
    half = 1.04 * mask.mask_diameter
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("optimal_masks-%Y%m%d-%H%M%S"))
    if config.smoke:
        config = dataclasses.replace(config, n_subapertures=(3, 4, 5), n_pixels=64, budget=200)
    try:
        if directory.exists():
            raise ValueError(f"{directory} exists and is not overwritten: choose another --name")
        with Progress() as progress:
            options: dict[str, Any] = {"backend": config.backend, "n_workers": config.workers, "callback": progress}
            table = design_table(space(config), config.sweep, **options)
        rows = numbers(table)
        masks = [table.aperture(row) for row in best_of_seeds(table)]
        directory.mkdir(parents=True)
        for row, mask in zip(rows, masks, strict=True):
            save_json(directory / f"optimal_{row['n_subapertures']}.json", mask)
        write_json(directory / "optimal_masks.json", {"config": config, "rows": rows})
        with atomic_write(directory / "optimal_masks.md") as file:
            file.write(markdown(config, rows).encode())
        with atomic_write(directory / "optimal_masks.png") as file:
            gallery(rows, masks).savefig(file, format="png")
    except KeyboardInterrupt:
        print(f"\ninterrupted: call again with --sweep {config.sweep} to go on", file=sys.stderr)
        return 130
    except ValueError as problem:
        print(f"optimal_masks: {problem}", file=sys.stderr)
        return 2
    print(markdown(config, rows), f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
