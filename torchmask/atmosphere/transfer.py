"""The mean squared transfer function of any aperture under turbulence, computed on a sampled pupil.

For a pupil P and the baseline b = wavelength * (angular frequency), H(b) is the mean of exp(i (phi(x) - phi(x + b)))
over the overlap P(x) P(x + b), times the overlap. So (Korff, J. Opt. Soc. Am. 63, 971, 1973)

    E|H(b)|^2 = T(b)^2 < exp(-Q(b, s) / 2) >,   Q(b, s) = 2 D(b) + 2 D(s) - D(s + b) - D(s - b),

with T the transfer function without turbulence, D the phase structure function, and the mean taken over all pairs of
points of the overlap, of separation s: over the autocorrelation of the overlap. Sampling is the only approximation.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.grid import Grid
from torchmask.optics.band import Band
from torchmask.optics.pupil import Aperture

_HOST = {"dtype": torch.float64, "device": "cpu"}  # whatever the default device
_PER_R0 = 6  # samples per r0
_PER_HOLE = 24  # samples across the finest part of a hole at least; a small r0 may need more
_AROUND = 4  # cells beyond the circle about a hole, where even those on the edges' straight continuations are closed
_NOTHING = 1e-12  # of a density, below which it is a rounding error of its Fourier transform
_COARSE = 4  # lattice points to a side of a patch far from zero and from the baseline, where Q hardly changes
_FAR = 6.0  # in r0, how far that is: a patch is then a ninth as wide as its distance
_BLOCK = 32_768  # separations at a time, whose arrays stay in the cache, which makes it twice as fast
_LOST = 60.0  # of Q [rad^2], at which exp(-Q / 2), 1e-13, is far below any E|OTF|^2


def mean_square_otf(
    aperture: Aperture, grid: Grid, frequencies: Tensor, seeing: Seeing, band: Band | None = None
) -> Tensor:
    """Return E|OTF|^2 of one aperture at given frequencies, for any pupil but slowly; only sampling is approximated.

    Parameters
    ----------
    aperture : Aperture
        One mask or full pupil, centres (N, 2).
    grid : Grid
        Grid whose pixel scale converts frequencies to baselines, and whose wavelength r0 refers to.
    frequencies : (F, 2)
        Spatial frequencies (nu_x, nu_y) [cycles/pixel], which are not wrapped around.
    seeing : Seeing
        Turbulence and exposure.
    band : Band, optional
        Wavelengths of the light. None: that of the grid.

    Returns
    -------
    Tensor
        (F,) float64, 1 at zero frequency; not differentiable.

    Raises
    ------
    ValueError
        If several masks are given.

    Notes
    -----
    For each frequency, each pair of wavelengths takes a Fourier transform of the pupil's raster, which has 6 samples
    per r0 and 24 per hole. The overlap T is exact, and the mean over it is accurate to about 0.5 %.

    Examples
    --------
    The speckle transfer function of a full pupil, over its limit 0.435 (r0/D)^2 T for high D/r0:

    >>> from torchmask.optics.aperture import FullAperture
    >>> grid = Grid.nyquist(1.0, 550e-9, 64)
    >>> value = mean_square_otf(FullAperture(1.0), grid, torch.tensor([[0.25, 0.0]]), Seeing(r0=0.1))
    >>> round(float(value) / (0.4353 * 0.1**2 * 0.391), 1)
    1.5
    """
    return _square_otf(aperture, grid, frequencies, seeing, band, steady=False)


def steady_square_otf(
    aperture: Aperture, grid: Grid, frequencies: Tensor, seeing: Seeing, band: Band | None = None
) -> Tensor:
    """Return what of |OTF|^2 (F,) does not fluctuate, T(b)^2 exp(-<Q(b, s)> / 2), as `mean_square_otf` does E|OTF|^2.

    <Q> / 2 is the variance, over the overlap and the exposure, of the phase difference that the baseline joins.
    """
    return _square_otf(aperture, grid, frequencies, seeing, band, steady=True)


def _square_otf(
    aperture: Aperture, grid: Grid, frequencies: Tensor, seeing: Seeing, band: Band | None, steady: bool
) -> Tensor:
    if aperture.centers.ndim != 2:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: one mask is needed, (n_subapertures, 2)")
    band = Band.given(band, grid.wavelength)
    raster = OverlapRaster(aperture, seeing, min(band.shortest / grid.wavelength, 1.0))
    lengths = [wavelength / grid.pixel_scale for wavelength in band.wavelengths]
    shares = band.shares
    scales = [grid.wavelength / wavelength for wavelength in band.wavelengths]
    total = torch.zeros(len(frequencies), **_HOST)
    for row, frequency in enumerate(frequencies.double().cpu()):
        baselines = [frequency * length for length in lengths]
        overlaps = [raster.overlap(baseline) for baseline in baselines]
        for i, j in itertools.combinations_with_replacement(range(len(lengths)), 2):
            (one, first), (other, second) = overlaps[i], overlaps[j]
            if one * other == 0:
                continue
            mean = raster.steady if steady else raster.coherence
            kept = mean(raster.density(first, second), baselines[i], baselines[j], scales[i], scales[j])
            total[row] += (1 + (i != j)) * shares[i] * shares[j] * one * other * kept
    return total.to(frequencies.device)


def difference_variance(
    structure: StructureFunction,
    separation: Tensor,
    baseline: Tensor,
    other: Tensor,
    scale: float | Tensor = 1.0,
    other_scale: float | Tensor = 1.0,
) -> Tensor:
    """Return E[(a (phi_1 - phi_2) - a' (phi_3 - phi_4))^2] (...) [rad^2] of two pairs of points.

    separation : (..., 2) vector s between the middles of the pairs [m]
    baseline, other : (..., 2) x_2 - x_1 and x_4 - x_3 [m]
    scale, other_scale : a and a', the reference wavelength over that of the pair
    """
    half, mean = (other - baseline) / 2, (other + baseline) / 2
    crossed = structure(separation + mean) + structure(separation - mean)
    parallel = structure(separation + half) + structure(separation - half)
    own = scale**2 * structure(baseline) + other_scale**2 * structure(other)
    return own - scale * other_scale * (crossed - parallel)


class OverlapRaster:
    """The sampled pupil of one aperture, with the functions for means over its overlaps.

    aperture : one aperture, centres (N, 2)
    seeing : turbulence and exposure
    shortest : shortest wavelength over the reference wavelength, at most 1
    """

    def __init__(self, aperture: Aperture, seeing: Seeing, shortest: float = 1.0) -> None:
        self.aperture = aperture
        self.centers: Tensor = aperture.centers.detach().cpu().double()
        diameter = aperture.subaperture_diameter
        step = min(seeing.r0 * shortest / _PER_R0, diameter * aperture.shape.fineness / _PER_HOLE)
        reach = float(self.centers.norm(dim=-1).max()) + aperture.outer_diameter / 2
        size = math.ceil(2 * reach / step) + 2
        self.axis: Tensor = (torch.arange(size, **_HOST) - (size - 1) / 2) * step
        self.points: Tensor = torch.stack(torch.meshgrid(self.axis, self.axis, indexing="xy"), -1)  # (size, size, 2)
        self.cell: Tensor = torch.tensor([step, step], **_HOST)
        padded = 2 * _COARSE * math.ceil(size / _COARSE)  # whole patches on both sides of zero
        self.padded: tuple[int, int] = (padded, padded)
        lag = torch.fft.fftfreq(padded, 1 / padded, **_HOST) * step
        self.lattice: Tensor = _patches(torch.stack(torch.meshgrid(lag, lag, indexing="xy"), -1))  # (B, S, 2)
        self.far: float = _FAR * seeing.r0 * shortest
        self.drift: tuple[Tensor, Tensor] = seeing.drift()
        furthest = 4 * reach + float(self.drift[0].norm(dim=-1).max()) + 2 * step
        self.structure: StructureFunction = seeing.structure(furthest)

    def _coverage(self, shift: Tensor) -> Tensor:
        """Return the open fraction of each cell of the pupil shifted by -shift (2,)."""
        diameter = self.aperture.subaperture_diameter
        total = torch.zeros(self.points.shape[:-1], **_HOST)
        reach = self.aperture.outer_diameter / 2 + _AROUND * self.cell
        for center in self.centers:  # cells that are further away are closed
            ends = torch.stack([center - shift - reach, center - shift + reach], -1)
            (left, right), (low, high) = torch.searchsorted(self.axis, ends).tolist()
            some = self.points[low:high, left:right] + shift - center
            total[low:high, left:right] += self.aperture.shape.coverage(some, self.cell, diameter)
        return total

    def samples(self, baseline: Tensor) -> tuple[float, Tensor]:
        """Return the exact T at the baseline (2,) [m], and the overlap (size, size) at `points`, of unit sum.

        The overlap P(x - b/2) P(x + b/2) consists of the middles of the pairs of points that the baseline joins.
        """
        pairs = self.centers[None] - self.centers[:, None] - baseline
        transfer = float(self.aperture.shape.otf(pairs, self.aperture.subaperture_diameter).sum()) / len(self.centers)
        samples = self._coverage(-baseline / 2) * self._coverage(baseline / 2)
        total = float(samples.sum())
        return (0.0, samples) if total == 0 or transfer <= 0 else (transfer, samples / total)

    def overlap(self, baseline: Tensor) -> tuple[float, Tensor]:
        """Return T at the baseline (2,) [m], and the Fourier transform of the overlap's samples."""
        transfer, samples = self.samples(baseline)
        return transfer, torch.fft.rfft2(samples, s=self.padded)

    def density(self, one: Tensor, other: Tensor) -> Tensor:
        """Return the density (B, S) of separations between points of two overlaps, on the lattice, of unit sum.

        It is even, the mean over either order of the two: each of the two instants may be the later one.
        """
        return _patches(torch.fft.irfft2((one.conj() * other).real, s=self.padded)[..., None])[..., 0]

    def _separations(self, density: Tensor, baseline: Tensor, other: Tensor) -> tuple[Tensor, Tensor]:
        """Return separations (P, 2) [m] and their weights (P,): one for each patch of the lattice that is far away."""
        middles = self.lattice.mean(1)
        beyond = max(float(baseline.norm()), float(other.norm())) + self.far + float(self.drift[0].norm(dim=-1).max())
        far = middles.norm(dim=-1) > beyond
        points = torch.cat([self.lattice[~far].flatten(0, 1), middles[far]])
        weights = torch.cat([density[~far].flatten(), density[far].sum(1)])
        return points[weights > _NOTHING], weights[weights > _NOTHING]

    def steady(self, density: Tensor, *pair: Any) -> Tensor:
        """Return exp(-<Q> / 2), the mean taken over the exposure and a density (B, S) of separations.

        `pair` holds both baselines and both scales, as `difference_variance` takes them.
        """
        points, weights = self._separations(density, *pair[:2])
        if float(weights @ self._least_variance(points, *pair)) > _LOST:
            return weights.new_zeros(())
        return torch.exp(-self._mean(lambda variance: variance, points, weights, pair) / 2)

    def coherence(self, density: Tensor, *pair: Any) -> Tensor:
        """Return <exp(-Q / 2)>, the mean and `pair` as for `steady`."""
        points, weights = self._separations(density, *pair[:2])
        near = self._least_variance(points, *pair) < _LOST
        return self._mean(lambda variance: torch.exp(-variance / 2), points[near], weights[near], pair)

    def _mean(
        self, function: Callable[[Tensor], Tensor], points: Tensor, weights: Tensor, pair: tuple[Any, ...]
    ) -> Tensor:
        """Return the mean of a function of Q over separations (P, 2) with weights (P,), and over the exposure."""
        drifts, shares = self.drift
        size = max(1, _BLOCK // len(shares))
        total = weights.new_zeros(())
        for some, weight in zip(points.split(size), weights.split(size), strict=True):
            variance = difference_variance(self.structure, some[:, None] + drifts, *pair)
            total = total + weight @ (function(variance) @ shares)
        return total

    def _least_variance(
        self, points: Tensor, baseline: Tensor, other: Tensor, scale: float, other_scale: float
    ) -> Tensor:
        """Return what Q (P,) is at least at separations (P, 2), at any time of the exposure.

        By the triangle inequality a drift changes the rms by no more than that of the drift at both ends of one pair.
        Most separations under strong turbulence need no more than this one evaluation.
        """
        variance = difference_variance(self.structure, points, baseline, other, scale, other_scale)
        change = 2 * min(scale, other_scale) * float(self.structure(self.drift[0]).max()) ** 0.5
        return (variance.clamp(min=0).sqrt() - change).clamp(min=0) ** 2


def _patches(lattice: Tensor) -> Tensor:
    """Return values (H, W, C) on the lattice as patches (B, S, C) of `_COARSE` points to a side."""
    rows = lattice.unflatten(0, (-1, _COARSE)).unflatten(2, (-1, _COARSE))
    return rows.transpose(1, 2).flatten(0, 1).flatten(1, 2)
