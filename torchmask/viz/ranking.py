"""Figures of rankings."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING, Any

from torchmask.design.ranking import Layout, RankedMask, Ranking
from torchmask.viz import style as drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LINE = 100  # characters, as wide as the figure
_MARKS = {
    Layout.AFRESH: (drawing.COLORS[0], "o", "laid afresh, all with the same collecting area"),
    Layout.SEARCHED: (drawing.COLORS[1], "o", "searched by torchmask, the same area"),
    Layout.AS_BUILT: (drawing.COLORS[2], "D", "as built, with its own holes scaled to this pupil"),
}


@drawing.styled
def ranking_figure(ranking: Ranking, light: str) -> Figure:
    """Draw the masks in order, each as built and laid afresh on one line, and their error over the number of holes.

    `light` says in words for which light they are ranked.
    """
    from matplotlib.ticker import MaxNLocator

    best: dict[str, float] = {}
    for row in ranking.rows:
        best[row.mask] = min(row.relative_mse, best.get(row.mask, row.relative_mse))
    places = {name: place for place, name in enumerate(sorted(best, key=lambda name: best[name]), 1)}
    length = 1.0 + 0.17 * len(places)
    figure = drawing.new_figure(6.4, length + 3.6)
    listing, against = figure.subplots(2, 1, height_ratios=[length, 3.4])
    for layout, (color, marker, label) in _MARKS.items():
        rows = ranking.of(layout)
        if rows:
            x, y = [row.relative_mse for row in rows], [places[row.mask] for row in rows]
            listing.scatter(x, y, c=color, marker=marker, s=22, zorder=3, label=label)
            _draw_numbers(against, rows, color, marker, layout)
    for name, place in places.items():
        errors = [row.relative_mse for row in ranking.rows if row.mask == name]
        listing.hlines(place, 0, max(errors), color=drawing.FAINT, linewidth=0.8, alpha=0.5)
    listing.set_yticks(list(places.values()), list(places))
    listing.tick_params(axis="y", length=0)
    listing.invert_yaxis()
    listing.set_xlim(0)
    listing.axvline(ranking.floor, color=drawing.FAINT, linestyle="--", linewidth=1)
    against.axhline(ranking.floor, color=drawing.FAINT, linestyle="--", linewidth=1)
    listing.set_xlabel("relative MSE (dashed: what no mask can change)")
    against.set(xlabel="number of holes", ylabel="relative MSE", title="Against the number of holes")
    against.set_ylim(0)
    against.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
    legend: dict[str, Any] = {"title": textwrap.fill(light, _LINE), "title_fontsize": 8, "alignment": "left"}
    figure.legend(*listing.get_legend_handles_labels(), loc="outside upper left", ncols=1, **legend)
    return figure


def _draw_numbers(ax: Axes, rows: list[RankedMask], color: str, marker: str, layout: Layout) -> None:
    rows = sorted(rows, key=lambda row: row.n_subapertures)
    line = "-" if layout is Layout.SEARCHED else ""
    x, y = [row.n_subapertures for row in rows], [row.relative_mse for row in rows]
    ax.plot(x, y, marker=marker, linestyle=line, color=color, markersize=5, linewidth=1)
