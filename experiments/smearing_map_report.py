"""Code of `smearing_map` that turns restorations into ratios, a table and the figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mask_vs_full_report import interval
from scipy.optimize import isotonic_regression

from torchmask.planning.smearing import phase_spread
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = {"exposure": "exposure T / tau$_0$", "width": "width / wavelength"}
_MEAN = 0.683  # confidence of the intervals: one standard error


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a cell for each axis, flux and amount: what was expected and restored, and the ratio that a plan takes.

    Means over the draws are geometric. `growth` is that of the scores since the first amount, with its interval.
    `ratio` is score over expected, as it is nearest without falling from one amount to the next (isotonic regression):
    with the same photons more blur does not help.
    """
    cells = []
    for axis in AXES:
        for photons in sorted({row["n_photons"] for row in rows}):
            own = [row for row in rows if (row["axis"], row["n_photons"]) == (axis, photons)]
            amounts = sorted({row[axis] for row in own})
            scores, expected = (
                np.log([[row[name] for row in own if row[axis] == amount] for amount in amounts])
                for name in ("score", "expected")
            )
            ratios = isotonic_regression((scores - expected).mean(1)).x
            for k, amount in enumerate(amounts):
                growth = scores[k] - scores[0]
                low, high = interval(growth, _MEAN)
                cells.append(
                    {"axis": axis, "n_photons": photons, "amount": amount, "draws": len(growth)}
                    | {"expected": math.exp(expected[k].mean()), "restored": math.exp(scores[k].mean())}
                    | {"growth": math.exp(growth.mean()), "low": low, "high": high, "ratio": math.exp(ratios[k])}
                )
    return cells


def table_of(cells: Sequence[Mapping[str, Any]], d_over_r0: float) -> dict[str, Any]:
    """Return what `torchmask.planning.smearing` reads, without the conditions."""
    photons = sorted({cell["n_photons"] for cell in cells})
    amounts = {axis: sorted({cell["amount"] for cell in cells if cell["axis"] == axis}) for axis in AXES}
    ratios = {
        axis: [
            [cell["ratio"] for cell in cells if (cell["axis"], cell["n_photons"]) == (axis, light)] for light in photons
        ]
        for axis in AXES
    }
    return {
        "n_photons": photons,
        "exposures": amounts["exposure"],
        "spreads": [phase_spread(width, d_over_r0) for width in amounts["width"]],
        "exposure_ratio": ratios["exposure"],
        "band_ratio": ratios["width"],
    }


def markdown(setting: str, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = ["# What restorations attain in long exposures and wide bands", "", setting, ""]
    lines += ["| axis | photons | amount | expected of instants | restored | growth | ratio |", "|---" * 7 + "|"]
    for cell in cells:
        texts = [cell["axis"], f"{cell['n_photons']:.0e}".replace("e+0", "e"), f"{cell['amount']:g}"]
        texts += [f"{cell['expected']:.3f}", f"{cell['restored']:.3f}"]
        texts += [f"{cell['growth']:.2f} ({cell['low']:.2f} to {cell['high']:.2f})", f"{cell['ratio']:.2f}"]
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw what is expected of instants in narrow light, what was restored, and what a plan makes of the first."""
    sheet = new_figure(6.4, 4.0)
    axes = sheet.subplots(1, 2, sharey=True)
    least = min(cell["restored"] for cell in cells)
    ticks = [tick for tick in (0.02, 0.05, 0.1, 0.2, 0.3, 0.4) if tick > least]
    for ax, (axis, label) in zip(axes, AXES.items(), strict=True):
        for color, photons in zip(COLORS, sorted({cell["n_photons"] for cell in cells}), strict=False):
            own = [cell for cell in cells if (cell["axis"], cell["n_photons"]) == (axis, photons)]
            amounts, restored, expected = ([cell[name] for cell in own] for name in ("amount", "restored", "expected"))
            bars = [[cell["restored"] * (1 - cell["low"] / cell["growth"]) for cell in own]]
            bars += [[cell["restored"] * (cell["high"] / cell["growth"] - 1) for cell in own]]
            name = f"{photons:.0e} photons".replace("e+0", "e")
            ax.errorbar(amounts, restored, np.nan_to_num(bars, posinf=0), fmt="o", color=color, ms=4, label=name)
            ax.plot(amounts, expected, ":", color=color, lw=1.1)
            ax.plot(amounts, [cell["ratio"] * cell["expected"] for cell in own], "-", color=color, lw=1.2)
        ax.set(yscale="log", xlabel=label)
        ax.set_yticks(ticks, map(str, ticks))
        ax.minorticks_off()
    axes[0].set_ylabel("score (0 is perfect)")
    axes[0].plot([], [], ":", color=FAINT, lw=1.1, label="expected of instants in narrow light")
    axes[0].plot([], [], "-", color=FAINT, lw=1.2, label="expected by a plan")
    sheet.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet
