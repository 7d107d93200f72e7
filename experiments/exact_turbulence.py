"""E|OTF|^2 by Monte Carlo, with the exact von Karman covariance between all samples of a pupil.

Screens made by FFT lack low frequencies. Here the phases of all samples, at all instants of an exposure and all
wavelengths of a band, are drawn together from their covariance, by its Cholesky factor. What the mean of such draws
tends to is known without any: a sum over pairs of samples, which tells their sampling from their statistics.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import difference_variance
from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.phasor import phasor
from torchmask.optics.psf import fold
from torchmask.optics.pupil import PupilSamples

_ROWS, _FRAMES = 500, 50  # in memory at a time


class Drawn(NamedTuple):
    """|OTF|^2 on the grid (H, W): its mean over draws, the standard error of that, and the value without turbulence.

    All three are of the same samples of the pupil, so that mean / perfect is free of most of the error of sampling.
    """

    mean: Tensor
    error: Tensor
    perfect: Tensor


def drawn_mean_square(
    aperture: Aperture,
    grid: Grid,
    seeing: Seeing,
    band: Band | None = None,
    *,
    n_draws: int,
    oversampling: int = 1,
    **others: Any,
) -> Drawn:
    """Return |OTF|^2 of one aperture, on average over exposures of `drawn_powers`, which takes the `others`."""
    total, squares = torch.zeros(grid.shape, dtype=torch.float64), torch.zeros(grid.shape, dtype=torch.float64)
    for power in drawn_powers(aperture, grid, seeing, band, n_draws=n_draws, oversampling=oversampling, **others):
        total, squares = total + power.sum(0), squares + (power**2).sum(0)
    mean = total / n_draws
    perfect = perfect_power(aperture, grid, band, oversampling=oversampling)
    return Drawn(mean, ((squares / n_draws - mean**2) / n_draws).sqrt(), perfect)


def perfect_power(aperture: Aperture, grid: Grid, band: Band | None = None, *, oversampling: int = 1) -> Tensor:
    """|OTF|^2 (H, W) of the samples of an aperture without turbulence."""
    band, samples = _sampled(aperture, grid, band, oversampling)
    total = torch.zeros(grid.shape, dtype=torch.complex128)
    for own, share in zip(samples, band.shares, strict=True):
        total += share * _otf(own, grid)
    return total.abs() ** 2


def drawn_powers(
    aperture: Aperture,
    grid: Grid,
    seeing: Seeing,
    band: Band | None = None,
    *,
    n_draws: int,
    n_instants: int = 1,
    oversampling: int = 1,
    generator: torch.Generator | None = None,
) -> Iterator[Tensor]:
    """Return |OTF|^2 of `n_draws` exposures of one aperture under turbulence, wind a vector or 0, some at a time.

    An exposure is the mean of `n_instants`, the pupil sampled for a field `oversampling` times as wide as the grid.
    """
    band, samples = _sampled(aperture, grid, band, oversampling)
    open_ = [own.weights > 0 for own in samples]
    wind = torch.tensor(_velocity(seeing), dtype=torch.float64)
    times = (torch.arange(n_instants, dtype=torch.float64) + 0.5) / n_instants * seeing.exposure
    places = [(own.offsets + aperture.centers[:, None])[inside] for own, inside in zip(samples, open_, strict=True)]
    covariance = _covariance(torch.cat([place - time * wind for time in times for place in places]), seeing)
    factor = torch.linalg.cholesky(covariance + 1e-9 * torch.eye(len(covariance), dtype=torch.float64))
    for first in range(0, n_draws, _FRAMES):
        count = min(_FRAMES, n_draws - first)
        phases = (factor @ torch.randn(len(factor), count, dtype=torch.float64, generator=generator)).T
        pieces = iter(phases.split([len(place) for _ in times for place in places], dim=1))
        otf = torch.zeros(count, *grid.shape, dtype=torch.complex128)
        for _ in times:
            for own, inside, share, wavelength in zip(samples, open_, band.shares, band.wavelengths, strict=True):
                phase = torch.zeros(count, *inside.shape, dtype=torch.float64)
                phase[:, inside] = next(pieces) * grid.wavelength / wavelength
                otf += share / n_instants * _otf(own, grid, phase)
        yield otf.abs() ** 2


def sampled_mean_square(
    aperture: Aperture,
    grid: Grid,
    pixels: Tensor,
    seeing: Seeing,
    band: Band | None = None,
    *,
    n_instants: int = 1,
    oversampling: int = 1,
) -> Tensor:
    """Return E|OTF|^2 (F,) of the exposures of `drawn_powers` by its definition, at `pixels` (F, 2), rows and columns.

    It is the mean of exp(-E[(a (phi_1 - phi_2) - a' (phi_3 - phi_4))^2] / 2) over all pairs of such pairs of samples as
    the baseline joins, of all instants and wavelengths.
    """
    band, samples = _sampled(aperture, grid, band, oversampling)
    pupils = [_pupil(own).roll((own.raster[0] // 2, own.raster[1] // 2), (0, 1)) for own in samples]
    steps = [torch.tensor(own.step[::-1], dtype=torch.float64) for own in samples]
    scales = [grid.wavelength / wavelength for wavelength in band.wavelengths]
    shifts = torch.stack([torch.fft.fftfreq(n, 1 / n)[at] for n, at in zip(grid.shape, pixels.T, strict=True)], -1)
    shifts = oversampling * shifts.round().long()
    reach = 4 * aperture.reach + grid.period * max(1.0, *(1 / scale for scale in scales))
    structure = seeing.structure(reach + seeing.exposure * seeing.speed)
    found = torch.zeros(len(pixels), dtype=torch.float64)
    for row, shift in enumerate(shifts):
        overlaps = []
        for pupil, step in zip(pupils, steps, strict=True):
            both = pupil * pupil.roll((-shift).tolist(), (0, 1))
            inside = both.nonzero()
            baseline = shift.flip(0) * step
            places = (inside - torch.tensor(pupil.shape) // 2).flip(1) * step + baseline / 2
            overlaps.append((places, both[inside.unbind(1)] / pupil.sum(), baseline))
        for i, j in itertools.product(range(len(overlaps)), repeat=2):
            (points, weights, one), (others, other_weights, other) = overlaps[i], overlaps[j]
            for lag in range(n_instants):
                drift = torch.tensor(_velocity(seeing), dtype=torch.float64) * seeing.exposure * lag / n_instants
                share = band.shares[i] * band.shares[j] * (2 if lag else 1) * (n_instants - lag) / n_instants**2
                for some, own in zip(points.split(_ROWS), weights.split(_ROWS), strict=True):
                    apart = others - some[:, None] + drift
                    variance = difference_variance(structure, apart, one, other, scales[i], scales[j])
                    found[row] += share * (own @ torch.exp(-variance / 2) @ other_weights)
    return found


def _velocity(seeing: Seeing) -> tuple[float, float]:
    """Return the wind [m/s], along x if its direction is not known."""
    return seeing.wind if isinstance(seeing.wind, tuple) else (seeing.speed, 0.0)


def _pupil(samples: PupilSamples) -> Tensor:
    """Return the amplitude of the pupil on its raster, with the origin at the first pixel."""
    pupil = torch.zeros(math.prod(samples.raster), dtype=torch.float64)
    return pupil.scatter_add(0, samples.index.flatten(), samples.weights.flatten()).unflatten(0, samples.raster)


def _sampled(aperture: Aperture, grid: Grid, band: Band | None, oversampling: int) -> tuple[Band, list[PupilSamples]]:
    """Return the band, and the samples of the pupil at each of its wavelengths."""
    band = Band.of([grid.wavelength]) if band is None else band
    grids = [Grid(grid.n_pixels, grid.pixel_scale, wavelength) for wavelength in band.wavelengths]
    return band, [aperture.samples(own, oversampling) for own in grids]


def _covariance(points: Tensor, seeing: Seeing) -> Tensor:
    """Return the covariance of phases at `points` (S, 2) [m], less that at the origin, which |OTF| does not see."""
    structure = seeing.structure(2 * float(points.norm(dim=-1).max()))
    own = structure(points)
    rows = [
        (own[i : i + _ROWS, None] + own - structure(points[i : i + _ROWS, None] - points)) / 2
        for i in range(0, len(points), _ROWS)
    ]
    return torch.cat(rows)


def _otf(samples: PupilSamples, grid: Grid, phase: Tensor | None = None) -> Tensor:
    """Return the autocorrelation (..., H, W) of the pupil's samples, 1 at 0 for an ideal pupil."""
    weights = samples.weights.to(torch.complex128)
    field = (weights if phase is None else weights * phasor(phase)).flatten(-2)
    pupil = torch.zeros(*field.shape[:-1], math.prod(samples.raster), dtype=field.dtype)
    pupil = pupil.scatter_add(-1, samples.index.flatten(-2).expand(field.shape), field).unflatten(-1, samples.raster)
    intensity = torch.fft.fft2(pupil).abs() ** 2 / math.prod(samples.raster)
    return torch.fft.fft2(fold(intensity, grid.shape)) / samples.weights.sum()
