"""How many holes: the relative MSE of the best mask against N, at constant collecting area.

    python experiments/mse_vs_n.py                                   # minutes
    python experiments/mse_vs_n.py --budget 200000 --seed 0 1 2 3 4  # the best there are
    python experiments/mse_vs_n.py --smoke                           # everything, tiny, in seconds

MSE_a, of several searches each, and beside it the mean Wiener MSE of the same masks under full von Karman screens. The
picture, the numbers and what they say go to a new folder; searches and draws are kept in --sweep, one
file each, so that a run that was stopped goes on, and experiments/optimal_masks.py shares them.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from searched_masks import SearchedMaskOptions, design_space, error

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.table import DesignTable, design_table
from torchmask.viz.style import COLORS, FAINT, INK, PALE, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FLAT = (0.85, 0.97)  # shares of the whole drop between which the curve is said to flatten
_TOUCHING = 6.0121  # piston structure function of two touching holes [(d/r0)^(5/3)], Kolmogorov, by integration


@dataclass(frozen=True, kw_only=True)
class Options(SearchedMaskOptions):
    """Options of the curve."""

    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    max_hole_over_r0: float = 1.5
    """Largest holes to try in that turbulence, d / r0."""
    n_draws: int = 4
    """Number of stacks of K exposures drawn through each mask."""


def curve(options: Options, still: DesignTable, turbulent: DesignTable) -> list[dict[str, Any]]:
    """Return a row for each N: the best of the searches, their scatter, and the turbulence at the best."""
    rows = []
    for n in options.n_subapertures:
        found = [row for row in still.rows if row.n_subapertures == n]
        errors = [error(row) for row in found]
        best = found[errors.index(min(errors))]
        (measured,) = (row for row in turbulent.rows if (row.n_subapertures, row.seed) == (n, best.seed))
        hole = best.subaperture_diameter / still.space.mask_diameter * options.d_over_r0
        rows.append(
            {
                "n_subapertures": n,
                "relative_mse": min(errors),
                "above_floor": best.above_floor,
                "all_seeds": errors,
                "scatter": max(errors) / min(errors) - 1,
                "wiener_mse": measured.wiener_mse,
                "wiener_error": measured.wiener_error,
                "hole_over_r0": hole,
                "coherence_of_touching_holes": math.exp(-_TOUCHING * hole ** (5 / 3) / 2),
                "not_tried_in_turbulence": measured.infeasible,
            }
        )
    return rows


def rises(rows: Sequence[dict[str, Any]]) -> list[tuple[int, int, float, float]]:
    """(N, next N, rise, scatter) wherever the curve goes up: relative rise, and the larger scatter of the two."""
    found = []
    for row, following in itertools.pairwise(rows):
        rise = following["relative_mse"] / row["relative_mse"] - 1
        if rise > 0:
            scatter = max(row["scatter"], following["scatter"])
            found.append((row["n_subapertures"], following["n_subapertures"], rise, scatter))
    return found


def reached(rows: Sequence[dict[str, Any]], share: float) -> int:
    """Return the smallest N that has made `share` of the drop from the first N to the lowest MSE."""
    errors = [row["relative_mse"] for row in rows]
    goal = max(errors[0] - share * (errors[0] - min(errors)), min(errors))  # but for rounding
    return next(row["n_subapertures"] for row, value in zip(rows, errors, strict=True) if value <= goal)


def findings(options: Options, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return what the numbers say, in sentences."""
    first, last = rows[0], rows[-1]
    begin, end = (reached(rows, share) for share in _FLAT)
    lines = [
        f"From N = {first['n_subapertures']} to {last['n_subapertures']} the relative MSE falls from "
        f"{first['relative_mse']:.4f} to {last['relative_mse']:.4f}. It flattens between N = {begin} and {end}, where "
        f"{100 * _FLAT[0]:.0f} and {100 * _FLAT[1]:.0f} % of the drop are made."
    ]
    steps = [
        f"{a['n_subapertures']} to {b['n_subapertures']}: {100 * (1 - b['relative_mse'] / a['relative_mse']):.1f} %"
        for a, b in itertools.pairwise(rows)
    ]
    lines.append(f"What each further hole gains: {'; '.join(steps)}.")
    lines.append(f"Scatter of {len(options.seed)} searches: at most {100 * max(r['scatter'] for r in rows):.2f} %.")
    up = rises(rows)
    if up:
        worse = "; ".join(f"{a} to {b} by {100 * r:.2f} % (scatter {100 * s:.2f} %)" for a, b, r, s in up)
        beyond = any(r > s for _, _, r, s in up)
        lines.append(f"The curve goes up {'BEYOND' if beyond else 'within'} the scatter of the searches: {worse}.")
    else:
        lines.append("The curve never goes up.")
    if any(row["n_subapertures"] == 11 for row in rows[:-1]):
        lines.append(judge_eleven(options, rows, begin, end))
    tried = [row for row in rows if row["wiener_mse"] is not None]
    ratios = [row["wiener_mse"] / row["relative_mse"] - 1 for row in tried]
    lines.append(
        f"Under von Karman screens of D/r0 = {options.d_over_r0:g} the Wiener MSE of {options.n_frames} exposures, "
        f"with every OTF known, differs from MSE_a by {100 * min(ratios):+.2f} to {100 * max(ratios):+.2f} %."
    )
    lines += [
        f"N = {row['n_subapertures']} is not tried in turbulence: {row['not_tried_in_turbulence']}."
        for row in rows
        if row["not_tried_in_turbulence"]
    ]
    return lines


def judge_eleven(options: Options, rows: Sequence[dict[str, Any]], begin: int, end: int) -> str:
    """Return what N = 11 gives up, and what it spares."""
    first, last = rows[0], rows[-1]
    own = next(row for row in rows if row["n_subapertures"] == 11)
    share = (first["relative_mse"] - own["relative_mse"]) / (first["relative_mse"] - last["relative_mse"])
    rest = 100 * (1 - last["relative_mse"] / own["relative_mse"])
    more = last["n_subapertures"]
    verdict = "is too few" if begin > 11 else "is more than it takes" if end < 11 else "is a reasonable choice"
    return (
        f"By this measure N = 11 {verdict}: it has made {100 * share:.0f} % of the drop, and all {more - 11} further "
        f"holes together lower the MSE by {rest:.0f} %. Each hole adds its aberrations to what the restoration must "
        f"find, and holes shrink: at D/r0 = {options.d_over_r0:g} those of N = 11 are {own['hole_over_r0']:.2f} r0 "
        f"wide and touching ones keep a coherence of {own['coherence_of_touching_holes']:.2f}; at N = {more} it is "
        f"{last['hole_over_r0']:.2f} r0 and {last['coherence_of_touching_holes']:.2f}, so that independent pistons, on "
        "which MSE_a rests, hold less."
    )


def markdown(options: Options, rows: Sequence[dict[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = [
        "# Relative MSE against the number of holes",
        "",
        f"D = 1 m, N d^2 / D^2 = {options.fill_factor:g}, p = {options.exponent:g}, {options.n_photons:g} photons, "
        f"K = {options.n_frames}, {options.n_pixels} frequencies a side; {len(options.seed)} searches of "
        f"{options.budget} evaluations. ± is one standard error of {options.n_draws} stacks of exposures.",
        "",
        *(f"- {line}" for line in findings(options, rows)),
        "",
        "| N | relative MSE | above the floor | scatter | Wiener MSE in turbulence | d/r0 | coherence of neighbours |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        wiener = "-"
        if row["wiener_mse"] is not None:
            wiener = f"{row['wiener_mse']:.6f} ± {row['wiener_error']:.6f}"
        lines.append(
            f"| {row['n_subapertures']} | {row['relative_mse']:.4f} | {row['above_floor']:.4f} | "
            f"{100 * row['scatter']:.2f} % | {wiener} | {row['hole_over_r0']:.2f} | "
            f"{row['coherence_of_touching_holes']:.3f} |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(options: Options, rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the curve, all searches, the floor and the turbulence; below, what each further hole gains."""
    sheet = new_figure(6.4, 5.4)
    top, bottom = sheet.subplots(2, 1, sharex=True, height_ratios=[2.2, 1])
    n = [row["n_subapertures"] for row in rows]
    best = [row["relative_mse"] for row in rows]
    floor = best[0] - rows[0]["above_floor"]
    top.plot(n, best, "-o", color=COLORS[0], markersize=4, label="MSE$_a$, best search")
    others = [(row["n_subapertures"], value) for row in rows for value in row["all_seeds"]]
    top.plot(*zip(*others, strict=True), "_", color=COLORS[0], markersize=9, label="each search")
    tried = [row for row in rows if row["wiener_mse"] is not None]
    top.errorbar(
        [row["n_subapertures"] for row in tried],
        [row["wiener_mse"] for row in tried],
        [row["wiener_error"] for row in tried],
        color=COLORS[1],
        marker="s",
        markersize=7,
        markerfacecolor="none",
        linestyle="none",
        capsize=2,
        label=f"Wiener MSE, D/r$_0$ = {options.d_over_r0:g}",
    )
    top.axhline(floor, color=FAINT, linestyle="--", linewidth=0.9)
    top.text(n[-1], 0.96 * floor, "no mask can change this", color=INK, va="top", ha="right", fontsize=8)
    begin, end = (reached(rows, share) for share in _FLAT)
    for ax in (top, bottom):
        shares = " to ".join(f"{100 * share:.0f}" for share in _FLAT)
        ax.axvspan(begin, end, color=PALE, zorder=0, linewidth=0, label=f"{shares} % of the drop")
    top.set(ylabel="relative MSE", ylim=(0, None), title="At constant collecting area, the gain of further holes fades")
    top.legend()
    gain = [100 * (1 - after / before) for before, after in itertools.pairwise(best)]
    bottom.bar(n[1:], gain, color=COLORS[0], width=0.6)
    bottom.axhline(0, color=FAINT, linewidth=0.7)
    bottom.set(xlabel="number of holes N", ylabel="gain of the\nN-th hole [%]", xticks=n)
    return sheet


def run(options: Options) -> None:
    """Search, expose, and draw the curve in a new folder."""
    if options.smoke:
        tiny = {"n_subapertures": (3, 4, 5), "n_pixels": 64, "n_frames": 2, "n_draws": 2, "budget": 200}
        options = dataclasses.replace(options, **tiny)
    # Under turbulence without the holes that are too large for it.
    turbulence = {"diameter_over_r0": (options.d_over_r0,), "max_hole_over_r0": options.max_hole_over_r0}
    spaces = [design_space(options), design_space(options, n_draws=options.n_draws, **turbulence)]
    with new_run("mse_vs_n", options) as output:
        keywords = options.keywords(output.callback)
        rows = curve(options, *(design_table(space, options.sweep, **keywords) for space in spaces))
        output.report("mse_vs_n", {"rows": rows}, markdown(options, rows), figure(options, rows))
        output.summary.extend(findings(options, rows))


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("mse_vs_n", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
