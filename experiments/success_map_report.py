"""Code of `success_map` that turns restorations into counts, a table and the figure."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from torchmask.planning.success import SUCCESS
from torchmask.viz.style import COLORS, INK, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEYS = ("n_frames", "n_photons", "d_over_r0")


def summarise(rows: Sequence[Mapping[str, Any]], factors: Mapping[tuple[Any, ...], float]) -> list[dict[str, Any]]:
    """Return a cell for each combination of frames, photons and d/r0."""
    cells = []
    for key in sorted({tuple(row[name] for name in KEYS) for row in rows}):
        own = [row for row in rows if tuple(row[name] for name in KEYS) == key]
        ratios = [row["score"] / row["known"] for row in own]
        cells.append(
            dict(zip(KEYS, key, strict=True))
            | {"tried": len(own), "succeeded": sum(ratio <= SUCCESS for ratio in ratios)}
            | {"cost": statistics.median(ratios), "bound": factors.get(key)}
            | {"level": statistics.geometric_mean(row["known"] / row["predicted"] for row in own)}
            | {name: statistics.geometric_mean(row[name] for row in own) for name in ("known", "score")}
        )
    return cells


def markdown(setting: str, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown."""
    strengths = sorted({cell["d_over_r0"] for cell in cells})
    lines = ["# Where blind restorations succeed", "", setting, ""]
    lines += [
        f"Successes of those tried (score within {SUCCESS:g} of that for known PSFs), and the median ratio.",
        "",
    ]
    lines += ["| frames | photons | " + " | ".join(f"d/r0 = {size:g}" for size in strengths) + " |"]
    lines += ["|---" * (2 + len(strengths)) + "|"]
    for (frames, photons), own in itertools.groupby(cells, key=lambda cell: (cell["n_frames"], cell["n_photons"])):
        texts = [f"{cell['succeeded']} of {cell['tried']}, {cell['cost']:.2f}" for cell in own]
        lines.append(f"| {frames} | {photons:.0e} | {' | '.join(texts)} |".replace("e+0", "e"))
    return "\n".join(lines) + "\n"


@styled
def figure(rows: Sequence[Mapping[str, Any]], cells: Sequence[Mapping[str, Any]], sizes: Sequence[float]) -> Figure:
    """Known, bound and blind over the photons: a column for each number of frames, a row for each of some d/r0."""
    numbers = sorted({cell["n_frames"] for cell in cells})
    sheet = new_figure(1.0 + 1.4 * len(numbers), 0.9 + 1.8 * len(sizes))
    axes = sheet.subplots(len(sizes), len(numbers), sharex=True, sharey=True, squeeze=False)
    least = min(cell["known"] for cell in cells)
    ticks = [tick for tick in (0.02, 0.05, 0.1, 0.2, 0.5) if tick > least]
    for (i, size), (j, n_frames) in itertools.product(enumerate(sizes), enumerate(numbers)):
        ax, place = axes[i][j], (n_frames, size)
        own = [cell for cell in cells if (cell["n_frames"], cell["d_over_r0"]) == place]
        every = [row for row in rows if (row["n_frames"], row["d_over_r0"]) == place]
        photons = [cell["n_photons"] for cell in own]
        known = [cell["known"] for cell in own]
        ax.plot(
            [row["n_photons"] for row in every], [row["score"] for row in every], ".", color=COLORS[1], alpha=0.35, ms=4
        )
        ax.plot(photons, [cell["score"] for cell in own], "o-", color=COLORS[1], ms=4, label="blind")
        if all(cell["bound"] for cell in own):
            ax.plot(photons, [cell["known"] * cell["bound"] for cell in own], "-", color=COLORS[0], label="bound")
        ax.plot(photons, known, "--", color=INK, lw=1.1, label="known PSFs")
        ax.set(xscale="log", yscale="log")
        ax.set_title(f"{n_frames} frame{'s' * (n_frames > 1)}, {size:g} r$_0$")
        ax.set_yticks(ticks, map(str, ticks))
        ax.minorticks_off()
    sheet.supxlabel("photons per frame", fontsize=9)
    sheet.supylabel("score (0 is perfect)", fontsize=9)
    sheet.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return sheet
