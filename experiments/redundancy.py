"""Why masking works: what turbulence leaves of the fringes of redundant and non-redundant pupils.

    python experiments/redundancy.py                       # D/r0 = 7
    python experiments/redundancy.py --d-over-r0 20        # stronger turbulence
    python experiments/redundancy.py --smoke               # everything, tiny, in seconds

A baseline that R pairs of holes share adds R fringes of random phases. A short exposure keeps sqrt(R) of them instead
of R, so its contrast falls as 1 / sqrt(R): a non-redundant mask keeps it all, a full pupil of diameter D about
0.66 (r0 / D) / sqrt(perfect OTF) at high frequencies. A long exposure averages the phases away, in any pupil alike. Von
Karman screens through a full pupil, Golay-6 and a row of equal holes are held against the closed forms of Gaussian
phase statistics. The picture and the numbers go to a new folder, runs/<name>/.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
import tyro
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.atmosphere.von_karman import von_karman_structure_function
from torchmask.grid import Grid
from torchmask.io import atomic_write, write_json
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.otf import OTF
from torchmask.viz.style import COLORS, FAINT, INK, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DIAMETER = 1.0  # of the pupils [m]: nothing here depends on it but r0 and the outer scale
WAVELENGTH = 550e-9
KORFF = 0.341864 * 4 / math.pi  # E|OTF|^2 of a large pupil at high frequencies over (r0 / D)^2 times the perfect OTF
_CHUNK = 20  # frames held in memory
_LOWEST = 1e-3  # MTF that is drawn
Shift = tuple[int, int]  # a baseline in pupil samples, (rows, columns)


@dataclass(frozen=True)
class Config:
    """Everything a run depends on."""

    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Of the turbulence, in units of D."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of Golay-6."""
    row_holes: int = 12
    """Holes of the redundant row."""
    n_pixels: int = 256
    """Of the image, per side."""
    oversampling: int = 2
    """Of the pupil behind the exposures. The field must hold the light that turbulence scatters."""
    n_frames: int = 600
    """Short exposures."""
    seed: int = 0
    """Of the exposures."""
    smoke: bool = False
    """Everything tiny, to see that it runs."""
    name: str | None = None
    """Folder of the run below `runs`; None: date and time."""
    runs: Path = Path("runs")
    """Where run folders are made."""


def pupils(config: Config, grid: Grid) -> dict[str, tuple[Aperture, Sequence[tuple[Shift, int | None]]]]:
    """Each pupil with the baselines to look at, and how many pairs of holes share each of them."""
    step = grid.period / config.n_pixels
    radius = math.floor(DIAMETER / step)
    axis = range(0, int(0.93 * radius), max(1, radius // 32))
    full = [((0, k), None) for k in axis] + [((k, 0), None) for k in axis[1:]]
    golay = SparseAperture.from_catalog("golay6", DIAMETER, config.fill_factor)
    centers = golay.centers.numpy()
    first, second = np.triu_indices(len(centers), 1)
    x, y = np.round((centers[first] - centers[second]).T / step).astype(int)
    spacing = math.floor(DIAMETER / step / config.row_holes)  # whole samples, so that all its pairs share their shift
    middle = (config.row_holes - 1) / 2
    places = [[(k - middle) * spacing * step, 0.0] for k in range(config.row_holes)]
    row = SparseAperture(torch.tensor(places, dtype=torch.float64), 0.9 * spacing * step, DIAMETER)
    steps = range(1, config.row_holes)
    return {
        "full pupil": (FullAperture(DIAMETER), full),
        "Golay-6": (golay, [((int(j), int(i)), 1) for i, j in zip(x, y, strict=True)]),
        "row": (row, [((0, k * spacing), config.row_holes - k) for k in steps]),
    }


def raster_of(aperture: Aperture, grid: Grid) -> Tensor:
    """The amplitude of a pupil on its raster."""
    samples = aperture.samples(grid)
    raster = torch.zeros(samples.raster, dtype=samples.weights.dtype)
    raster.view(-1).index_add_(0, samples.index.flatten(), samples.weights.flatten())
    return raster


def expected_power(pupil: Tensor, shift: Shift, grid: Grid, r0: float, outer_scale: float) -> float:
    """Mean of |OTF|^2 over perfect OTF squared at the baseline B = `shift`, for any pupil under Gaussian phases.

    The OTF at B sums phasors of phi(x) - phi(x + B) over the pupil. Two of them, x apart by u, have the mean product
    exp(-D(B) - D(u) + D(u + B) / 2 + D(u - B) / 2), with D the structure function, and the autocorrelation of the
    product P(x) P(x + B) counts them.
    """
    step = grid.period / pupil.shape[0]
    product = pupil * torch.roll(pupil, (-shift[0], -shift[1]), dims=(0, 1))
    counts = torch.fft.ifft2(torch.fft.fft2(product).abs() ** 2).real
    y, x = (torch.fft.fftfreq(n, 1 / n, dtype=torch.float64) * step for n in pupil.shape)
    b = (shift[0] * step, shift[1] * step)

    def structure(sign: int) -> Tensor:
        distance = torch.hypot(y[:, None] + sign * b[0], x[None, :] + sign * b[1])
        return von_karman_structure_function(distance, r0, outer_scale)

    at_baseline = von_karman_structure_function(torch.tensor(math.hypot(*b), dtype=torch.float64), r0, outer_scale)
    exponent = -at_baseline - structure(0) + (structure(1) + structure(-1)) / 2
    return float((counts * exponent.exp()).sum() / product.sum() ** 2)


def contrasts(otf: OTF, shifts: Sequence[Shift], frames: Iterable[Tensor]) -> dict[str, Tensor]:
    """OTFs at the baselines over those without turbulence: their rms and their mean, with standard errors."""
    rows, columns = torch.tensor(shifts).T
    perfect = otf()[rows, columns].real
    drawn = torch.cat([otf(phase)[:, rows, columns] for phase in frames]) / perfect
    power = drawn.abs() ** 2
    root = math.sqrt(len(drawn))
    short = power.mean(0).sqrt()
    return {
        "perfect": perfect,
        "short": short,
        "short_error": power.std(0) / root / (2 * short),
        "long": drawn.real.mean(0),
        "long_error": drawn.real.std(0) / root,
    }


def run(config: Config) -> list[dict[str, Any]]:
    """A row for each pupil and baseline: contrast of short and long exposures, drawn and in closed form."""
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, config.n_pixels)
    r0, outer_scale = DIAMETER / config.d_over_r0, config.outer_scale * DIAMETER
    turbulence = TurbulencePhase(r0, outer_scale)
    chunks = [min(_CHUNK, config.n_frames - done) for done in range(0, config.n_frames, _CHUNK)]
    rows = []
    for number, (name, (aperture, baselines)) in enumerate(pupils(config, grid).items()):
        otf, raster = OTF(aperture, grid, config.oversampling), raster_of(aperture, grid)
        samples, shifts = otf.samples(), [shift for shift, _ in baselines]
        generator = torch.Generator().manual_seed(config.seed + number)
        drawn = contrasts(otf, shifts, (turbulence(samples, n, generator) for n in chunks))
        n_holes, n_samples = samples.weights.shape
        steady = {"short": drawn["short"], "short_error": drawn["short_error"]}
        if name == "row":
            angles = (2 * math.pi * torch.rand(n, n_holes, 1, dtype=torch.float64, generator=generator) for n in chunks)
            steady = contrasts(otf, shifts, (angle.expand(-1, -1, n_samples) for angle in angles))
        for index, (shift, redundancy) in enumerate(baselines):
            length = math.hypot(*shift) * grid.period / config.n_pixels
            loss = von_karman_structure_function(torch.tensor(length, dtype=torch.float64), r0, outer_scale)
            row: dict[str, Any] = {"pupil": name, "baseline": length, "redundancy": redundancy}
            row |= {key: float(value[index]) for key, value in drawn.items()}
            row["short_theory"] = math.sqrt(expected_power(raster, shift, grid, r0, outer_scale))
            row["long_theory"] = math.exp(-float(loss) / 2)
            if name == "row" and redundancy is not None:
                row |= {"pistons": float(steady["short"][index]), "pistons_error": float(steady["short_error"][index])}
                row["pistons_theory"] = 1 / math.sqrt(redundancy)
            rows.append(row)
    return rows


def deviation(rows: Sequence[dict[str, Any]], key: str) -> float:
    """The largest difference between drawn and closed form, in standard errors.

    Without what hardly varies between exposures, such as the fringe of a single pair of holes under pistons: there the
    sampling of the pupil would be all that is seen.
    """
    pairs = [(row[key] - row[f"{key}_theory"], row[f"{key}_error"]) for row in rows if key in row]
    return max(abs(difference) / error for difference, error in pairs if error > 1e-3)


def findings(config: Config, rows: Sequence[dict[str, Any]]) -> list[str]:
    """What the numbers say, in sentences."""
    full = [r for r in rows if r["pupil"] == "full pupil" and 0.3 * DIAMETER < r["baseline"] < 0.7 * DIAMETER]
    golay = [row for row in rows if row["pupil"] == "Golay-6"]
    row = [row for row in rows if row["pupil"] == "row"]
    kept = [float(np.mean([r["short"] for r in own])) for own in (full, golay)]
    korff = float(np.mean([math.sqrt(KORFF / r["perfect"]) / config.d_over_r0 for r in full]))
    return [
        f"Short exposures, D/r0 = {config.d_over_r0:g}: the full pupil keeps {kept[0]:.3f} of its contrast on "
        f"baselines of 0.3 to 0.7 D ({korff:.3f} in the limit of large D/r0), Golay-6 keeps {kept[1]:.3f}, and what it "
        "loses is lost inside its holes.",
        f"Random pistons on a row of {config.row_holes} holes: of the contrast remains {row[0]['pistons']:.4f} ± "
        f"{row[0]['pistons_error']:.4f} at redundancy {row[0]['redundancy']}, where the random walk says "
        f"{row[0]['pistons_theory']:.4f}. Von Karman screens keep more on short baselines, whose pairs of holes see "
        "nearly the same phase differences, and less on long ones, because they also act inside the holes.",
        f"Long exposures keep {row[0]['long']:.3f} of the contrast on the shortest baseline of the row and, by the "
        f"closed form, {max(r['long_theory'] for r in golay):.1e} on that of Golay-6: averaging destroys what masking "
        "saves.",
        f"Largest difference from the closed forms, in standard errors of {config.n_frames} exposures: "
        f"{deviation(rows, 'short'):.1f} short, {deviation(rows, 'long'):.1f} long, {deviation(rows, 'pistons'):.1f} "
        f"with pistons, over {len(rows)} baselines.",
    ]


def markdown(config: Config, rows: Sequence[dict[str, Any]]) -> str:
    """The numbers, for readers."""
    lines = [
        "# What turbulence leaves of the fringes",
        "",
        f"D/r0 = {config.d_over_r0:g}, outer scale {config.outer_scale:g} D, {config.n_frames} exposures, "
        f"{config.n_pixels} pixels a side. Contrasts are relative to the perfect OTF of the same pupil; ± is one "
        "standard error.",
        "",
        *(f"- {line}" for line in findings(config, rows)),
        "",
        "| pupil | baseline / D | redundancy | perfect OTF | short exposures, rms | closed form | long exposure | "
        "closed form | random pistons | closed form |",
        "|" + "---|" * 10,
    ]
    for row in rows:
        pistons = "- | -"
        if "pistons" in row:
            pistons = f"{row['pistons']:.4f} ± {row['pistons_error']:.4f} | {row['pistons_theory']:.4f}"
        lines.append(
            f"| {row['pupil']} | {row['baseline'] / DIAMETER:.4f} | {row['redundancy'] or '-'} "
            f"| {row['perfect']:.4f} | "
            f"{row['short']:.4f} ± {row['short_error']:.4f} | {row['short_theory']:.4f} | "
            f"{row['long']:.4f} ± {row['long_error']:.4f} | {row['long_theory']:.4f} | {pistons} |"
        )
    return "\n".join(lines) + "\n"


@styled
def figure(config: Config, rows: Sequence[dict[str, Any]]) -> Figure:
    """MTF of the full pupil and of the mask, and contrast against redundancy."""
    sheet = new_figure(11.5, 3.9)
    full, masked, walk = sheet.subplots(1, 3)
    mtf_panel(full, "full pupil", rows)
    limit = sorted((row for row in rows if row["pupil"] == "full pupil"), key=lambda row: row["baseline"])
    x = [row["baseline"] / DIAMETER for row in limit]
    y = [math.sqrt(KORFF * max(row["perfect"], 0)) / config.d_over_r0 for row in limit]
    full.plot(x, y, color=FAINT, linestyle="--", linewidth=1, label="limit of large D/r$_0$")
    mtf_panel(masked, "Golay-6", rows)
    for ax in (full, masked):
        ax.set(yscale="log", ylim=(_LOWEST, 1.3), xlim=(-0.02, 1.02), xlabel="baseline / D", ylabel="MTF")
        ax.legend(loc="lower left" if ax is masked else "lower right")
    own = [row for row in rows if row["pupil"] == "row"]
    r = np.array([row["redundancy"] for row in own])
    style: dict[str, Any] = {"linestyle": "none", "markersize": 4, "capsize": 2}
    for key, color, marker, label in (
        ("pistons", COLORS[0], "o", "random pistons"),
        ("short", COLORS[1], "s", "von Karman screens"),
    ):
        values, errors = ([row[key + part] for row in own] for part in ("", "_error"))
        walk.errorbar(r, values, errors, color=color, marker=marker, label=label, **style)
        walk.plot(r, [row[f"{key}_theory"] for row in own], color=color, linewidth=1)
    walk.set(xscale="log", yscale="log", xlabel="redundancy R", ylabel="contrast kept by short exposures")
    ticks = [n for n in (1, 2, 3, 5, 10, 20) if n <= config.row_holes]
    walk.set_xticks(ticks, [str(n) for n in ticks])
    walk.set_yticks([0.2, 0.3, 0.5, 1.0], ["0.2", "0.3", "0.5", "1"])
    walk.minorticks_off()
    walk.set_ylim(0.2, 1.15)
    walk.set_title(f"A row of {config.row_holes} holes (lines: closed forms)")
    walk.legend()
    sheet.suptitle(
        f"Redundancy destroys the contrast of short exposures (D/r$_0$ = {config.d_over_r0:g})", x=0.02, ha="left"
    )
    return sheet


def mtf_panel(ax: Axes, name: str, rows: Sequence[dict[str, Any]]) -> None:
    """Perfect, short-exposure and long-exposure MTF of one pupil: lines are closed forms, markers are drawn."""
    own = sorted((row for row in rows if row["pupil"] == name), key=lambda row: row["baseline"])
    own = [row for row in own if row["perfect"] > 1e-3]
    x, perfect = np.array([[row["baseline"] / DIAMETER, row["perfect"]] for row in own]).T
    line = "-" if name == "full pupil" else "_"  # a mask transmits nothing between its baselines
    style: dict[str, Any] = {"linestyle": "-"} if line == "-" else {"linestyle": "none", "marker": "_", "markersize": 9}
    ax.plot(x, perfect, color=INK, label="perfect", **style)
    for key, color, label in (("short", COLORS[1], "short exposures, rms"), ("long", COLORS[0], "long exposure")):
        theory, value, error = (perfect * [row[key + part] for row in own] for part in ("_theory", "", "_error"))
        ax.plot(x, theory, color=color, **style)
        seen = value > 3 * error
        label += " (below the axis)" if theory.max() < _LOWEST else ""
        ax.errorbar(
            x[seen], value[seen], error[seen], color=color, marker="o", markersize=3, linestyle="none", label=label
        )
    ax.set_title(f"{name} (lines: closed forms)" if line == "-" else f"{name} (dashes: closed forms)")


def main(config: Config) -> int:
    """Run in a new folder."""
    directory = config.runs / (config.name or datetime.now().strftime("redundancy-%Y%m%d-%H%M%S"))
    if config.smoke:
        config = dataclasses.replace(config, n_pixels=128, n_frames=40, row_holes=6)
    try:
        if directory.exists():
            raise ValueError(f"{directory} exists and is not overwritten: choose another --name")
        rows = run(config)
        directory.mkdir(parents=True)
        write_json(directory / "redundancy.json", {"config": config, "rows": rows})
        with atomic_write(directory / "redundancy.md") as file:
            file.write(markdown(config, rows).encode())
        with atomic_write(directory / "redundancy.png") as file:
            figure(config, rows).savefig(file, format="png", dpi=150)
    except ValueError as error:
        print(f"redundancy: {error}", file=sys.stderr)
        return 2
    print(*findings(config, rows), f"written to {directory}", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Config, description=__doc__)))
