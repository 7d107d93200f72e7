"""Figures of plans."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmask.planning.result import Choice, ObservationPlan
from torchmask.viz import style as drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST = 1.03  # of the errors' axis: none exceeds 1, where marks are drawn whole
_RING: dict[str, Any] = {"markersize": 13, "fillstyle": "none", "color": drawing.COLORS[1]}


@drawing.styled
def plan_figure(plan: ObservationPlan) -> Figure:
    """Draw the predicted error of blind restorations over number and size of holes, exposure and band width.

    The exposure has a curve for each number of holes, and one for the full pupil. Each panel is at the best of all
    else; those of one mask, exposure or width are left out, unless there is no other. A ring marks the best point, an
    arrow upwards a lower limit, where nothing was tried.
    """
    widths, best = plan.axis("width"), plan.best
    several, wide = len(plan.masks) > 1, len(widths) > 1
    exposed = len({choice.exposure for choice in plan.choices}) > 1 or not (several or wide)
    figure, axes = drawing.row_of_axes([1.25] * several + [1.5] * exposed + [1.2] * wide, height=3.8)
    if several:
        _draw_map(figure, axes[0], plan)
        if plan.full_pupil is not None and not exposed:
            full = plan.full_pupil.best
            beside = f"; full pupil: {'> ' * full.is_limit}{full.blind_mse:.3f}"
            axes[0].set_title(axes[0].get_title(loc="left") + beside)
    if exposed:
        _draw_exposures(axes[int(several)], plan)
    if wide:
        ax = axes[-1]
        _draw_line(ax, widths, "width", 1e9, drawing.COLORS[0])
        ax.plot(1e9 * (best.width or 0.0), best.blind_mse, "o", **_RING)
        ax.set(xlabel="width of the band [nm]", ylabel="relative MSE, blind", title=f"at {1e3 * best.exposure:.3g} ms")
        _limit(ax)
    if exposed:
        figure.legend(*axes[int(several)].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    return figure


def _limit(ax: Axes) -> None:
    ax.set_ylim(top=min(ax.get_ylim()[1], _MOST))


def _draw_line(ax: Axes, line: Sequence[Choice], axis: str, scale: float, color: str, label: str | None = None) -> None:
    """Draw the errors along an axis, with an arrow upwards at each that is a lower limit."""
    known, limits = (
        np.array([(scale * getattr(c, axis), c.blind_mse) for c in line if c.is_limit == is_limit]).reshape(-1, 2)
        for is_limit in (False, True)
    )
    ax.plot(*known.T, "o-", color=color, markersize=4, label=label)
    ax.plot(*limits.T, "^", color=color)


def _draw_map(figure: Figure, ax: Axes, plan: ObservationPlan) -> None:
    best, r0 = plan.best, plan.instrument.site.r0
    numbers = sorted({n for n, _ in plan.masks})
    holes = sorted({hole for _, hole in plan.masks})
    errors, limits = np.full((len(numbers), len(holes)), np.nan), np.zeros((len(numbers), len(holes)), bool)
    for choice in plan.choices:
        if (choice.exposure, choice.width) == (best.exposure, best.width):
            cell = numbers.index(choice.n_subapertures), holes.index(choice.hole_diameter)
            errors[cell], limits[cell] = choice.blind_mse, choice.is_limit
    ax.imshow(errors, origin="lower", cmap="viridis", aspect="auto")
    middle = (np.nanmin(errors) + np.nanmax(errors)) / 2
    for (row, column), error in np.ndenumerate(errors):
        text, color = f"> {error:.3f}" if limits[row, column] else f"{error:.3f}", "white"
        if np.isnan(error):  # of masks that exist an interrupted plan has not reached all exposures
            exists = (numbers[row], holes[column]) in plan.masks
            text, color = "not reached" if exists else "does not fit", drawing.FAINT
        ax.text(column, row, text, ha="center", va="center", fontsize=8, color="black" if error > middle else color)
    place = holes.index(best.hole_diameter), numbers.index(best.n_subapertures)
    ax.plot(*place, "o", markersize=34, fillstyle="none", color=drawing.COLORS[1])
    ax.set_xticks(range(len(holes)), [f"{hole:.3g}\n{hole / r0:.2g} r0" for hole in holes])
    ax.set_yticks(range(len(numbers)), [str(n) for n in numbers])
    ax.set(xlabel="hole diameter [m]", ylabel="number of holes", title=f"at {1e3 * best.exposure:.3g} ms")
    drawing.colorbar(figure, [ax], "relative MSE, blind")


def _draw_exposures(ax: Axes, plan: ObservationPlan) -> None:
    best, is_full = plan.best, plan.mask.is_full
    if plan.full_pupil is not None:
        line = [choice for choice in plan.full_pupil.choices if choice.width == best.width]
        _draw_line(ax, line, "exposure", 1e3, drawing.INK, "full pupil")
    for color, n in zip(drawing.colors(), sorted({n for n, _ in plan.masks}), strict=False):
        line = [
            c
            for c in plan.choices
            if c.n_subapertures == n and (c.hole_diameter, c.width) == (best.hole_diameter, best.width)
        ]
        line.sort(key=lambda choice: choice.exposure)
        _draw_line(ax, line, "exposure", 1e3, color, "full pupil" if is_full else f"{n} holes")
    beside = () if plan.full_pupil is None else plan.full_pupil.choices
    if any(choice.is_limit for choice in (*plan.choices, *beside)):
        ax.plot([], [], "^", color=drawing.FAINT, label="lower limit: not tried")
    ax.plot(1e3 * best.exposure, best.blind_mse, "o", **_RING)
    tau0 = plan.instrument.with_exposure(best.exposure).seeing.tau0
    ax.axvline(1e3 * tau0, color=drawing.FAINT, linestyle="--", linewidth=1)
    beside_line: dict[str, Any] = {"xytext": (3, 0), "textcoords": "offset points", "ha": "left", "va": "top"}
    ax.annotate("tau0", (1e3 * tau0, 1), xycoords=("data", "axes fraction"), fontsize=8, **beside_line)
    ax.set_xscale("log")
    times = sorted({1e3 * choice.exposure for choice in plan.choices})
    ax.set_xticks(times, [f"{time:.3g}" for time in times])
    ax.minorticks_off()
    title = "" if is_full else f"holes of {best.hole_diameter:.3g} m"
    ax.set(xlabel="exposure [ms]", ylabel="relative MSE, blind", title=title)
    _limit(ax)
