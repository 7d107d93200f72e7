"""Report of `mask_vs_full`: paired ratios of scores, findings, table and figure."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.stats import t as student

from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INSTRUMENTS = {"mask": "mask", "full": "full pupil"}
CONFIDENCE = 0.95
_COLUMNS = 3  # of the figure, so that its text is legible on a phone


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per D/r0 and photons: geometric means over draws, and the paired ratio mask / full.

    The interval is Student's, of the mean logarithm; `verdict` is the instrument it leaves no doubt about, if any.
    """
    cells = []
    for strength, photons in dict.fromkeys((row["d_over_r0"], row["n_photons"]) for row in rows):
        own = [row for row in rows if (row["d_over_r0"], row["n_photons"]) == (strength, photons)]
        cell: dict[str, Any] = {"d_over_r0": strength, "n_photons": photons}
        logs = {}
        for which in INSTRUMENTS:
            for key in ("score", "floor", "mean_frame"):
                logs[key, which] = np.log([row[key] for row in own if row["instrument"] == which])
                cell[f"{which}_{key}"] = float(np.exp(logs[key, which].mean()))
            cell[f"{which}_blindness"] = cell[f"{which}_score"] / cell[f"{which}_floor"]
            cell[f"{which}_low"], cell[f"{which}_high"] = interval(logs["score", which], 0.683)
        paired = logs["score", "mask"] - logs["score", "full"]
        low, high = interval(paired, CONFIDENCE)
        cell |= {"ratio": float(np.exp(paired.mean())), "ratio_low": low, "ratio_high": high, "n_draws": len(paired)}
        cell["floor_ratio"] = cell["mask_floor"] / cell["full_floor"]
        cell["verdict"] = "mask" if high < 1 else "full" if low > 1 else None
        cells.append(cell)
    return cells


def interval(logs: np.ndarray, confidence: float) -> tuple[float, float]:
    """Student's interval of the mean of logarithms, as a factor; unlimited for a single draw."""
    if len(logs) < 2:
        return 0.0, math.inf
    reach = student.ppf((1 + confidence) / 2, len(logs) - 1) * logs.std(ddof=1) / math.sqrt(len(logs))
    return float(np.exp(logs.mean() - reach)), float(np.exp(logs.mean() + reach))


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return where the mask wins, where not, and why, in sentences made from the numbers."""
    lines = []
    for cell in cells:
        verdict = {
            "mask": "the mask wins",
            "full": "the full pupil wins",
            None: "undecided" if cell["n_draws"] > 1 else "undecided (one draw)",
        }[cell["verdict"]]
        reach = "" if cell["n_draws"] < 2 else f", {cell['ratio_low']:.2f} to {cell['ratio_high']:.2f}"
        ahead = "mask" if cell["floor_ratio"] < 1 else "full pupil"
        lines.append(
            f"D/r0 = {cell['d_over_r0']:g}, {cell['n_photons']:.0e} photons: {verdict}. Score mask / full "
            f"{cell['ratio']:.2f} ({cell['n_draws']} draws{reach}). With the true aberrations the {ahead} is ahead "
            f"({cell['floor_ratio']:.2f}); not knowing them costs the mask a factor {cell['mask_blindness']:.2f}, the "
            f"full pupil {cell['full_blindness']:.2f}."
        )
    count = {key: sum(cell["verdict"] == key for cell in cells) for key in ("mask", "full", None)}
    lines.append(
        f"Of {len(cells)} settings, the mask wins {count['mask']}, the full pupil {count['full']}, and {count[None]} "
        f"are undecided at {100 * CONFIDENCE:g} % confidence."
    )
    return lines


def markdown(setting: str, found: Sequence[str], cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown: the setting, the findings and the table."""
    lines = [
        "# Mask against full pupil",
        "",
        f"{setting} Scores are relative errors up to the diffraction limit, geometric means over draws; the floor "
        f"knows the true aberrations; the ratio is paired, with its interval at {100 * CONFIDENCE:g} %.",
        "",
        *(f"- {line}" for line in found),
        "",
        "| D/r0 | photons | mask | full | mask / full | interval | mask's floor | full's floor | mean frame, mask | "
        "mean frame, full |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for cell in cells:
        values = [cell["mask_score"], cell["full_score"], cell["ratio"]]
        rest = [cell[key] for key in ("mask_floor", "full_floor", "mask_mean_frame", "full_mean_frame")]
        lines.append(
            f"| {cell['d_over_r0']:g} | {cell['n_photons']:.0e} | "
            + " | ".join(f"{value:.3f}" for value in values)
            + f" | {cell['ratio_low']:.2f} to {cell['ratio_high']:.2f} | "
            + " | ".join(f"{value:.3f}" for value in rest)
            + " |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Draw scores against photons, one panel per strength of turbulence, each with the ratio below."""
    from matplotlib.ticker import LogLocator, NullLocator

    strengths = list(dict.fromkeys(cell["d_over_r0"] for cell in cells))
    columns = min(_COLUMNS, len(strengths))
    lines = math.ceil(len(strengths) / columns)
    sheet = new_figure(1.0 + 2.1 * columns, 0.7 + 4.4 * lines)
    axes = sheet.subplots(2 * lines, columns, sharex=True, squeeze=False, height_ratios=[1.5, 1] * lines)
    tops, bottoms = axes[::2].ravel(), axes[1::2].ravel()
    for strength, top, bottom in zip(strengths, tops, bottoms, strict=False):
        panel(top, bottom, [cell for cell in cells if cell["d_over_r0"] == strength])
        top.set(title=f"D/r$_0$ = {strength:g}", xscale="log", yscale="log")
        bottom.set(yscale="log", xlabel="photons through the mask")
        bottom.tick_params(labelbottom=True)
    # Panels of one kind have one scale, which must hold the bars of them all.
    seen = [cell[key] for cell in cells for key in ("ratio", "ratio_low", "ratio_high") if 0 < cell[key] < math.inf]
    ratios = (0.8 * min([*seen, 1.0]), 1.25 * max([*seen, 1.0]))
    scores = [top.get_ylim() for top in tops[: len(strengths)]]
    for kind, label, limits in (
        (tops, "score (0 is perfect)", (min(low for low, _ in scores), max(high for _, high in scores))),
        (bottoms, "mask / full pupil", ratios),
    ):
        for ax in kind:
            ax.set_ylim(limits)
            ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5)))
            ax.yaxis.set_major_formatter("{x:g}")
            ax.yaxis.set_minor_locator(NullLocator())
        for ax in kind[::columns]:
            ax.set_ylabel(label)
    for unused in (*tops[len(strengths) :], *bottoms[len(strengths) :]):
        unused.set_visible(False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    sheet.legend(handles, labels, loc="outside upper left", ncols=2)
    return sheet


def panel(top: Axes, bottom: Axes, cells: Sequence[Mapping[str, Any]]) -> None:
    """Draw one strength of turbulence: scores and floors above, the paired ratio below."""
    photons = [cell["n_photons"] for cell in cells]
    style: dict[str, Any] = {"markersize": 4, "capsize": 2, "linewidth": 1.2}
    for (which, label), color, marker in zip(INSTRUMENTS.items(), COLORS, "os", strict=False):
        values = np.array([cell[f"{which}_score"] for cell in cells])
        bars = _bars(values, [cell[f"{which}_low"] for cell in cells], [cell[f"{which}_high"] for cell in cells])
        top.errorbar(photons, values, bars, color=color, marker=marker, label=label, **style)
        floors = [cell[f"{which}_floor"] for cell in cells]
        top.plot(photons, floors, "--", color=color, linewidth=0.9, label=f"{label}, true aberrations")
    ratio = np.array([cell["ratio"] for cell in cells])
    bars = _bars(ratio, [cell["ratio_low"] for cell in cells], [cell["ratio_high"] for cell in cells])
    bottom.axhspan(1e-9, 1, color=COLORS[0], alpha=0.07, linewidth=0)
    bottom.axhline(1, color=FAINT, linewidth=0.8)
    bottom.errorbar(photons, ratio, bars, color="#222222", marker="o", **style)
    bottom.text(0.03, 0.04, "the mask wins", color=COLORS[0], fontsize=8, transform=bottom.transAxes)


def _bars(values: np.ndarray, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Lengths of error bars; none where an interval is unlimited."""
    lengths = np.array([values - np.array(low), np.array(high) - values])
    return np.where(np.isfinite(high), lengths, 0.0)
