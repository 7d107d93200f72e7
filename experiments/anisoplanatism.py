"""Where one PSF for the whole field stops being enough: fields wider than the isoplanatic angle.

    python experiments/anisoplanatism.py                   # fields of 1/4 to 4 theta0, four shares of height
    python experiments/anisoplanatism.py --d-over-r0 7     # stronger turbulence
    python experiments/anisoplanatism.py --smoke           # everything, tiny, in seconds

Two layers, one at the pupil and one in height, are looked through in every direction of the scene; the restoration
knows one PSF for each frame, as if the field were isoplanatic. The field is the larger side of the scene. First half
of the turbulence is so high that the field is a given multiple of theta0; then the height is that of --share-field, and
the share of the turbulence there varies. Every score is held against that of the same turbulence lying at the pupil,
with the same seeds: on the axis both have the same PSFs.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mask_vs_full_report import INSTRUMENTS
from observing import DIAMETER, SIZE, WAVELENGTH, ObservingOptions, check, curves, observe, page, scores, smoke

from torchmask.atmosphere.layers import Layers
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.grid import Grid
from torchmask.viz.style import FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ENOUGH = 1.1  # times the isoplanatic score: up to here one PSF is enough


@dataclass(frozen=True, kw_only=True)
class Options(ObservingOptions):
    """Options of the restorations."""

    fields: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0)
    """Values of the scene's larger side over theta0, with half of the turbulence in the high layer."""
    shares: tuple[float, ...] = (0.1, 0.25, 0.5, 1.0)
    """Shares of the turbulence in the high layer, at the height set by --share-field."""
    share_field: float = 2.0
    """Field over theta0, for a share of one half, that sets the height of the layer whose share varies."""
    n_photons: float = 1e7
    """Electrons per frame through the mask."""


def height_of(options: Options, field: float) -> float:
    """Return the height [m] at which half of the turbulence makes the scene `field` times theta0 wide."""
    r0, grid = DIAMETER / options.d_over_r0, Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels)
    at_1_m = Layers.from_fractions(r0, WAVELENGTH, [0.0, 1.0], [0.5, 0.5]).theta0(WAVELENGTH)
    return field * at_1_m / (SIZE * options.n_pixels * grid.pixel_scale)


def setting(height: float, share: float, field: float | None) -> dict[str, Any]:
    """Return a task's layers, and what it is held against: the same screens at the pupil."""
    heights, shares = ((0.0, height), (1 - share, share)) if share < 1 else ((height,), (1.0,))
    return {"layers": (heights, shares), "share": share, "field": field}


def settings_of(options: Options) -> list[dict[str, Any]]:
    """Return what is simulated: both sweeps, and for each share the same turbulence at the pupil, of field 0."""
    sweep = [setting(height_of(options, field), 0.5, field) for field in options.fields]
    height = height_of(options, options.share_field)
    varied = [setting(height, share, options.share_field * (share / 0.5) ** 0.6) for share in options.shares]
    still = [setting(0.0, share, 0.0) for share in dict.fromkeys((0.5, *options.shares))]
    return list({str(one): one for one in (*sweep, *varied, *still)}.values())


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one cell for each instrument, share and field, with its ratio to the isoplanatic score."""
    cells = []
    for which, share, field in dict.fromkeys((row["instrument"], row["share"], row["field"]) for row in rows):
        alike = [row for row in rows if (row["instrument"], row["share"]) == (which, share)]
        own, still = ([row for row in alike if row["field"] == value] for value in (field, 0.0))
        cells.append({"instrument": which, "share": share, "field": field} | scores(own, still))
    return cells


def limit(cells: Sequence[Mapping[str, Any]]) -> str:
    """Return up to which field one PSF is enough, and from which on it is not, as far as the error bars tell."""
    enough = [cell["field"] for cell in cells if cell["ratio_high"] <= ENOUGH]
    beyond = [cell["field"] for cell in cells if cell["ratio_low"] > ENOUGH]
    first = f"is enough up to {max(enough):g} theta0" if enough else "is not shown to be enough at any field"
    return f"{first}, and no longer from {min(beyond):g} theta0 on" if beyond else f"{first}, and nowhere shown to fail"


def findings(cells: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return where an isoplanatic restoration stops being enough, for each instrument."""
    lines = []
    for which, name in INSTRUMENTS.items():
        own = sorted(
            (cell for cell in cells if cell["instrument"] == which and cell["share"] == 0.5 and cell["field"] > 0),
            key=lambda cell: cell["field"],
        )
        if own:
            worst = own[-1]
            lines.append(
                f"{name}: with half of the turbulence in height one PSF for the field {limit(own)} (a score within "
                f"{100 * (ENOUGH - 1):.0f} % of the isoplanatic one counts as enough). At {worst['field']:g} theta0 "
                f"the score is {worst['ratio']:.2f} times as large, {worst['score']:.3f}."
            )
    return lines


@styled
def figure(cells: Sequence[Mapping[str, Any]], options: Options) -> Figure:
    """Draw the score against the field, over the isoplanatic one, and against the share in height."""
    sheet = new_figure(5.2, 8.6)
    axes = sheet.subplots(3, 1)
    by_field = sorted((c for c in cells if c["share"] == 0.5 and c["field"] > 0), key=lambda cell: cell["field"])
    varied = sorted(
        (c for c in cells if c["share"] in options.shares and is_varied(c, options)), key=lambda c: c["share"]
    )
    for ax, value, label in zip(
        axes, ("score", "ratio"), ("score (0 is perfect)", "score / isoplanatic"), strict=False
    ):
        curves(ax, by_field, "field", value)
        ax.set(xscale="log", xlabel="field / theta$_0$", ylabel=label)
        ax.set_xticks(options.fields, [f"{field:g}" for field in options.fields])
        ax.minorticks_off()
    curves(axes[2], varied, "share", "ratio")
    axes[2].set(xlabel="share of the turbulence in height", ylabel="score / isoplanatic", xlim=(0, 1.05))
    for ax in axes[1:]:
        ax.axhline(1, color=FAINT, linewidth=0.8)
        ax.axhline(ENOUGH, color=FAINT, linewidth=0.8, linestyle="--")
    sheet.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=2)
    return sheet


def is_varied(cell: Mapping[str, Any], options: Options) -> bool:
    """Return whether a cell lies at the height of the sweep over shares."""
    return abs(cell["field"] - options.share_field * (cell["share"] / 0.5) ** 0.6) < 1e-9


def run(options: Options) -> None:
    """Simulate, restore and compare, with results in a new folder."""
    if options.smoke:
        options = smoke(options, fields=(0.5, 2.0), shares=(0.25, 1.0))
    check(options, fields=options.fields, shares=options.shares)
    if max(options.shares) > 1 or not options.share_field > 0:
        raise ValueError(
            f"shares is {options.shares} and share_field {options.share_field}: shares are at most 1, and the field is "
            "positive"
        )
    with new_run("anisoplanatism", options) as output:
        rows = observe(options, "anisoplanatism", settings_of(options), output.callback)
        cells = summarise(rows)
        found = findings(cells)
        columns = {"share": "share in height", "field": "field / theta0", "ratio": "score / isoplanatic"}
        text = page(options, "Anisoplanatism", found, cells, columns)
        output.report("anisoplanatism", {"cells": cells, "rows": rows}, text, figure(cells, options))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("anisoplanatism", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
