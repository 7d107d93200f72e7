"""Code shared by `exposure` and `band`: the trade of more light against less contrast, for each instrument."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mask_vs_full_report import INSTRUMENTS
from observing import curves, optimum, scores

from torchmask.viz.style import FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Trade:
    """What is varied, and what it leaves of the contrast.

    key : of a row and a cell
    name, label : in a sentence and along the axis
    kept : V^2 that is left, for an amount of it
    where : whose V^2 that is
    """

    key: str
    name: str
    label: str
    kept: Callable[[float], float]
    where: str

    def summarise(self, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
        """Return one cell for each instrument and amount."""
        keys = dict.fromkeys((row["instrument"], row[self.key]) for row in rows)
        return [
            {"instrument": which, self.key: amount, "kept": self.kept(amount)}
            | scores([row for row in rows if (row["instrument"], row[self.key]) == (which, amount)])
            for which, amount in keys
        ]

    def findings(self, cells: Sequence[Mapping[str, Any]]) -> list[str]:
        """Return the optimum of each instrument."""
        lines = []
        for which, name in INSTRUMENTS.items():
            own = [cell for cell in cells if cell["instrument"] == which]
            if own:
                best = min(own, key=lambda cell: cell["score"])
                lines.append(
                    f"The {name} is best at {self.name} = {optimum(own, self.key)}, with a score of "
                    f"{best['score']:.3f}; {best['kept']:.3f} of V^2 is kept {self.where} there."
                )
        return lines

    @property
    def columns(self) -> dict[str, str]:
        """Heads of the table beside instrument and score."""
        return {self.key: self.name, "kept": f"V^2 kept {self.where}"}


@styled
def figure(trade: Trade, cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Score against what is varied, and what is kept of the contrast."""
    sheet = new_figure(5.4, 3.6)
    ax = sheet.subplots()
    curves(ax, cells, trade.key)
    ax.set(xscale="log", xlabel=trade.label, ylabel="score (0 is perfect)")
    ticks = sorted({cell[trade.key] for cell in cells})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    beside = ax.twinx()
    fine = np.geomspace(ticks[0], ticks[-1], 50)
    beside.plot(fine, [trade.kept(amount) for amount in fine], "--", color=FAINT)
    beside.set(ylim=(0, 1.02), ylabel=f"V$^2$ kept {trade.where} (dashed)")
    sheet.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet
