"""The gallery of optimal masks: holes, u-v coverage and relative MSE for N = 3 to 20.

    python experiments/optimal_masks.py                                   # minutes
    python experiments/optimal_masks.py --budget 200000 --seed 0 1 2 3 4  # the best there are
    python experiments/optimal_masks.py --smoke                           # everything, tiny, in seconds

Case: D = 1 m, 550 nm, Nyquist, photon noise. The picture, the numbers and the masks themselves (JSON, for `load_mask`)
go to a new folder; the searches are kept in --sweep, one file each, so that a run that was stopped goes
on, and experiments/mse_vs_n.py shares them.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from searched_masks import SearchedMaskOptions, design_space, error

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.manufacture import save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.space import Design
from torchmask.design.table import DesignTable, design_table
from torchmask.optics.aperture import SparseAperture
from torchmask.viz.style import COLORS, FAINT, INK, PALE, hole, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def best_of_seeds(table: DesignTable) -> list[Design]:
    """Return the best row of each N."""
    best: dict[int, Design] = {}
    for row in table.rows:
        known = best.get(row.n_subapertures)
        if known is None or error(row) < error(known):
            best[row.n_subapertures] = row
    return list(best.values())


def numbers(table: DesignTable) -> list[dict[str, Any]]:
    """Return the row that is written for each N."""
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


def markdown(options: SearchedMaskOptions, rows: Sequence[dict[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = [
        "# Optimal masks",
        "",
        f"D = 1 m, N d^2 / D^2 = {options.fill_factor:g}, p = {options.exponent:g}, {options.n_photons:g} photons, "
        f"K = {options.n_frames}, {options.n_pixels} frequencies a side; the best of {len(options.seed)} searches of "
        f"{options.budget} evaluations. `Above the floor` is what a mask can change: frequencies beyond the reach of "
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
    """Draw each mask above its u-v coverage."""
    columns = min(6, len(rows))
    lines = math.ceil(len(rows) / columns)
    sheet = new_figure(1.15 * columns + 0.2, 2.85 * lines + 0.5)
    axes = sheet.subplots(2 * lines, columns, squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (row, mask) in enumerate(zip(rows, masks, strict=True)):
        line, column = divmod(k, columns)
        draw_mask(axes[2 * line, column], mask)
        axes[2 * line, column].set_title(f"N = {row['n_subapertures']}", loc="center", fontweight="bold", pad=3)
        draw_coverage(axes[2 * line + 1, column], mask)
        text = f"{row['relative_mse']:.4f}\n({row['above_floor']:.4f})"
        axes[2 * line + 1, column].text(0.5, -0.02, text, transform=axes[2 * line + 1, column].transAxes, **CAPTION)
    sheet.get_layout_engine().set(h_pad=0.07)  # type: ignore[union-attr]
    title = f"Holes, u-v coverage, relative MSE and (above the floor), N d²/D² = {masks[0].fill_factor:g}"
    sheet.suptitle(title, x=0.012, ha="left", fontsize=9.5)
    return sheet


CAPTION: dict[str, Any] = {"ha": "center", "va": "top", "fontsize": 8, "color": INK, "linespacing": 1.25}


def draw_mask(ax: Axes, mask: SparseAperture) -> None:
    """Draw the holes in their disc."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle((0, 0), mask.mask_diameter / 2, facecolor=PALE, edgecolor=FAINT, linewidth=0.6))
    for center in mask.centers.tolist():
        ax.add_patch(hole(mask, center, 1.0, facecolor=COLORS[0], edgecolor="none"))
    half = 0.52 * mask.mask_diameter
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")


def draw_coverage(ax: Axes, mask: SparseAperture) -> None:
    """Draw a disc of the hole's cut-off around each baseline, darker where they overlap."""
    from matplotlib.patches import Circle

    difference = (mask.centers[:, None] - mask.centers).reshape(-1, 2)
    for baseline in difference[difference.abs().sum(-1) > 0].tolist() + [[0.0, 0.0]]:
        ax.add_patch(hole(mask, baseline, 2.0, facecolor=COLORS[0], edgecolor="none", alpha=0.3))
    ax.add_patch(Circle((0, 0), mask.mask_diameter, fill=False, edgecolor=FAINT, linewidth=0.6))
    half = 1.04 * mask.mask_diameter
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal")


def run(options: SearchedMaskOptions) -> None:
    """Search, and draw the gallery in a new folder."""
    if options.smoke:
        options = dataclasses.replace(options, n_subapertures=(3, 4, 5), n_pixels=64, budget=200)
    with new_run("optimal_masks", options) as output:
        table = design_table(design_space(options), options.sweep, **options.keywords(output.callback))
        rows = numbers(table)
        masks = [table.aperture(row) for row in best_of_seeds(table)]
        for row, mask in zip(rows, masks, strict=True):
            save_json(output.directory / f"optimal_{row['n_subapertures']}.json", mask)
        text = markdown(options, rows)
        output.report("optimal_masks", {"rows": rows}, text, gallery(rows, masks))
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("optimal_masks", run, SearchedMaskOptions, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
