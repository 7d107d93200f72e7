"""The power of fringes in frames of any object, compared with what masks would show.

Fringes have power only at the baselines of the mask, whatever the object, the pistons of turbulence and the background.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.phasor import phasor

_AT_A_TIME = 32  # frames
_RING = 2  # width of a ring of spatial frequencies, in units of their spacing
_SECTORS = 6  # of half a ring; the power of real frames repeats itself in the other half
_FLOOR = 0.03  # of the mean power of a ring: light between the fringes that the pattern lacks, as of a cut-out's border
_LEAST = 8  # frequencies needed to tell anything
# Errors of shares hold for light at all frequencies, and until light in few rings has made the variance of a share this
# many times as large. With that, the shares of other masks scatter by 0.8 to 1.3 errors.
_HOLDS = 4.0
_LIT = 0.1  # of the largest share: wavelengths with less hardly show, as power goes by its square


class Match(NamedTuple):
    """How much of a mask's pattern the power of fringes shows.

    share : 1 if the pattern is that of the mask, 0 if it has nothing to do with it; in frames of extended objects the
        right mask has 0.5 to 1.2, see docs/method.md
    error : standard error of the share
    """

    share: float
    error: float


@dataclass(frozen=True, eq=False)
class FringePower:
    """Mean power of frames at the spatial frequencies that a mask transmits, without those within one hole.

    power : (F,) mean |DFT|^2
    noise : power of the noise
    grid : grid of the frames
    chosen : (H, W) bool, the F frequencies, in FFT order
    rings : (F,) number of the ring of similar frequencies, or of the sector of a ring, to which each belongs
    wavelengths : of the light [m], with equal shares of it; none: that of the grid
    """

    power: Tensor
    noise: float
    grid: Grid
    chosen: Tensor
    rings: Tensor
    wavelengths: Sequence[float] = ()

    @classmethod
    def of(
        cls, frames: Tensor, aperture: SparseAperture, grid: Grid, wavelengths: Sequence[float] = ()
    ) -> FringePower | None:
        """Return the power of frames (T, H, W), weighted by a Hann window; None if too few frequencies are left.

        Frames may be on any device; the power, and what is compared with it, is on that of the aperture.
        """
        nu_y, nu_x = grid.frequencies(torch.float64, aperture.centers.device)
        radius = torch.hypot(nu_y, nu_x)
        window = [
            torch.hann_window(side, periodic=False, dtype=torch.float64, device=frames.device) for side in grid.shape
        ]
        power = torch.zeros_like(radius, device=frames.device)
        for part in frames.double().split(_AT_A_TIME):
            still = (part - part.mean((1, 2), keepdim=True)) * window[0][:, None] * window[1]
            power += (torch.fft.fft2(still).abs() ** 2).sum(0) / len(frames)
        power = power.to(radius.device)
        bluest = replace(grid, wavelength=min(wavelengths or [grid.wavelength]))
        reach = bluest.cutoff(aperture.extent)
        chosen = (radius > bluest.cutoff(aperture.outer_diameter)) & (radius <= reach) & (power > 0)
        beyond = radius > max(reach, 0.5)  # the corners hold no light of a larger mask either
        if int(beyond.sum()) < _LEAST or int(chosen.sum()) < _LEAST:
            return None
        rings = (radius[chosen] * (max(grid.shape) / _RING)).round().long()
        return cls(power[chosen], float(power[beyond].mean()), grid, chosen, rings, wavelengths)

    def match(self, aperture: SparseAperture, pattern: Tensor | None = None) -> Match:
        """Return how much of the pattern of a mask the power shows; it is its `expected_power`, if that is known.

        The share is the slope of the logarithm of the power over that of a point source behind the mask, within rings
        of similar frequencies: an object and turbulence change the power from ring to ring. It scatters as if each of
        the N (N - 1) baselines were one independent measurement, and by `wider` times that where light
        lies in few rings.
        """
        pattern = expected_power(aperture, self.grid, self.wavelengths) if pattern is None else pattern
        pattern = _smoothed(pattern)[self.chosen].clamp(min=0)
        light = self._means(self.power - self.noise).clamp(min=0)
        floor = _FLOOR * light + 1e-12 * float(self.power.max())
        expected = light / self._means(pattern).clamp(min=1e-12) * pattern + self.noise + floor
        expected, measured = (self._within_rings(values.log()) for values in (expected, self.power + floor))
        contrast, n = float(expected @ expected), aperture.n_subapertures
        if contrast < 1e-12 * len(expected):
            return Match(0.0, math.inf)
        error = math.sqrt(float(measured @ measured) / contrast / (n * (n - 1)))
        return Match(float(measured @ expected) / contrast, error)

    def in_sectors(self) -> FringePower:
        """Return the same power, compared within sectors of rings.

        Of an object that is long and narrow, whose power is uneven around a ring, they tell more than rings; of others
        less.
        """
        nu_y, nu_x = self.grid.frequencies(torch.float64, self.power.device)
        turns = torch.atan2(nu_y, nu_x)[self.chosen] / math.pi
        sectors = (torch.remainder(turns, 1.0) * _SECTORS).long().clamp(max=_SECTORS - 1)
        return replace(self, rings=self.rings * _SECTORS + sectors)

    @cached_property
    def wider(self) -> float:
        """By how much errors are larger since light lies in few rings; 1 where it lies in all.

        A share is told by frequencies with light. In faint frames these are the ones of a few rings, in which the
        object makes a difference too, while all others hold hardly anything but noise, which scatters little in the
        mean of many frames. So a ring's scatter counts by the square of the share of light in its power, as the
        contrast of the pattern does.
        """
        square = self._within_rings(self.power.log()) ** 2
        weights = (1 - self.noise / self._means(self.power)).clamp(min=0) ** 2
        everywhere = float(square.mean() * weights.sum())
        ratio = float(weights @ square) / everywhere if everywhere > 0 else 0.0
        return math.sqrt(max(1.0, ratio / _HOLDS))

    def _means(self, values: Tensor) -> Tensor:
        """Return the mean of values (F,) over the ring of each."""
        sums, counts = (
            values.new_zeros(int(self.rings.max()) + 1).index_add_(0, self.rings, each)
            for each in (values, torch.ones_like(values))
        )
        return (sums / counts.clamp(min=1))[self.rings]

    def _within_rings(self, values: Tensor) -> Tensor:
        """Return values (F,) minus the mean of their ring."""
        return values - self._means(values)


def fringe_wavelengths(aperture: SparseAperture, grid: Grid, band: Band) -> list[float]:
    """Return wavelengths [m] evenly through the part of a band that has light; its middle for a narrow one.

    The farthest fringes of one and the next, which are two holes wide, lie half a hole apart at most.
    """
    least = _LIT * max(band.shares)
    lit = [1 / wavelength for wavelength, share in zip(band.wavelengths, band.shares, strict=True) if share >= least]
    apart = float(aperture.extent) * grid.wavelength * (max(lit) - min(lit))  # of one pair's fringes at both ends [m]
    n = max(1, math.ceil(2 * apart / aperture.subaperture_diameter))
    return [1 / (min(lit) + (number + 0.5) / n * (max(lit) - min(lit))) for number in range(n)]


def likeness(one: Tensor, other: Tensor) -> float:
    """Return the correlation of the `expected_power` (H, W) of two masks; 1 if frames cannot tell them apart."""
    patterns = [(pattern - pattern.mean()).flatten() for pattern in (one, other)]
    return float(torch.nn.functional.cosine_similarity(*patterns, dim=0))


def expected_power(aperture: SparseAperture, grid: Grid, wavelengths: Sequence[float] = ()) -> Tensor:
    """Return the mean (H, W) of the power of all fringes over wavelengths [m]; none: that of the grid."""
    powers = [
        _pair_power(aperture, replace(grid, wavelength=wavelength)) for wavelength in wavelengths or [grid.wavelength]
    ]
    return torch.stack(powers).mean(0)


def _pair_power(aperture: SparseAperture, grid: Grid) -> Tensor:
    """Return the sum (H, W) of |OTF|^2 over the pairs of holes, its mean for independent pistons.

    It is one patch convolved with all baselines, whose transform is |sum of exp(2 pi i x . nu_m)|^2 - N.
    """
    nu_y, nu_x = grid.frequencies(torch.float64, aperture.centers.device)
    shift = torch.stack(torch.broadcast_tensors(nu_x, nu_y), -1) * grid.period
    patch = torch.fft.ifft2(aperture.shape.otf(shift, aperture.subaperture_diameter) ** 2)
    x, y = nu_x * grid.shape[1], nu_y * grid.shape[0]  # whole pixels, in FFT order
    phase = 2 * math.pi / grid.period * aperture.centers.detach().double()
    waves = [phasor(angle) for angle in (phase[:, 1:] * y.T, phase[:, :1] * x)]
    pairs = (waves[0].T @ waves[1]).abs() ** 2 - len(phase)
    return torch.fft.fft2(patch * pairs).real


def _smoothed(power: Tensor) -> Tensor:
    """Return a power spectrum (H, W) as seen through a Hann window, up to a factor: its transform squared is short."""
    for dim in (0, 1):
        power = (power.roll(1, dim) + 4 * power + power.roll(-1, dim)) / 6
    return power
