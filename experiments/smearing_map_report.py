"""Code of `smearing_map` that turns restorations into costs, a table and the figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from mask_vs_full_report import interval
from scipy.optimize import isotonic_regression

from torchmask.viz.style import COLORS, INK, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES = {"exposure": "exposure T / tau$_0$", "width": "width / wavelength"}
_MEAN = 0.683  # confidence of the intervals: one standard error
_FIRST = 1e9  # weight of the first point, which is 1 by definition


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a cell for each axis, flux and amount: by how much scores grow from the first amount, and the cost.

    `predicted`, `known` and `blind` are geometric means over the draws of the growth that the criterion says, and of
    what was measured for known and for unknown PSFs. `blindness` is blind over known, for which all fluxes count alike,
    with its interval. `cost` is known over predicted, times blindness, neither of which may fall from one amount to the
    next (isotonic regression): with the same photons more blur does not help.
    """
    cells = []
    for axis in AXES:
        line = [row for row in rows if row["axis"] == axis]
        amounts = sorted({row[axis] for row in line})
        searched = [row for row in line if "score" in row]
        lost = [_growths(searched, axis, x, "score") - _growths(searched, axis, x, "known") for x in amounts]
        blindness = _rising(lost)
        for photons in sorted({row["n_photons"] for row in line}):
            own = [row for row in line if row["n_photons"] == photons]
            known, predicted = ([_growths(own, axis, x, name) for x in amounts] for name in ("known", "predicted"))
            excess = _rising([one - other for one, other in zip(known, predicted, strict=True)])
            for k, amount in enumerate(amounts):
                low, high = interval(lost[k], _MEAN)
                found = [row for row in own if "score" in row]
                blind = _growths(found, axis, amount, "score") if found else None
                cells.append(
                    {"axis": axis, "n_photons": photons, "amount": amount, "draws": len(known[k])}
                    | {"predicted": _mean(predicted[k]), "known": _mean(known[k])}
                    | {"blind": None if blind is None else _mean(blind)}
                    | {"blindness": _mean(lost[k]), "low": low, "high": high}
                    | {"cost": math.exp(excess[k] + blindness[k])}
                )
    return cells


def _growths(rows: Sequence[Mapping[str, Any]], axis: str, amount: float, name: str) -> np.ndarray:
    """Return the logarithms of what a score grows by from the first amount, draw by draw."""
    first = {(row["n_photons"], row["draw"]): row for row in rows if row[axis] == min(row[axis] for row in rows)}
    here = [row for row in rows if row[axis] == amount]
    return np.log([row[name] / first[row["n_photons"], row["draw"]][name] for row in here])


def _mean(logs: np.ndarray) -> float:
    return math.exp(logs.mean())


def _rising(logs: Sequence[np.ndarray]) -> np.ndarray:
    """Return means, the first of which is 0, as they are nearest without falling."""
    weights = [_FIRST, *[1.0] * (len(logs) - 1)]
    return np.maximum(isotonic_regression([one.mean() for one in logs], weights=weights).x, 0.0)


def table_of(cells: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return what `torchmask.planning.smearing` reads, without the conditions."""
    photons = sorted({cell["n_photons"] for cell in cells})
    table: dict[str, Any] = {"n_photons": photons}
    for axis in AXES:
        own = [cell for cell in cells if cell["axis"] == axis]
        table[f"{axis}s"] = sorted({cell["amount"] for cell in own})
        table[f"{axis}_cost"] = [[cell["cost"] for cell in own if cell["n_photons"] == light] for light in photons]
    return table


def markdown(setting: str, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = ["# What long exposures and wide bands cost", "", setting, ""]
    lines += ["| axis | photons | amount | predicted | known PSFs | blind | blind over known, all photons | cost |"]
    lines += ["|---" * 8 + "|"]
    for cell in cells:
        texts = [cell["axis"], f"{cell['n_photons']:.0e}".replace("e+0", "e"), f"{cell['amount']:g}"]
        texts += ["-" if cell[name] is None else f"{cell[name]:.2f}" for name in ("predicted", "known", "blind")]
        texts += [f"{cell['blindness']:.2f} ({cell['low']:.2f} to {cell['high']:.2f})", f"{cell['cost']:.2f}"]
        lines.append(f"| {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw what scores grow by with the amount of blur, predicted and measured, at one flux a row."""
    fluxes = sorted({cell["n_photons"] for cell in cells})
    sheet = new_figure(6.0, 0.9 + 1.6 * len(fluxes))
    axes = sheet.subplots(len(fluxes), 2, sharex="col", sharey=True, squeeze=False)
    for row, photons in zip(axes, fluxes, strict=True):
        for ax, (axis, label) in zip(row, AXES.items(), strict=True):
            own = [cell for cell in cells if (cell["axis"], cell["n_photons"]) == (axis, photons)]
            amounts = [cell["amount"] for cell in own]
            ax.plot(amounts, [cell["predicted"] for cell in own], "--", color=INK, lw=1.1, label="predicted")
            ax.plot(amounts, [cell["known"] for cell in own], "o-", color=COLORS[0], ms=4, label="known PSFs")
            if own[0]["blind"] is not None:
                ax.plot(amounts, [cell["blind"] for cell in own], "s", color=COLORS[1], ms=4, label="blind")
            planned = [cell["cost"] * cell["predicted"] for cell in own]
            ax.plot(amounts, planned, "-", color=COLORS[1], lw=1.2, label="predicted times cost")
            ax.set(yscale="log", title=f"{photons:.0e} photons".replace("e+0", "e"))
            ax.set_yticks([0.25, 0.5, 1, 2, 4], ["0.25", "0.5", "1", "2", "4"])
            ax.minorticks_off()
            if photons == fluxes[-1]:
                ax.set_xlabel(label)
    sheet.supylabel("score over that of instants, of narrow light", fontsize=9)
    sheet.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
    return sheet
