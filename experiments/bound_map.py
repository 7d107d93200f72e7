"""What unknown aberrations cost at least, over the number of frames and the light: the local Cramer-Rao bound.

    python experiments/bound_map.py                             # 176 bounds: five minutes of one core
    python experiments/bound_map.py --frames 1 2 --draws 3 3    # fewer of them, in seconds
    python experiments/bound_map.py --smoke                     # everything, tiny, in seconds

Around the truth, with the packaged satellite as the object, `myopic_bound` says by how much the error of an estimate
that has to find the aberrations exceeds that of the Wiener estimate, which knows them. Every draw has aberrations of
its own, the same for each flux; with few frames draws differ most.

Table, figure and numbers go to a new folder; every bound is kept in --sweep, from which a run that was stopped goes on.
"""

from __future__ import annotations

import itertools
import statistics
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch
from map_draws import FILL_FACTOR, OUTER_SCALE, READOUT_NOISE, of_pupil
from mask_vs_full_options import DIAMETER, WAVELENGTH
from searched_masks import search_masks

from torchmask.cli.options import SweepOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.sweep import run_tasks
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.planning.bounds import myopic_bound
from torchmask.record import Callback
from torchmask.simulation.scene import make_scene
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.style import COLORS, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

N_HOLES, EXPONENT = 11, 1.5
KEYS = ("n_modes", "n_frames", "n_photons")


@dataclass(frozen=True, kw_only=True)
class Options(SweepOptions):
    """Where the bound is computed."""

    frames: tuple[int, ...] = (1, 2, 5, 10, 20)
    """Numbers of short exposures."""
    draws: tuple[int, ...] = (8, 6, 4, 2, 2)
    """Draws of the aberrations for each of the numbers of frames."""
    photons: tuple[float, ...] = (1e4, 1e5, 1e6, 1e7)
    """Electrons per frame through the mask."""
    modes: tuple[int, ...] = (6, 15)
    """Zernike modes per sub-aperture, drawn and to be found."""
    strength: float = 7.0
    """Strength of the turbulence, D / r0."""
    n_pixels: int = 64
    """Number of pixels per side of the image."""


def bound(task: Mapping[str, Any]) -> dict[str, Any]:
    """Relative errors with known and with unknown aberrations, and the part of both that no mask can avoid."""
    mask = SparseAperture(task["centers"], task["subaperture_diameter"], DIAMETER)
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, task["n_pixels"])
    photons = task["n_photons"]
    signal, noise = PowerLawPSD(EXPONENT, photons), NoisePSD(photons, READOUT_NOISE)
    found = myopic_bound(
        *(make_scene(grid.shape, photons), mask, grid, signal, noise, task["n_frames"], task["n_modes"]),
        r0=DIAMETER / task["strength"],
        outer_scale=OUTER_SCALE,
        generator=torch.Generator().manual_seed(task["draw"]),
    )
    floor = float(AsymptoticMSE(grid, signal, noise, 1).floor(DIAMETER) / signal(grid).mean())
    return {"known": found.known, "unknown": found.unknown, "floor": floor}


def measure(options: Options, mask: SparseAperture, callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each bound."""
    common = {"strength": options.strength, "n_pixels": options.n_pixels} | of_pupil(mask)
    points = [
        dict(zip(KEYS, (modes, n_frames, photons), strict=True)) | {"draw": draw}
        for n_frames, draws in zip(options.frames, options.draws, strict=True)
        for draw, modes, photons in itertools.product(range(draws), options.modes, options.photons)
    ]
    tasks = [common | point for point in points]
    found = run_tasks(bound, tasks, options.sweep / "tasks", stage="bound_map", **options.keywords(callback))
    return [
        point | row | {"excess": row["unknown"] / row["known"] - 1} for point, row in zip(points, found, strict=True)
    ]


def summarise(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a cell for each combination of modes, frames and photons, with means over the draws.

    excess : by how much unknown exceeds known, over known; least and most are those of the draws
    avoidable : the same over known less the floor
    """
    cells = []
    for key in sorted({tuple(row[name] for name in KEYS) for row in rows}):
        own = [row for row in rows if tuple(row[name] for name in KEYS) == key]
        excesses = [row["excess"] for row in own]
        more = statistics.mean(row["unknown"] - row["known"] for row in own)
        known = statistics.mean(row["known"] for row in own)
        cells.append(
            dict(zip(KEYS, key, strict=True))
            | {"draws": len(own), "known": known, "floor": own[0]["floor"], "excess": statistics.mean(excesses)}
            | {"least": min(excesses), "most": max(excesses), "avoidable": more / (known - own[0]["floor"])}
        )
    return cells


def markdown(options: Options, cells: Sequence[Mapping[str, Any]]) -> str:
    """Return the report as Markdown."""
    photons = sorted({cell["n_photons"] for cell in cells})
    lines = [
        "# What unknown aberrations cost at least",
        "",
        "Excess of the bound over the Wiener error for known aberrations in per cent, mean of the draws, by photons a "
        "frame; in brackets that over what of the Wiener error a mask can avoid. Packaged satellite on "
        f"{options.n_pixels} x {options.n_pixels} pixels, "
        f"{N_HOLES} holes searched at a fill factor of {FILL_FACTOR:g}, D/r0 = {options.strength:g}, outer scale "
        f"{OUTER_SCALE / DIAMETER:g} D, {READOUT_NOISE:g} electrons of read-out noise, p = {EXPONENT:g}.",
        "",
        "| modes a hole | frames | draws | " + " | ".join(f"{n:.0e}".replace("e+0", "e") for n in photons) + " |",
        "|---" * (3 + len(photons)) + "|",
    ]
    for (modes, frames), own in itertools.groupby(cells, key=lambda cell: (cell["n_modes"], cell["n_frames"])):
        row = list(own)
        texts = [f"{percent(cell['excess'])} ({percent(cell['avoidable'])})" for cell in row]
        lines.append(f"| {modes} | {frames} | {row[0]['draws']} | {' | '.join(texts)} |")
    return "\n".join(lines) + "\n"


def percent(share: float) -> str:
    """Return a share in per cent, in two figures: 0.052, 0.22, 8.4, 12."""
    decimals = max(0, 1 - int(f"{100 * share:.1e}".split("e")[1]))
    return f"{100 * share:.{decimals}f}"


@styled
def figure(rows: Sequence[Mapping[str, Any]], cells: Sequence[Mapping[str, Any]]) -> Figure:
    """Excess over the number of frames: a panel for each number of modes, a line for each flux, a dot for each draw."""
    numbers, frames = (sorted({cell[name] for cell in cells}) for name in ("n_modes", "n_frames"))
    photons = sorted({cell["n_photons"] for cell in cells})
    sheet = new_figure(2.9 * len(numbers), 3.4)
    axes = sheet.subplots(1, len(numbers), sharex=True, sharey=True, squeeze=False)[0]
    for (ax, modes), (flux, color) in itertools.product(
        zip(axes, numbers, strict=True), zip(photons, itertools.cycle(COLORS), strict=False)
    ):
        own, every = (
            [row for row in given if (row["n_modes"], row["n_photons"]) == (modes, flux)] for given in (cells, rows)
        )
        x, y = ([row[name] for row in every] for name in ("n_frames", "excess"))
        ax.plot(x, [100 * value for value in y], ".", color=color, alpha=0.35, ms=4)
        x, y = ([cell[name] for cell in own] for name in ("n_frames", "excess"))
        ax.plot(x, [100 * value for value in y], "o-", color=color, ms=4, label=f"{flux:.0e}".replace("e+0", "e"))
        ax.set(xscale="log", yscale="log", title=f"{modes} modes a hole", xlabel="frames")
        ax.set_xticks(frames, [f"{n}" for n in frames])
        ax.set_yticks([0.1, 1, 10], ["0.1", "1", "10"])
        ax.minorticks_off()
    axes[0].set_ylabel("excess over known aberrations [%]")
    sheet.legend(*axes[0].get_legend_handles_labels(), title="photons per frame", loc="outside upper center", ncols=4)
    return sheet


def run(options: Options) -> None:
    """Search the mask, bound and compare in a new folder.

    Raises ValueError unless there are as many numbers of draws as of frames.
    """
    if options.smoke:
        options = replace(options, frames=(1, 2), draws=(2, 1), photons=(1e5, 1e6), modes=(3, 6), n_pixels=32)
    if len(options.draws) != len(options.frames):
        raise ValueError(f"draws is {options.draws}: one number is needed for each of frames, {options.frames}")
    with new_run("bound_map", options) as output:
        mask = search_masks([N_HOLES], FILL_FACTOR, options, output.callback)[N_HOLES]
        rows = measure(options, mask, output.callback)
        cells = summarise(rows)
        text = markdown(options, cells)
        output.report("bound_map", {"cells": cells, "rows": rows}, text, figure(rows, cells))
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("bound_map", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
