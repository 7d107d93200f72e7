"""Report of `redundancy`: findings, table and figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmask.viz.style import COLORS, FAINT, INK, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIAMETER = 1.0  # of the pupils [m]: nothing here depends on it but r0 and the outer scale
KORFF = 0.341864 * 4 / math.pi  # E|OTF|^2 of a large pupil at high frequencies over (r0 / D)^2 times the perfect OTF
_LOWEST = 1e-3  # MTF that is drawn


def deviation(rows: Sequence[dict[str, Any]], key: str) -> float:
    """Return the largest difference between drawn and closed form, in standard errors.

    Without what hardly varies between exposures, such as the fringe of a single pair of holes under pistons: there the
    sampling of the pupil would be all that is seen.
    """
    pairs = [(row[key] - row[f"{key}_theory"], row[f"{key}_error"]) for row in rows if key in row]
    return max(abs(difference) / error for difference, error in pairs if error > 1e-3)


def findings(d_over_r0: float, n_frames: int, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return what the numbers say, in sentences."""
    full = [r for r in rows if r["pupil"] == "full pupil" and 0.3 * DIAMETER < r["baseline"] < 0.7 * DIAMETER]
    golay = [row for row in rows if row["pupil"] == "Golay-6"]
    row = [row for row in rows if row["pupil"] == "row"]
    kept = [float(np.mean([r["short"] for r in own])) for own in (full, golay)]
    korff = float(np.mean([math.sqrt(KORFF / r["perfect"]) / d_over_r0 for r in full]))
    return [
        f"Short exposures, D/r0 = {d_over_r0:g}: the full pupil keeps {kept[0]:.3f} of its contrast on "
        f"baselines of 0.3 to 0.7 D ({korff:.3f} in the limit of large D/r0), Golay-6 keeps {kept[1]:.3f}, and what it "
        "loses is lost inside its holes.",
        f"Random pistons on a row of {len(row) + 1} holes: of the contrast remains {row[0]['pistons']:.4f} ± "
        f"{row[0]['pistons_error']:.4f} at redundancy {row[0]['redundancy']}, where the random walk says "
        f"{row[0]['pistons_theory']:.4f}. Von Karman screens keep more on short baselines, whose pairs of holes see "
        "nearly the same phase differences, and less on long ones, because they also act inside the holes.",
        f"Long exposures keep {row[0]['long']:.3f} of the contrast on the shortest baseline of the row and, by the "
        f"closed form, {max(r['long_theory'] for r in golay):.1e} on that of Golay-6: averaging destroys what masking "
        "saves.",
        f"Largest difference from the closed forms, in standard errors of {n_frames} exposures: "
        f"{deviation(rows, 'short'):.1f} short, {deviation(rows, 'long'):.1f} long, {deviation(rows, 'pistons'):.1f} "
        f"with pistons, over {len(rows)} baselines.",
    ]


def markdown(setting: str, found: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    """Return the report as Markdown: the setting, the findings and the table."""
    lines = [
        "# What turbulence leaves of the fringes",
        "",
        f"{setting} Contrasts are relative to the perfect OTF of the same pupil; ± is one standard error.",
        "",
        *(f"- {line}" for line in found),
        "",
        "| pupil | baseline / D | redundancy | perfect OTF | short exposures, rms | closed form | long exposure | "
        "closed form | random pistons | closed form |",
        "|" + "---|" * 10,
    ]
    for row in rows:
        pistons = "- | -"
        if "pistons" in row:
            pistons = f"{row['pistons']:.4f} ± {row['pistons_error']:.4f} | {row['pistons_theory']:.4f}"
        lines.append(
            f"| {row['pupil']} | {row['baseline'] / DIAMETER:.4f} | {row['redundancy'] or '-'} "
            f"| {row['perfect']:.4f} | "
            f"{row['short']:.4f} ± {row['short_error']:.4f} | {row['short_theory']:.4f} | "
            f"{row['long']:.4f} ± {row['long_error']:.4f} | {row['long_theory']:.4f} | {pistons} |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(d_over_r0: float, rows: Sequence[dict[str, Any]]) -> Figure:
    """MTF of the full pupil and of the mask, and contrast against redundancy."""
    sheet = new_figure(7.0, 6.8)
    panels = sheet.subplot_mosaic([["full", "masked"], ["walk", "walk"]])
    full, masked, walk = (panels[name] for name in ("full", "masked", "walk"))
    mtf_panel(full, "full pupil", rows)
    limit = sorted((row for row in rows if row["pupil"] == "full pupil"), key=lambda row: row["baseline"])
    x = [row["baseline"] / DIAMETER for row in limit]
    y = [math.sqrt(KORFF * max(row["perfect"], 0)) / d_over_r0 for row in limit]
    full.plot(x, y, color=FAINT, linestyle="--", linewidth=1, label="limit of large D/r$_0$")
    mtf_panel(masked, "Golay-6", rows)
    for ax in (full, masked):
        ax.set(yscale="log", ylim=(_LOWEST, 1.3), xlim=(-0.02, 1.02), xlabel="baseline / D", ylabel="MTF")
        ax.legend(loc="lower left" if ax is masked else "lower right")
    own = [row for row in rows if row["pupil"] == "row"]
    r = np.array([row["redundancy"] for row in own])
    style: dict[str, Any] = {"linestyle": "none", "markersize": 4, "capsize": 2}
    for key, color, marker, label in (
        ("pistons", COLORS[0], "o", "random pistons"),
        ("short", COLORS[1], "s", "von Karman screens"),
    ):
        values, errors = ([row[key + part] for row in own] for part in ("", "_error"))
        walk.errorbar(r, values, errors, color=color, marker=marker, label=label, **style)
        walk.plot(r, [row[f"{key}_theory"] for row in own], color=color, linewidth=1)
    walk.set(xscale="log", yscale="log", xlabel="redundancy R", ylabel="contrast kept by short exposures")
    ticks = [n for n in (1, 2, 3, 5, 10, 20) if n <= max(r)]
    walk.set_xticks(ticks, [str(n) for n in ticks])
    walk.set_yticks([0.2, 0.3, 0.5, 1.0], ["0.2", "0.3", "0.5", "1"])
    walk.minorticks_off()
    walk.set_ylim(0.2, 1.15)
    walk.set_title(f"A row of {len(own) + 1} holes (lines: closed forms)")
    walk.legend()
    sheet.suptitle(f"Redundancy destroys the contrast of short exposures (D/r$_0$ = {d_over_r0:g})", x=0.02, ha="left")
    return sheet


def mtf_panel(ax: Axes, name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Perfect, short-exposure and long-exposure MTF of one pupil: lines are closed forms, markers are drawn."""
    own = sorted((row for row in rows if row["pupil"] == name), key=lambda row: row["baseline"])
    own = [row for row in own if row["perfect"] > 1e-3]
    x, perfect = np.array([[row["baseline"] / DIAMETER, row["perfect"]] for row in own]).T
    line = "-" if name == "full pupil" else "_"  # a mask transmits nothing between its baselines
    style: dict[str, Any] = {"linestyle": "-"} if line == "-" else {"linestyle": "none", "marker": "_", "markersize": 9}
    ax.plot(x, perfect, color=INK, label="perfect", **style)
    for key, color, label in (("short", COLORS[1], "short exposures, rms"), ("long", COLORS[0], "long exposure")):
        theory, value, error = (perfect * [row[key + part] for row in own] for part in ("_theory", "", "_error"))
        ax.plot(x, theory, color=color, **style)
        seen = value > 3 * error
        label += " (below the axis)" if theory.max() < _LOWEST else ""
        ax.errorbar(
            x[seen], value[seen], error[seen], color=color, marker="o", markersize=3, linestyle="none", label=label
        )
    ax.set_title(f"{name} (lines: closed forms)" if line == "-" else f"{name} (dashes: closed forms)")
