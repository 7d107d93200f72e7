"""How wide a filter should be: more light against less contrast, at a fixed source.

    python experiments/band.py                             # filters of 2 to 40 percent of the wavelength, three seeds
    python experiments/band.py --n-photons 1e4             # a fainter source
    python experiments/band.py --smoke                     # everything, tiny, in seconds

A filter of even transmission collects light in proportion to its width, while the path differences of the turbulence
blur the fringes of its wavelengths, and each wavelength has baselines of its own. Mask and full pupil are restored by
the library's defaults, which are told the band as five wavelengths, as `torchmask restore` is; the light has nine.
Pixels are small enough for the shortest wavelength of the widest filter. --n-photons is the light in a tenth of the
wavelength.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from observing import ObservingOptions, check, observe, page, smoke
from trade import Trade, figure, predictions

from torchmask.cli.program import run_script
from torchmask.cli.run import new_run

N_SIMULATED = 9  # wavelengths of the light: more than are told, so that what these leave out costs something
N_TOLD = 5  # those of `torchmask restore`


@dataclass(frozen=True, kw_only=True)
class Options(ObservingOptions):
    """Options of the restorations."""

    widths: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.4)
    """Widths of the filter over the wavelength."""
    n_photons: float = 1e5
    """Electrons per frame through the mask in a filter of a tenth of the wavelength."""


def kept_contrast(width: float, d_over_r0: float) -> float:
    """E|V|^2 that path differences leave to a top hat, uniform in wavelength, on the baseline D: the mean of
    exp(-(a - a')^2 D(b) / 2) over its pairs of wavelengths, a = 1 / (1 + x)."""
    a = 1 / (1 + width * ((np.arange(200) + 0.5) / 200 - 0.5))
    return float(np.exp(-((a[:, None] - a) ** 2) * 6.88 * d_over_r0 ** (5 / 3) / 2).mean())


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
        common = {"oversampling": finer, "n_simulated": N_SIMULATED, "n_told": N_TOLD}
        settings = [common | {"band": width, "n_photons": options.n_photons * width / 0.1} for width in options.widths]
        rows = observe(options, "band", settings, output.callback)
        trade = Trade(
            key="band",
            name="width/wavelength",
            label="width / wavelength",
            kept=lambda width: kept_contrast(width, options.d_over_r0),
            where="on the baseline D",
        )
        cells = trade.summarise(rows, predictions(options, "band", settings, output.callback))
        found = trade.findings(cells)
        text = page(
            options,
            "Width of the band",
            found,
            cells,
            trade.columns,
            note="The light is that in a tenth of the wavelength.",
        )
        output.report("band", {"cells": cells, "rows": rows}, text, figure(trade, cells))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("band", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
