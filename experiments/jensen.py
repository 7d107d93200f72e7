"""What a finite number of exposures adds to the error, in closed form: against exposures with exact turbulence.

    python experiments/jensen.py                  # masks of 6 and 11 holes and a full pupil: minutes of one core
    python experiments/jensen.py --d-over-r0 4    # weaker turbulence
    python experiments/jensen.py --smoke          # everything, tiny, in seconds

Exposures are drawn with the exact von Karman covariance between all samples of the pupil. The mean error of the Wiener
restoration of K of them, less what no mask of the diameter can change, stands beside TurbulentMSE, alone and with its
jensen_term. Table and numbers go to a new folder.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from exact_turbulence import drawn_powers, perfect_power
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.search import search_mask
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture, FullAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

DIAMETER, WAVELENGTH, OUTER_SCALE = 1.0, 550e-9, 20.0  # [m]; only ratios to them matter
_STILL = 1e6  # r0 [m] without turbulence
_NOTHING = 1e-12  # of the object's power
_DARK = 1e-4  # of what one pair of holes gives, or of the pupil's largest: a frequency that is not transmitted


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Options of the draws."""

    n_subapertures: tuple[int, ...] = (6, 11)
    """Numbers of holes, N, of searched masks; a full pupil follows them."""
    photons: tuple[float, ...] = (1e5, 1e6, 1e7)
    """Electrons per frame."""
    n_frames: tuple[int, ...] = (10, 20)
    """Numbers K of exposures."""
    d_over_r0: float = 7.0
    """Strength of the turbulence, D / r0."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of the masks."""
    exponent: float = 1.5
    """Exponent of the object's power-law power spectrum."""
    n_pixels: int = 64
    """Frequency grid, per side."""
    n_draws: int = 600
    """Exposures drawn of each mask; of the pupil, whose fluctuate more, twice as many."""
    samples_per_hole: int = 18
    """Least number of samples across a hole of a mask."""
    samples_per_pupil: int = 64
    """Least number of samples across the full pupil."""
    budget: int = 2000
    """Evaluations of each search."""
    seed: int = 0
    """Random seed of the searches and the draws."""


def check(options: Options) -> None:
    """Raise ValueError for draws too few for a standard error."""
    if options.n_draws < 2 * max(options.n_frames):
        raise ValueError(
            f"n_draws is {options.n_draws}: a standard error needs at least two stacks of the most frames, "
            f"{2 * max(options.n_frames)}"
        )


def pupils(options: Options, grid: Grid) -> Iterator[tuple[str, Aperture, int, int]]:
    """Return name, pupil, oversampling of its raster and number of draws of every case."""
    step = grid.period / options.n_pixels  # of the raster that is not oversampled [m]
    fine = Grid.nyquist(DIAMETER, WAVELENGTH, 2 * options.n_pixels)
    criterion = AsymptoticMSE(fine, PowerLawPSD(options.exponent, 1e6), NoisePSD(1e6), 20)
    for n in options.n_subapertures:
        found = search_mask(criterion, n, DIAMETER, options.fill_factor, budget=options.budget, seed=options.seed)
        mask = found.aperture
        oversampling = math.ceil(options.samples_per_hole * step / mask.subaperture_diameter)
        yield f"{n} holes", mask, oversampling, options.n_draws
    oversampling = math.ceil(options.samples_per_pupil * step / DIAMETER)
    yield "full pupil", FullAperture(DIAMETER), oversampling, 2 * options.n_draws


def exposures(options: Options, pupil: Aperture, grid: Grid, oversampling: int, n_draws: int) -> tuple[Tensor, Tensor]:
    """Return |OTF|^2 (n_draws, H, W) of exposures, and which frequencies (H, W) the pupil transmits.

    The samples of a pupil transmit a little more or less than the pupil itself: of that the draws are freed.
    """
    still = criterion_of(options, grid, options.photons[0], 1, _STILL).expected_power(pupil)
    largest = 1.0 if isinstance(pupil, FullAperture) else 1 / len(pupil.centers) ** 2
    seen = still > _DARK * largest
    ratio = torch.where(seen, still / perfect_power(pupil, grid, oversampling=oversampling), 0.0)
    drawn = drawn_powers(
        *(pupil, grid, Seeing(DIAMETER / options.d_over_r0, OUTER_SCALE)),
        n_draws=n_draws,
        oversampling=oversampling,
        generator=torch.Generator().manual_seed(options.seed),
    )
    return torch.cat([ratio * power for power in drawn]), seen


def criterion_of(options: Options, grid: Grid, photons: float, n_frames: int, r0: float) -> TurbulentMSE:
    """Return the criterion in turbulence of one strength."""
    psds = PowerLawPSD(options.exponent, photons), NoisePSD(photons)
    return TurbulentMSE(grid, *psds, n_frames, r0=r0, outer_scale=OUTER_SCALE)


def compare(
    options: Options, name: str, pupil: Aperture, grid: Grid, power: Tensor, seen: Tensor
) -> list[dict[str, Any]]:
    """Return for each flux and number of frames the prediction over the mean error of drawn exposures, in per cent.

    `alone` and `with_term` are of errors less the floor, in which what the pupil does not transmit counts in full;
    `transmitted` and its standard error are of the frequencies that it does; `drawn_mean` too, with E|OTF|^2 of the
    draws in place of the closed form's.
    """
    rows, mean = [], power.mean(0)
    for n_frames in options.n_frames:
        stacks = power[: len(power) // n_frames * n_frames].unflatten(0, (-1, n_frames)).mean(1)
        criterion = criterion_of(options, grid, options.photons[0], n_frames, DIAMETER / options.d_over_r0)
        for photons in options.photons:
            known = criterion_of(options, grid, photons, n_frames, DIAMETER / options.d_over_r0)
            dark = float((known.object_psd * ~seen).mean() - known.floor(DIAMETER))
            known.object_psd[~seen] *= _NOTHING
            criterion.load_state_dict(known.state_dict())  # its tables of turbulence hold at any flux
            noise, ratio = known.noise_psd / n_frames, known.noise_psd / (n_frames * known.object_psd)
            errors = (noise / (stacks + ratio)).mean((-2, -1))
            drawn, scatter = float(errors.mean()), float(errors.std()) / math.sqrt(len(errors))
            alone, term = float(criterion(pupil)), float(criterion.jensen_term(pupil))
            # the mean of M draws fluctuates as that of K does, which Jensen's term counts
            by_draws = float((noise / (mean + ratio)).mean()) + term * (1 - n_frames / len(power))
            rows.append(
                {
                    "pupil": name,
                    "n_photons": photons,
                    "n_frames": n_frames,
                    "alone": 100 * ((alone + dark) / (drawn + dark) - 1),
                    "with_term": 100 * ((alone + term + dark) / (drawn + dark) - 1),
                    "transmitted": 100 * ((alone + term) / drawn - 1),
                    "drawn_mean": 100 * (by_draws / drawn - 1),
                    "standard_error": 100 * scatter / drawn,
                }
            )
    return rows


def markdown(options: Options, rows: Sequence[dict[str, Any]]) -> str:
    """Return the numbers, for readers: a line for each pupil and flux, the numbers of frames divided by strokes."""
    columns = {
        "alone": "+.2f",
        "with_term": "+.2f",
        "transmitted": "+.2f",
        "drawn_mean": "+.2f",
        "standard_error": ".1f",
    }
    frames = " / ".join(map(str, options.n_frames))
    lines = [
        "# The error of a finite number of exposures",
        "",
        f"Prediction over the mean of drawn exposures, in per cent, for K = {frames}. D/r0 = {options.d_over_r0:g}, "
        f"outer scale {OUTER_SCALE / DIAMETER:g} D, fill factor {options.fill_factor:g}, p = {options.exponent:g}, "
        f"{options.n_pixels} frequencies a side, {options.n_draws} draws of masks and {2 * options.n_draws} of the "
        "full pupil.",
        "",
        "| pupil | photons | criterion alone | with `jensen_term` | with it, at the frequencies transmitted alone | "
        "the same with E&#124;OTF&#124;^2 of the draws | standard error |",
        "|---" * 7 + "|",
    ]
    for name, photons in dict.fromkeys((row["pupil"], row["n_photons"]) for row in rows):
        own = [row for row in rows if (row["pupil"], row["n_photons"]) == (name, photons)]
        texts = [" / ".join(format(row[column], how) for row in own) for column, how in columns.items()]
        lines.append(f"| {name} | {photons:.0e} | {' | '.join(texts)} |".replace("e+0", "e"))
    return "\n".join(lines) + "\n"


def run(options: Options) -> None:
    """Draw and compare in a new folder."""
    if options.smoke:
        options = replace(options, n_subapertures=(4,), photons=(1e6,), n_frames=(2, 4), d_over_r0=3.0, n_pixels=24)
        options = replace(options, n_draws=40, samples_per_hole=6, samples_per_pupil=16, budget=100)
    check(options)
    grid = Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels)
    with new_run("jensen", options, options.seed) as output:
        rows = []
        for name, pupil, oversampling, n_draws in pupils(options, grid):
            rows += compare(options, name, pupil, grid, *exposures(options, pupil, grid, oversampling, n_draws))
        text = markdown(options, rows)
        output.report("jensen", {"rows": rows}, text)
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("jensen", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
