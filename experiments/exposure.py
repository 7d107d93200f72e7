"""How long an exposure should be: more light against less contrast, at a fixed source.

    python experiments/exposure.py                         # exposures of 1/4 to 4 tau0, three seeds
    python experiments/exposure.py --n-photons 1e4         # a fainter source
    python experiments/exposure.py --smoke                 # everything, tiny, in seconds

A frame that lasts T collects light in proportion to T, while the turbulence drifts over the pupil (one layer of frozen
flow) and blurs the fringes. Mask and full pupil are restored by the library's defaults, which do not know of the
exposure time, from as many frames at every T. --n-photons is the light in tau0 = 0.314 r0 / wind.
"""

from __future__ import annotations

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

    exposures: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """How long a frame lasts, T / tau0."""
    n_photons: float = 1e5
    """Electrons through the mask in tau0."""


def kept_contrast(exposure: float) -> float:
    """E|V|^2 that two independent points keep at T / tau0: the integral of 2 (1 - x) exp(-(x T/tau0)^(5/3)) over
    [0, 1]."""
    x = (np.arange(4000) + 0.5) / 4000
    return float((2 * (1 - x) * np.exp(-((x * exposure) ** (5 / 3)))).mean())


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """One cell for each instrument and exposure."""
    keys = dict.fromkeys((row["instrument"], row["exposure"]) for row in rows)
    return [
        {"instrument": which, "exposure": exposure, "kept": kept_contrast(exposure)}
        | scores([row for row in rows if (row["instrument"], row["exposure"]) == (which, exposure)])
        for which, exposure in keys
    ]


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """The optimum of each instrument."""
    lines = []
    for which, name in INSTRUMENTS.items():
        own = [cell for cell in cells if cell["instrument"] == which]
        if own:
            best = min(own, key=lambda cell: cell["score"])
            lines.append(
                f"The {name} is best at T/tau0 = {optimum(own, 'exposure')}, with a score of {best['score']:.3f}; two "
                f"independent points keep {best['kept']:.3f} of V^2 there."
            )
    return lines


@styled
def figure(cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Score against exposure, and what two points keep of their contrast."""
    sheet = new_figure(5.4, 3.6)
    ax = sheet.subplots()
    curves(ax, cells, "exposure")
    ax.set(xscale="log", xlabel="exposure T / tau$_0$", ylabel="score (0 is perfect)")
    ticks = sorted({cell["exposure"] for cell in cells})
    ax.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    ax.minorticks_off()
    beside = ax.twinx()
    fine = np.geomspace(ticks[0], ticks[-1], 50)
    beside.plot(fine, [kept_contrast(x) for x in fine], "--", color=FAINT)
    beside.set(ylim=(0, 1.02), ylabel="V$^2$ kept by two points (dashed)")
    sheet.legend(*ax.get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet


def run(options: Options) -> None:
    """Simulate, restore and compare in a new folder."""
    if options.smoke:
        options = smoke(options, exposures=(0.5, 2.0))
    check(options, exposures=options.exposures)
    with new_run("exposure", options) as output:
        # at a fixed source
        settings = [{"exposure": t, "n_photons": options.n_photons * t} for t in options.exposures]
        rows = observe(options, "exposure", settings, output.callback)
        cells = summarise(rows)
        found = findings(cells)
        columns = {"exposure": "T / tau0", "kept": "V^2 kept by two points"}
        lines = ["# Exposure time", "", setting_of(options), "The light is that in tau0.", ""]
        lines += [*(f"- {line}" for line in found), "", *table(cells, columns)]
        output.report("exposure", {"cells": cells, "rows": rows}, "\n".join(lines) + "\n", figure(cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status."""
    return run_script("exposure", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
