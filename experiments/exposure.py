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
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from observing import ObservingOptions, check, observe, page, smoke
from trade import Trade, figure, predictions

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run


@dataclass(frozen=True, kw_only=True)
class Options(ObservingOptions):
    """Options of the restorations."""

    exposures: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """Exposure times of a frame, T / tau0."""
    n_photons: float = 1e5
    """Electrons through the mask in tau0."""


def kept_contrast(exposure: float) -> float:
    """E|V|^2 that two independent points keep at T / tau0: the integral of 2 (1 - x) exp(-(x T/tau0)^(5/3)) over
    [0, 1]."""
    x = (np.arange(4000) + 0.5) / 4000
    return float((2 * (1 - x) * np.exp(-((x * exposure) ** (5 / 3)))).mean())


def run(options: Options) -> None:
    """Simulate, restore and compare in a new folder."""
    if options.smoke:
        options = smoke(options, exposures=(0.5, 2.0))
    check(options, exposures=options.exposures)
    with new_run("exposure", options) as output:
        # at a fixed source
        settings = [{"exposure": t, "n_photons": options.n_photons * t} for t in options.exposures]
        rows = observe(options, "exposure", settings, output.callback)
        trade = Trade("exposure", "T/tau0", "exposure T / tau$_0$", kept_contrast, "by two independent points")
        cells = trade.summarise(rows, predictions(options, "exposure", settings, output.callback))
        found = trade.findings(cells)
        text = page(options, "Exposure time", found, cells, trade.columns, "The light is that in tau0.")
        output.report("exposure", {"cells": cells, "rows": rows}, text, figure(trade, cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("exposure", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
