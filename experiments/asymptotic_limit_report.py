"""Report of `asymptotic_limit`: findings, table and figure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MODELS = {"pistons": "random pistons", "von_karman": "von Karman screens"}


def findings(d_over_r0: float, rows: Sequence[dict[str, Any]]) -> list[str]:
    """Return what the numbers say, in sentences."""
    pistons = [row for row in rows if row["model"] == "pistons"]
    worst = min(pistons, key=lambda row: (row["ratio"] - 1) / row["ratio_error"])
    sigmas = (worst["ratio"] - 1) / worst["ratio_error"]
    verdict = "never below 1 within its error" if sigmas > -3 else "BELOW 1 BY MORE THAN ITS ERROR"
    frames = [row["n_frames"] for row in rows]
    lines = [
        f"Random pistons: the ratio is {verdict} (Jensen); nearest at {worst['mask']}, K = {worst['n_frames']}: "
        f"{worst['ratio']:.6f} ± {worst['ratio_error']:.6f} ({sigmas:+.1f} standard errors from 1)."
    ]
    for row in pistons:
        if row["n_frames"] in (min(frames), 10, max(frames)):
            lines.append(
                f"Random pistons, {row['mask']}, K = {row['n_frames']}: {row['ratio']:.6f} ± {row['ratio_error']:.6f}."
            )
    for name in dict.fromkeys(row["mask"] for row in rows):
        screens = [row for row in rows if row["mask"] == name and row["model"] == "von_karman"]
        low, high = min(screens, key=lambda row: row["ratio"]), max(screens, key=lambda row: row["ratio"])
        sampling = round(100 * low["sampling_error"], 2) + 0.0  # no "-0.00"
        lines.append(
            f"Von Karman screens, D/r0 = {d_over_r0:g}, {name}: the ratio goes from {low['ratio']:.4f} at "
            f"K = {low['n_frames']} to {high['ratio']:.4f} at K = {high['n_frames']}, of which the sampling of the "
            f"pupil makes about {sampling:+.2f} %. Jensen does not bind here: these OTFs are not those of independent "
            "uniform pistons."
        )
    return lines


def markdown(setting: str, found: Sequence[str], rows: Sequence[dict[str, Any]]) -> str:
    """Return the report as Markdown: the setting, the findings and the table."""
    lines = [
        "# The Wiener MSE of K exposures against its asymptotic limit",
        "",
        f"{setting} Relative MSE; ± is one standard error of independent draws.",
        "",
        *(f"- {line}" for line in found),
        "",
        "| mask | model | K | MSE_a | Wiener MSE | ratio | draws |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in rows:
        lines.append(
            f"| {row['mask']} | {MODELS[row['model']]} | {row['n_frames']} | {row['mse_a']:.6f} | "
            f"{row['wiener_mse']:.6f} ± {row['standard_error']:.6f} | {row['ratio']:.6f} ± {row['ratio_error']:.6f} | "
            f"{row['n_draws']} |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(d_over_r0: float, rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the errors against K, and by how much they exceed the limit; where they do not, there is no point below."""
    frames = [row["n_frames"] for row in rows]
    names = list(dict.fromkeys(row["mask"] for row in rows))
    sheet = new_figure(4.1 * len(names), 5.4)
    axes = sheet.subplots(2, len(names), sharex=True, squeeze=False, height_ratios=[1.2, 1])
    for name, (top, bottom) in zip(names, axes.T, strict=True):
        own = [row for row in rows if row["mask"] == name]
        panel(top, bottom, own)
        top.set(title=name, xscale="log")
    axes[0, 0].set_ylabel("relative MSE")
    axes[1, 0].set_ylabel("excess over MSE$_a$ [%]")
    axes[0, 0].legend()
    for ax in axes[1]:
        ax.set(xlabel="exposures K", yscale="log", ylim=(2e-4, 20))
        ax.axhline(0.1, color=FAINT, linewidth=0.8, zorder=0)
        ax.set_yticks([1e-3, 1e-2, 0.1, 1, 10])
        ax.yaxis.set_major_formatter("{x:g}")
        ax.set_xticks([k for k in (1, 2, 5, 10, 20, 50, 100, 200, 500) if k <= max(frames)])
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
    sheet.suptitle(
        f"Many short exposures reach MSE$_a$ (von Karman screens: D/r$_0$ = {d_over_r0:g})", x=0.02, ha="left"
    )
    return sheet


def panel(top: Axes, bottom: Axes, rows: Sequence[dict[str, Any]]) -> None:
    """Draw one mask: MSE above, excess below."""
    for model, color, marker in zip(MODELS, COLORS, "os", strict=False):
        own = [row for row in rows if row["model"] == model]
        k = [row["n_frames"] for row in own]
        if model == "pistons":
            top.plot(k, [row["mse_a"] for row in own], color=FAINT, label="MSE$_a$")
        style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 4, "linestyle": "none", "capsize": 2}
        top.errorbar(
            k, [r["wiener_mse"] for r in own], [r["standard_error"] for r in own], label=MODELS[model], **style
        )
        style |= {"linestyle": "-", "linewidth": 0.8}
        excess = [100 * (row["ratio"] - 1) for row in own]
        bottom.errorbar(k, excess, [100 * row["ratio_error"] for row in own], **style)
