"""How many modes the rival of a mask, a full pupil, should be allowed under the method as first published.

    python experiments/rival_modes.py                      # 3 to 231 modes of the full pupil, three seeds
    python experiments/rival_modes.py --n-photons 1e5      # a fainter source
    python experiments/rival_modes.py --smoke              # everything, tiny, in seconds

The published method restores piston, tip and tilt of every hole by one bounded L-BFGS, without a prior on the
aberrations. A full pupil with its own three modes is forbidden what the eleven holes are allowed: an image through it
needs more. Here it is allowed more and more of them, by the same method and as many iterations, beside the mask with
three modes for each hole.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from mask_vs_full_report import INSTRUMENTS
from observing import ObservingOptions, check, curves, observe, optimum, page, scores, smoke

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.viz.style import COLORS, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MASK_MODES = 3  # of every hole: piston, tip and tilt


@dataclass(frozen=True, kw_only=True)
class Options(ObservingOptions):
    """Options of the restorations."""

    modes: tuple[int, ...] = (3, 6, 10, 21, 45, 91, 153, 231)
    """Numbers of Zernike modes of the full pupil, from piston."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    n_photons: float = 1e7
    """Electrons per frame through the mask."""
    iterations: int = 600
    """Maximum number of iterations of a restoration."""


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a cell for each instrument and number of modes; `ratio` is the error of the full pupil over the mask's."""
    mask = [row for row in rows if row["instrument"] == "mask"]
    keys = dict.fromkeys((row["instrument"], row["modes"]) for row in rows)
    return [
        {"instrument": which, "modes": modes}
        | scores([row for row in rows if (row["instrument"], row["modes"]) == (which, modes)], mask)
        for which, modes in keys
    ]


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the best number of modes, and what the mask gains over it and over three."""
    full = [cell for cell in cells if cell["instrument"] == "full"]
    best = min(full, key=lambda cell: cell["score"])
    lines = [f"The full pupil is best with {optimum(full, 'modes')} modes: a score of {best['score']:.3f}."]
    for modes in dict.fromkeys((full[0]["modes"], best["modes"])):
        own = next(cell for cell in full if cell["modes"] == modes)
        lines.append(
            f"With {modes} modes its error is {own['ratio']:.2f} ({own['ratio_low']:.2f} to {own['ratio_high']:.2f}) "
            f"times that of the mask with {MASK_MODES} for each hole."
        )
    return lines


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Score of the full pupil against its modes, and that of the mask as a band."""
    sheet = new_figure(5.4, 3.6)
    ax = sheet.subplots()
    curves(ax, [cell for cell in cells if cell["instrument"] == "full"], "modes")
    (mask,) = (cell for cell in cells if cell["instrument"] == "mask")
    color = COLORS[list(INSTRUMENTS).index("mask")]
    ax.axhline(mask["score"], color=color, label=f"mask, {MASK_MODES} modes for each hole")
    if np.isfinite(mask["high"]):
        ax.axhspan(mask["low"], mask["high"], color=color, alpha=0.2, linewidth=0)
    ticks = sorted({cell["modes"] for cell in cells})
    ax.set(xscale="log", yscale="log", xlabel="modes of the full pupil", ylabel="score (0 is perfect)")
    ax.set_xticks(ticks, [str(tick) for tick in ticks])
    ax.minorticks_off()
    shown = [value for value in (0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0) if ax.get_ylim()[0] < value < ax.get_ylim()[1]]
    ax.set_yticks(shown, [f"{value:g}" for value in shown])
    sheet.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet


def run(options: Options) -> None:
    """Simulate, restore and compare in a new folder."""
    if options.smoke:
        options = smoke(options, modes=(3, 6))
    options = replace(options, instruments=("mask", "full"))
    check(options, modes=options.modes)
    with new_run("rival_modes", options) as output:
        rows = []
        for which, allowed in (("mask", (MASK_MODES,)), ("full", options.modes)):
            alone = replace(options, instruments=(which,))
            rows += observe(alone, "rival_modes", [{"modes": modes} for modes in allowed], output.callback)
        cells = summarise(rows)
        found = findings(cells)
        text = page(options, "Modes of the rival under the published method", found, cells, {"modes": "modes"})
        output.report("rival_modes", {"cells": cells, "rows": rows}, text, figure(cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("rival_modes", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
