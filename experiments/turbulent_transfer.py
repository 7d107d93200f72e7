"""How good the closed form of E|OTF|^2 is: against exposures drawn with the exact von Karman covariance.

    python experiments/turbulent_transfer.py                                   # instants at one wavelength
    python experiments/turbulent_transfer.py --exposure-tau0 1 --n-subapertures 6 --samples-per-hole 8 --pupil-over-r0 3
    python experiments/turbulent_transfer.py --smoke                           # everything, tiny, in seconds

Masks of several numbers and sizes of holes and a full pupil, E|OTF|^2 of the criterion beside its mean over draws of
the phases of all samples of the pupil. Samples and instants of the draws are few: what their mean tends to is a sum
over pairs of samples, and the ratio of Korff's integral to it is taken into the draws. Frequencies count above 0.1 of
the median baseline, where E|OTF|^2 is above 2 % of what one pair of holes gives at most. The picture shows those of the
first mask and the pupil.
"""

from __future__ import annotations

import dataclasses
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from exact_turbulence import Drawn, drawn_mean_square, sampled_mean_square
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import mean_square_otf
from torchmask.cli.options import ExperimentOptions
from torchmask.cli.program import run_script
from torchmask.cli.run import new_run
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture, FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.viz.style import COLORS, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

DIAMETER, WAVELENGTH = 1.0, 550e-9
_PER_R0 = 6  # samples
_MOST = 20_000  # of all instants and wavelengths: their covariance takes 3 GB
_WIND = (10.0, 0.0)  # [m/s]; only T / tau0 counts
_LEAST = 0.02  # of what one pair of holes gives at most, or of the pupil's largest


@dataclass(frozen=True, kw_only=True)
class Options(ExperimentOptions):
    """Options of the draws."""

    n_subapertures: tuple[int, ...] = (6, 11, 20)
    """Numbers of holes, N, of masks at random."""
    hole_over_r0: tuple[float, ...] = (0.4, 0.8, 1.5)
    """Sizes of their holes, d / r0."""
    pupil_over_r0: tuple[float, ...] = (7.0,)
    """Sizes of full pupils, D / r0."""
    fill_factor: float = 0.15
    """Collecting area N d^2 / D^2 of the masks."""
    outer_scale: float | None = None
    """Outer scale of the turbulence, in units of D; None: infinite."""
    exposure_tau0: float = 0.0
    """Exposure time over tau0, under a wind along x."""
    width: float = 0.0
    """Width of the band, over its middle wavelength."""
    n_instants: int = 8
    """Number of instants that make an exposure, if it has a length."""
    n_wavelengths: int = 3
    """Number of wavelengths that make a band, if it has a width."""
    samples_per_hole: int = 16
    """Least number of samples across a hole of a mask."""
    n_pixels: int = 48
    """Frequency grid, per side."""
    n_frequencies: int | None = None
    """Number of frequencies compared of each pupil, at random among those that count; None: all of them."""
    n_draws: int = 2000
    """Exposures drawn of each pupil."""
    seed: int = 0
    """Random seed of the masks and the draws."""


class Case(NamedTuple):
    """A pupil and its turbulence; `per_pair` is the most that one pair of holes gives to E|OTF|^2."""

    name: str
    aperture: Aperture
    r0: float
    lowest: float  # baseline that counts [m]
    per_pair: float
    oversampling: int


class Compared(NamedTuple):
    """E|OTF|^2 at the frequencies that count, in [F]: baseline [D], closed, Korff's integral, drawn and its error."""

    baseline: Tensor
    closed: Tensor
    integral: Tensor
    drawn: Tensor
    error: Tensor

    def row(self, name: str) -> dict[str, Any]:
        """Return the differences of the closed form from the integral and the draws, in per cent."""
        exact = 100 * (self.closed / self.integral - 1)
        ratio = 100 * (self.closed / self.drawn - 1)
        beyond = 100 * ((self.closed - self.drawn).abs() - 3 * self.error).clamp(min=0) / self.drawn
        return {
            "pupil": name,
            "n_frequencies": len(ratio),
            "mean_of_integral": float(exact.mean()),
            "largest_of_integral": float(exact.abs().max()),
            "mean": float(ratio.mean()),
            "largest": float(ratio.abs().max()),
            "standard_error": float(100 * (self.error / self.drawn).median()),
            "beyond_three_errors": float(beyond.max()),
        }


def check(options: Options) -> None:
    """Raise ValueError for what could not be drawn."""
    if not 0 <= options.width < 1:
        raise ValueError(f"width is {options.width}: it must be at least 0 and less than 1, over the wavelength")
    if options.n_frequencies is not None and options.n_frequencies < 1:
        raise ValueError(f"n_frequencies is {options.n_frequencies}: it must be at least 1, or left out for all")
    if options.n_draws < 2:
        raise ValueError(f"n_draws is {options.n_draws}: a standard error needs at least 2")
    for ratio in (*options.hole_over_r0, *options.pupil_over_r0):
        if not ratio > 0:
            raise ValueError(f"a hole or pupil of {ratio} r0 is asked for: sizes must be positive")
    many = (options.n_instants if options.exposure_tau0 > 0 else 1) * (
        options.n_wavelengths if options.width > 0 else 1
    )
    grid = grid_of(options)
    for case in cases(options, grid):
        samples = many * int((case.aperture.samples(grid, case.oversampling).weights > 0).sum())
        if samples > _MOST:
            raise ValueError(
                f"{case.name} have {samples} samples in all instants and wavelengths, more than the {_MOST} whose "
                "covariance is drawn from: lower --samples-per-hole, --n-instants, --n-wavelengths or the sizes"
            )


def grid_of(options: Options) -> Grid:
    """Return the grid, whose pixels sample the shortest wavelength of the band."""
    return Grid.nyquist(DIAMETER, WAVELENGTH, options.n_pixels, 1 / (1 - options.width / 2))


def cases(options: Options, grid: Grid) -> Iterator[Case]:
    """All masks and pupils."""
    step = grid.period / options.n_pixels
    for n in options.n_subapertures:
        generator = torch.Generator().manual_seed(options.seed)
        mask = SparseAperture.random(n, DIAMETER, options.fill_factor, generator)
        diameter, lowest = mask.subaperture_diameter, 0.1 * float(torch.pdist(mask.centers).median())
        for ratio in options.hole_over_r0:
            r0 = diameter / ratio
            finest = max(options.samples_per_hole / diameter, _PER_R0 / r0)
            yield Case(f"{n} holes of {ratio:g} r0", mask, r0, lowest, 1 / n**2, math.ceil(finest * step))
    for ratio in options.pupil_over_r0:
        r0 = DIAMETER / ratio
        oversampling = math.ceil(_PER_R0 * step / r0)
        yield Case(f"full pupil of {ratio:g} r0", FullAperture(DIAMETER), r0, 0.05 * DIAMETER, 1e-2, oversampling)


def conditions(options: Options, case: Case) -> tuple[Seeing, Band | None]:
    """Return the turbulence and the light of one case."""
    exposure = options.exposure_tau0 * Seeing(case.r0, wind=math.hypot(*_WIND)).tau0
    outer_scale = math.inf if options.outer_scale is None else options.outer_scale * DIAMETER
    seeing = Seeing(case.r0, outer_scale, exposure, _WIND if exposure > 0 else 0.0)
    if options.width == 0:
        return seeing, None
    return seeing, Band.top_hat(WAVELENGTH, options.width * WAVELENGTH, options.n_wavelengths)


def draw(options: Options, case: Case, grid: Grid) -> Drawn:
    """Exposures of one case."""
    generator = torch.Generator().manual_seed(options.seed)
    light, sampling = conditions(options, case), sampling_of(options, case)
    return drawn_mean_square(case.aperture, grid, *light, n_draws=options.n_draws, generator=generator, **sampling)


def sampling_of(options: Options, case: Case) -> dict[str, int]:
    """Return how many instants make an exposure, and how much finer than the grid the pupil's samples are."""
    n_instants = options.n_instants if options.exposure_tau0 > 0 else 1
    return {"n_instants": n_instants, "oversampling": case.oversampling}


def compare(options: Options, case: Case, grid: Grid, drawn: Drawn) -> Compared:
    """Return the closed form of one turbulence beside Korff's integral and exposures that were drawn."""
    seeing, band = conditions(options, case)
    wavelengths, shares = (None, None) if band is None else (band.wavelengths, band.shares)
    psds = PowerLawPSD(1.5, 1e5), NoisePSD(1e5)  # of any object: only E|OTF|^2 is asked for
    closed = TurbulentMSE(
        grid, *psds, 1, seeing.r0, seeing.outer_scale, seeing.exposure, seeing.wind, wavelengths, shares
    ).expected_power(case.aperture)
    nu_y, nu_x = (nu.expand(grid.shape) for nu in grid.frequencies(torch.float64))
    baseline = torch.hypot(nu_y, nu_x) * grid.period
    counts = (baseline > case.lowest) & (drawn.mean > _LEAST * case.per_pair)
    counts &= (nu_y > 0) | ((nu_y == 0) & (nu_x > 0))  # the others are their opposites
    pixels = counts.nonzero()
    generator = torch.Generator().manual_seed(options.seed)
    pixels = pixels[torch.randperm(len(pixels), generator=generator)[: options.n_frequencies]]
    at = pixels.unbind(1)
    integral = mean_square_otf(case.aperture, grid, torch.stack([nu_x[at], nu_y[at]], -1), seeing, band)
    # the draws' samples and instants are few, by a ratio that is known
    finer = integral / sampled_mean_square(case.aperture, grid, pixels, seeing, band, **sampling_of(options, case))
    return Compared(baseline[at] / DIAMETER, closed[at], integral, finer * drawn.mean[at], finer * drawn.error[at])


def markdown(options: Options, rows: Sequence[dict[str, Any]]) -> str:
    """Return the report as Markdown."""
    lines = [
        "# E|OTF|^2 in closed form, by Korff's integral and drawn",
        "",
        f"{options.n_draws} draws, outer scale {options.outer_scale or math.inf:g} D, "
        f"T / tau0 = {options.exposure_tau0:g}, band {100 * options.width:g} % wide, "
        f"{options.n_pixels} frequencies a side. In per cent.",
        "",
        "| pupil | frequencies | over the integral: mean | largest | over the draws: mean | largest | "
        "standard error (median) | largest beyond three standard errors |",
        "|---|---|---|---|---|---|---|---|",
    ]
    lines += [
        f"| {row['pupil']} | {row['n_frequencies']} | {row['mean_of_integral']:+.2f} | "
        f"{row['largest_of_integral']:.1f} | {row['mean']:+.2f} | {row['largest']:.1f} | "
        f"{row['standard_error']:.1f} | {row['beyond_three_errors']:.1f} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


@styled
def figure(shown: Sequence[tuple[str, Compared]]) -> Figure:
    """Above, E|OTF|^2 over the length of the baseline; below, the closed form over the draws."""
    sheet = new_figure(4.2 * len(shown), 5.0)
    axes = sheet.subplots(2, len(shown), sharex="col", height_ratios=[2, 1], squeeze=False)
    for (name, found), top, bottom in zip(shown, *axes, strict=True):
        top.errorbar(
            found.baseline,
            found.drawn,
            found.error,
            fmt="o",
            markersize=3.5,
            markerfacecolor="none",
            linewidth=0.7,
            color=COLORS[1],
            label="drawn",
        )
        top.plot(found.baseline, found.closed, ".", markersize=3, color=COLORS[0], label="closed form")
        top.set(yscale="log", ylabel="E|OTF|$^2$", title=name)
        top.legend()
        ratio = 100 * (found.closed / found.drawn - 1)
        bottom.errorbar(
            found.baseline,
            ratio,
            100 * found.error / found.drawn,
            fmt=".",
            markersize=3,
            linewidth=0.5,
            color=COLORS[0],
        )
        bottom.axhspan(-3, 3, color=COLORS[2], alpha=0.2, linewidth=0)
        bottom.set(xlabel="baseline / D", ylabel="closed over\ndrawn [%]")
    return sheet


def run(options: Options) -> None:
    """Draw and compare in a new folder."""
    if options.smoke:
        tiny = {"n_subapertures": (4,), "hole_over_r0": (0.8,), "n_pixels": 24, "n_draws": 100, "n_frequencies": 20}
        options = dataclasses.replace(options, **tiny)
    check(options)
    grid = grid_of(options)
    with new_run("turbulent_transfer", options) as output:
        found = []
        for case in cases(options, grid):
            found.append((case.name, compare(options, case, grid, draw(options, case, grid))))
        rows = [compared.row(name) for name, compared in found]
        shown = [found[0], *found[len(found) - len(options.pupil_over_r0) :][:1]]
        text = markdown(options, rows)
        output.report("turbulent_transfer", {"rows": rows}, text, figure(shown))
        output.summary.append(text)


def main(argv: Sequence[str] | None = None) -> int:
    """Return the exit status."""
    return run_script("turbulent_transfer", run, Options, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
