"""Why masking works: what turbulence leaves of the fringes of redundant and non-redundant pupils.

    python experiments/redundancy.py                       # D/r0 = 7
    python experiments/redundancy.py --d-over-r0 20        # stronger turbulence
    python experiments/redundancy.py --smoke               # everything, tiny, in seconds

A baseline that R pairs of holes share adds R fringes of random phases. A short exposure keeps sqrt(R) of them instead
of R, so its contrast falls as 1 / sqrt(R): a non-redundant mask keeps it all, a full pupil of diameter D about
0.66 (r0 / D) / sqrt(perfect OTF) at high frequencies. A long exposure averages the phases away, in any pupil alike. Von
Karman screens through a full pupil, Golay-6 and a row of equal holes are held against the closed forms of Gaussian
phase statistics. The picture and the numbers go to a new folder.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from redundancy_report import DIAMETER, figure, findings, markdown
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.atmosphere.von_karman import von_karman_structure_function
from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.otf import OTF
from torchmask.optics.overlaps import check_overlaps
from torchmask.record import Callback, Record

WAVELENGTH = 550e-9
_CHUNK = 20  # frames held in memory
Shift = tuple[int, int]  # a baseline in pupil samples, (rows, columns)


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Options of the exposures."""

    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    outer_scale: float = 20.0
    """Outer scale of the turbulence, in units of D."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of Golay-6."""
    row_holes: int = 12
    """Number of holes of the redundant row."""
    n_pixels: int = 256
    """Number of pixels per side of the image."""
    oversampling: int = 2
    """Oversampling of the pupil, which widens the field so that it contains the light that turbulence scatters."""
    n_frames: int = 600
    """Number of short exposures."""
    seed: int = 0
    """Seed of the exposures."""


def check(options: Options) -> None:
    """Raise ValueError for what could not be drawn."""
    if not options.d_over_r0 > 0:
        raise ValueError(f"d_over_r0 is {options.d_over_r0}: it must be positive")
    if options.n_frames < 2:
        raise ValueError(f"n_frames is {options.n_frames}: a standard error needs at least 2")
    if options.row_holes < 2:
        raise ValueError(f"row_holes is {options.row_holes}: a baseline needs at least 2")


def pupils(options: Options, grid: Grid) -> dict[str, tuple[Aperture, Sequence[tuple[Shift, int | None]]]]:
    """Return each pupil with the baselines to look at, and how many pairs of holes share each of them."""
    step = grid.period / options.n_pixels
    radius = math.floor(DIAMETER / step)
    axis = range(0, int(0.93 * radius), max(1, radius // 32))
    full = [((0, k), None) for k in axis] + [((k, 0), None) for k in axis[1:]]
    golay = SparseAperture.from_catalog("golay6", DIAMETER, options.fill_factor)
    check_overlaps(golay)
    centers = golay.centers.numpy()
    first, second = np.triu_indices(len(centers), 1)
    x, y = np.round((centers[first] - centers[second]).T / step).astype(int)
    spacing = math.floor(DIAMETER / step / options.row_holes)  # whole samples, so that all its pairs share their shift
    middle = (options.row_holes - 1) / 2
    places = [[(k - middle) * spacing * step, 0.0] for k in range(options.row_holes)]
    row = SparseAperture(torch.tensor(places, dtype=torch.float64), 0.9 * spacing * step, DIAMETER)
    steps = range(1, options.row_holes)
    return {
        "full pupil": (FullAperture(DIAMETER), full),
        "Golay-6": (golay, [((int(j), int(i)), 1) for i, j in zip(x, y, strict=True)]),
        "row": (row, [((0, k * spacing), options.row_holes - k) for k in steps]),
    }


def raster_of(aperture: Aperture, grid: Grid) -> Tensor:
    """Return the amplitude of a pupil on its raster."""
    samples = aperture.samples(grid)
    raster = torch.zeros(samples.raster, dtype=samples.weights.dtype)
    raster.view(-1).index_add_(0, samples.index.flatten(), samples.weights.flatten())
    return raster


def expected_power(pupil: Tensor, shift: Shift, grid: Grid, r0: float, outer_scale: float) -> float:
    """Return the mean |OTF|^2 over the perfect one at the baseline B = `shift`, for any pupil under Gaussian phases.

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
    """Return OTFs at the baselines over those without turbulence: their rms and their mean, with standard errors."""
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


def compare(options: Options, callback: Callback) -> list[dict[str, Any]]:
    """Return a row for each pupil and baseline: contrast of short and long exposures, drawn and in closed form."""
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels)
    r0, outer_scale = DIAMETER / options.d_over_r0, options.outer_scale * DIAMETER
    rows = []
    for number, (name, (aperture, baselines)) in enumerate(pupils(options, grid).items()):
        generator = torch.Generator().manual_seed(options.seed + number)
        drawn = draw(options, name, aperture, grid, [shift for shift, _ in baselines], generator, callback)
        raster = raster_of(aperture, grid)
        for index, (shift, redundancy) in enumerate(baselines):
            length = math.hypot(*shift) * grid.period / options.n_pixels
            loss = von_karman_structure_function(torch.tensor(length, dtype=torch.float64), r0, outer_scale)
            row: dict[str, Any] = {"pupil": name, "baseline": length, "redundancy": redundancy}
            row |= {key: float(value[index]) for key, value in drawn.items()}
            row["short_theory"] = math.sqrt(expected_power(raster, shift, grid, r0, outer_scale))
            row["long_theory"] = math.exp(-float(loss) / 2)
            if name == "row" and redundancy is not None:
                row["pistons_theory"] = 1 / math.sqrt(redundancy)
            rows.append(row)
    return rows


def draw(
    options: Options,
    name: str,
    aperture: Aperture,
    grid: Grid,
    shifts: Sequence[Shift],
    generator: torch.Generator,
    callback: Callback,
) -> dict[str, Tensor]:
    """Draw contrasts of one pupil under von Karman screens, those of the row under random pistons too."""
    turbulence = TurbulencePhase(DIAMETER / options.d_over_r0, options.outer_scale * DIAMETER)
    otf = OTF(aperture, grid, options.oversampling)
    samples = otf.samples()
    n_holes, n_samples = samples.weights.shape

    def exposures(stage: str, phase: Callable[[int], Tensor]) -> Iterator[Tensor]:
        for first in range(0, options.n_frames, _CHUNK):
            count = min(_CHUNK, options.n_frames - first)
            yield phase(count)
            callback(Record(stage, first + count, options.n_frames, {}))

    def pistons(count: int) -> Tensor:
        angles = 2 * math.pi * torch.rand(count, n_holes, 1, dtype=torch.float64, generator=generator)
        return angles.expand(-1, -1, n_samples)

    drawn = contrasts(otf, shifts, exposures(f"screens/{name}", lambda count: turbulence(samples, count, generator)))
    if name == "row":
        steady = contrasts(otf, shifts, exposures("pistons/row", pistons))
        drawn |= {"pistons": steady["short"], "pistons_error": steady["short_error"]}
    return drawn


def setting(options: Options) -> str:
    """Return a sentence on what all rows share."""
    return (
        f"D/r0 = {options.d_over_r0:g}, outer scale {options.outer_scale:g} D, {options.n_frames} exposures, "
        f"{options.n_pixels} pixels a side."
    )


def run(options: Options) -> None:
    """Draw and compare in a new folder."""
    if options.smoke:
        options = dataclasses.replace(options, n_pixels=128, n_frames=40, row_holes=6)
    check(options)
    with new_run("redundancy", options, options.seed) as output:
        rows = compare(options, output.callback)
        found = findings(options.d_over_r0, options.n_frames, rows)
        text = markdown(setting(options), found, rows)
        output.report("redundancy", {"rows": rows}, text, figure(options.d_over_r0, rows))
        output.summary.extend(found)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("redundancy", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
