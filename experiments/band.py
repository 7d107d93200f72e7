"""How wide a filter should be: more light against less contrast, at a fixed source.

    python experiments/band.py                             # filters of 2 to 40 percent of the wavelength, three seeds
    python experiments/band.py --n-photons 1e4             # a fainter source
    python experiments/band.py --smoke                     # everything, tiny, in seconds

A filter of even transmission collects light in proportion to its width, while the path differences of the turbulence
blur the fringes of its wavelengths, and each wavelength has baselines of its own. Mask and full pupil are restored by
the library's defaults, which are told the band as three wavelengths. Pixels are small enough for the shortest
wavelength of the widest filter. --n-photons is the light in a tenth of the wavelength.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from mask_vs_full_report import INSTRUMENTS
from observing import ObservingOptions, check, curves, observe, optimum, scores, setting_of, smoke, table

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.viz.style import FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Options(ObservingOptions):
    """What the restorations depend on."""

    widths: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.4)
    """Of the filter, over the wavelength."""
    n_photons: float = 1e5
    """Electrons per frame through the mask in a filter of a tenth of the wavelength."""


def kept_contrast(width: float, d_over_r0: float) -> float:
    """E|V|^2 that path differences leave to a top hat, uniform in wavelength, on the baseline D: the mean of
    exp(-(a - a')^2 D(b) / 2) over its pairs of wavelengths, a = 1 / (1 + x)."""
    a = 1 / (1 + width * ((np.arange(200) + 0.5) / 200 - 0.5))
    return float(np.exp(-((a[:, None] - a) ** 2) * 6.88 * d_over_r0 ** (5 / 3) / 2).mean())


def summarise(rows: Sequence[Mapping[str, Any]], d_over_r0: float) -> list[dict[str, Any]]:
    """One cell for each instrument and width."""
    keys = dict.fromkeys((row["instrument"], row["band"]) for row in rows)
    return [
        {"instrument": which, "band": band, "kept": kept_contrast(band, d_over_r0)}
        | scores([row for row in rows if (row["instrument"], row["band"]) == (which, band)])
        for which, band in keys
    ]


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """The optimum of each instrument."""
    lines = []
    for which, name in INSTRUMENTS.items():
        own = [cell for cell in cells if cell["instrument"] == which]
        if own:
            best = min(own, key=lambda cell: cell["score"])
            lines.append(
                f"The {name} is best at width/wavelength = {optimum(own, 'band')}, with a score of "
                f"{best['score']:.3f}; the baseline D keeps {best['kept']:.3f} of V^2 there."
            )
    return lines


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Score against width, and what the longest baseline keeps of its contrast."""
    sheet = new_figure(5.4, 3.6)
    ax = sheet.subplots()
    curves(ax, cells, "band")
    ax.set(xscale="log", xlabel="width / wavelength", ylabel="score (0 is perfect)")
    ticks = sorted({cell["band"] for cell in cells})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    beside = ax.twinx()
    beside.plot(ticks, [next(c["kept"] for c in cells if c["band"] == tick) for tick in ticks], "--", color=FAINT)
    beside.set(ylim=(0, 1.02), ylabel="V$^2$ kept on the baseline D (dashed)")
    sheet.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet


def run(options: Options) -> None:
    """Simulate, restore and compare in a new folder."""
    if options.smoke:
        options = smoke(options, widths=(0.05, 0.2))
    check(options, widths=options.widths)
    widest = max(options.widths)
    if widest >= 1:
        raise ValueError(f"widths is {options.widths}: a filter must be narrower than the wavelength")
    with new_run("band", options) as output:
        finer = math.ceil(100 / (1 - widest / 2)) / 100
        # at a fixed source
        settings = [
            {"band": width, "n_photons": options.n_photons * width / 0.1, "oversampling": finer}
            for width in options.widths
        ]
        rows = observe(options, "band", settings, output.callback)
        cells = summarise(rows, options.d_over_r0)
        found = findings(cells)
        columns = {"band": "width / wavelength", "kept": "V^2 kept on the baseline D"}
        lines = ["# Width of the band", "", setting_of(options), "The light is that in a tenth of the wavelength.", ""]
        lines += [*(f"- {line}" for line in found), "", *table(cells, columns)]
        output.report("band", {"cells": cells, "rows": rows}, "\n".join(lines) + "\n", figure(cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status."""
    return run_script("band", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
