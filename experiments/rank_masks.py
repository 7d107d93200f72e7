"""Rank the masks of the catalogue, and this library's own, by MSE_a at equal collecting area.

    python experiments/rank_masks.py
    python experiments/rank_masks.py --fill-factor 0.05         # small holes, which more of the patterns can carry
    python experiments/rank_masks.py --smoke                    # everything, tiny, in seconds

Every pattern is laid afresh in a disc of 1 m: its smallest enclosing circle centred, its outermost holes touching the
rim, its holes of one size such that all masks collect the same light. Hexagonal holes stay hexagons of the same area as
the discs. A pattern whose holes would overlap at this area is not ranked, and the largest area it can carry is given.
Case: 550 nm, Nyquist, p = 1.5, 1e7 photons, K = 20. The table, as CSV, markdown and JSON, its picture and
our own masks go to a new folder.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import Run, new_run
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import save_json
from torchmask.design.redundancy import analyse_redundancy
from torchmask.design.search import search_mask
from torchmask.grid import Grid
from torchmask.io import atomic_write
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.shapes import Disc, Shape
from torchmask.record import Callback, label_stage
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIAMETER, WAVELENGTH, N_PHOTONS, N_FRAMES = 1.0, 550e-9, 1e7, 20
HEADINGS = {
    "rank": "rank",
    "mask": "mask",
    "n_subapertures": "N",
    "relative_mse": "relative MSE",
    "above_floor": "above the floor",
    "excess_percent": "over our best, %",
    "distinct_baselines": "distinct baselines",
    "strictly_nonredundant": "strictly non-redundant",
    "uv_filling": "u-v filling",
    "fwhm": "PSF width, wavelength/D",
    "side_lobe": "side lobe",
}

ON_TERMINAL = ("rank", "mask", "n_subapertures", "relative_mse", "above_floor", "excess_percent")  # 80 columns wide


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """What the ranking depends on."""

    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of round holes; hexagons get the same area."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    n_frequencies: int = 256
    """Number of samples per side of the criterion's frequency grid."""
    own: tuple[int, ...] = (3, 6, 7, 9, 10, 11, 12)
    """Numbers of holes for which this library searches a mask."""
    budget: int = 20_000
    """Number of evaluations of each search."""
    seed: int = 0
    """Seed of the searches."""


def make_criterion(options: Options) -> AsymptoticMSE:
    """The reference case."""
    return AsymptoticMSE(
        Grid.nyquist(DIAMETER, WAVELENGTH, options.n_frequencies),
        PowerLawPSD(options.exponent, N_PHOTONS),
        NoisePSD(N_PHOTONS),
        n_frames=N_FRAMES,
    )


def largest_fill_factor(entry: catalog.CatalogEntry) -> float:
    """The largest N d^2 / D^2 (in area of round holes) at which the holes of a pattern do not overlap.

    With gap m between the closest centres and radius R of their enclosing circle, holes of size d and outer size c d
    fit if d <= m s and c d + 2 R s <= D for some scale s.
    """
    centers = np.array(entry.centers)
    _, radius = catalog.smallest_enclosing_circle(centers)
    first, second = np.triu_indices(len(centers), 1)
    gap = float(entry.shape.separation(torch.from_numpy(centers[first] - centers[second])).min())
    relative = gap / (2 * radius + entry.shape.outer_diameter(gap))
    return len(centers) * relative**2 * area_over_disc(entry.shape)


def area_over_disc(shape: Shape) -> float:
    """Area of a hole over that of a disc of the same diameter."""
    return shape.area(1.0) / Disc().area(1.0)


def lay_out(options: Options) -> tuple[dict[str, SparseAperture], dict[str, float]]:
    """The catalogue's masks at the common area, and those that cannot carry it with what they can."""
    masks, crowded = {}, {}
    for name in catalog.names():
        entry = catalog.entry(name)
        limit = largest_fill_factor(entry)
        if limit < options.fill_factor:
            crowded[name] = limit
            continue
        fill = options.fill_factor / area_over_disc(entry.shape)
        masks[name] = SparseAperture.from_catalog(name, DIAMETER, fill)
    return masks, crowded


def search_own(options: Options, criterion: AsymptoticMSE, callback: Callback) -> dict[str, SparseAperture]:
    """This library's masks."""
    masks = {}
    for n in options.own:
        result = search_mask(
            criterion,
            n,
            DIAMETER,
            options.fill_factor,
            seed=options.seed,
            budget=options.budget,
            callback=label_stage(callback, f"{n}_holes"),
        )
        masks[f"torchmask_{n}"] = result.aperture
    return masks


def rank(
    criterion: AsymptoticMSE, known: Mapping[str, SparseAperture], own: Mapping[str, SparseAperture]
) -> list[dict[str, Any]]:
    """A row for each mask, the best first."""
    total, floor = float(criterion.object_psd.mean()), float(criterion.floor(DIAMETER))
    best = {mask.n_subapertures: float(criterion(mask)) for mask in own.values()}
    rows = []
    for name, mask in {**known, **own}.items():
        mse, report = float(criterion(mask)), analyse_redundancy(mask)
        ours = best.get(mask.n_subapertures)
        rows.append(
            {
                "mask": name,
                "n_subapertures": mask.n_subapertures,
                "relative_mse": mse / total,
                "above_floor": (mse - floor) / total,
                "excess_percent": None if ours is None else 100 * (mse / ours - 1),
                "distinct_baselines": report.n_distinct,
                "strictly_nonredundant": report.strictly_nonredundant,
                "uv_filling": report.uv_filling,
                "fwhm": report.fwhm,
                "side_lobe": report.side_lobe,
            }
        )
    rows.sort(key=lambda row: row["relative_mse"])
    return [{"rank": place, **row} for place, row in enumerate(rows, 1)]


def cell(key: str, value: Any) -> str:
    """A number or answer as the tables show it."""
    if key == "excess_percent" and value is not None:
        return f"{value:.1f}"
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def as_csv(rows: Sequence[Mapping[str, Any]]) -> str:
    """All digits, for programs."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_markdown(options: Options, rows: Sequence[Mapping[str, Any]], crowded: Mapping[str, float]) -> str:
    """The table and what stands beside it, for readers."""
    lines = [
        f"# Masks ranked by MSE_a at a fill factor of {options.fill_factor:g}",
        "",
        f"D = {DIAMETER:g} m, {1e9 * WAVELENGTH:g} nm, Nyquist, {options.n_frequencies} frequencies a side, "
        f"p = {options.exponent:g}, {N_PHOTONS:g} photons, K = {N_FRAMES}. The floor is the part no mask can change; "
        "torchmask_N are this library's own masks, and `over our best` compares masks of the same N with them.",
        "",
        "| " + " | ".join(HEADINGS.values()) + " |",
        "|" + "---|" * len(HEADINGS),
        *("| " + " | ".join(cell(key, row[key]) for key in HEADINGS) + " |" for row in rows),
    ]
    if crowded:
        lines += ["", "Not ranked, because the holes would overlap (largest fill factor they can carry):", ""]
        lines += [f"- {name}: {limit:.4f}" for name, limit in sorted(crowded.items(), key=lambda pair: -pair[1])]
    return "\n".join(lines) + "\n"


@styled
def draw(options: Options, rows: Sequence[Mapping[str, Any]]) -> Figure:
    """The ranking as a list, and against the number of holes."""
    figure = new_figure(11, 2.2 + 0.17 * len(rows))
    ranking, against = figure.subplots(1, 2, width_ratios=[1, 1.1])
    ours = [row["mask"].startswith("torchmask") for row in rows]
    color = [COLORS[1] if own else COLORS[0] for own in ours]
    places, mse = [row["rank"] for row in rows], [row["relative_mse"] for row in rows]
    ranking.hlines(places, 0, mse, color=color, linewidth=1, alpha=0.5)
    ranking.scatter(mse, places, c=color, s=22, zorder=3)
    ranking.set_yticks(places, [row["mask"] for row in rows])
    ranking.tick_params(axis="y", length=0)
    ranking.invert_yaxis()
    floor = rows[0]["relative_mse"] - rows[0]["above_floor"]
    ranking.axvline(floor, color=FAINT, linestyle="--", linewidth=1)
    ranking.set_xlabel("relative MSE (dashed: what no mask can change)")
    ranking.set_title(f"The same collecting area, N d²/D² = {options.fill_factor:g}")
    for own, label in ((False, "catalogue"), (True, "this library")):
        chosen = [row for row, is_own in zip(rows, ours, strict=True) if is_own == own]
        chosen.sort(key=lambda row: row["n_subapertures"])
        x, y = [row["n_subapertures"] for row in chosen], [row["relative_mse"] for row in chosen]
        against.plot(x, y, "o-" if own else "o", color=COLORS[int(own)], label=label, markersize=5, linewidth=1)
    against.axhline(floor, color=FAINT, linestyle="--", linewidth=1)
    against.set_xlabel("number of holes")
    against.set_ylabel("relative MSE")
    against.set_ylim(0)
    against.set_title("Against the number of holes")
    against.legend()
    return figure


def show(options: Options, rows: Sequence[Mapping[str, Any]], crowded: Mapping[str, float]) -> None:
    """The table on the terminal."""
    console = Console()
    table = Table(title=f"MSE_a at a fill factor of {options.fill_factor:g}")
    for key in ON_TERMINAL:
        table.add_column(HEADINGS[key], justify="left" if key == "mask" else "right", no_wrap=key == "mask")
    for row in rows:
        style = "bold" if row["mask"].startswith("torchmask") else None
        table.add_row(*(cell(key, row[key]) for key in ON_TERMINAL), style=style)
    console.print(table)
    if crowded:
        names = ", ".join(f"{name} ({limit:.3f})" for name, limit in sorted(crowded.items(), key=lambda p: -p[1]))
        console.print(f"not ranked, holes overlap above the fill factor in brackets: {names}")


def ranking(options: Options, output: Run) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """The rows, and the patterns that are not ranked; everything is written to the folder of the run."""
    criterion = make_criterion(options)
    known, crowded = lay_out(options)
    own = search_own(options, criterion, output.callback)
    rows = rank(criterion, known, own)
    for name, mask in own.items():
        save_json(output.directory / f"{name}.json", mask)
    with atomic_write(output.directory / "ranking.csv") as file:
        file.write(as_csv(rows).encode())
    numbers = {"rows": rows, "not_ranked_largest_fill_factor": crowded}
    output.report("ranking", numbers, as_markdown(options, rows, crowded), draw(options, rows))
    return rows, crowded


def run(options: Options) -> None:
    """Rank in a new folder."""
    if options.smoke:
        options = dataclasses.replace(options, own=(3, 6), budget=200, n_frequencies=64)
    with new_run("rank_masks", options, options.seed) as output:
        rows, crowded = ranking(options, output)
    show(options, rows, crowded)


def main(argv: Sequence[str] | None = None) -> int:
    """The exit status."""
    return run_script("rank_masks", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
