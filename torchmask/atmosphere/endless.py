"""Von Karman phase screens of unlimited size, which can be evaluated in any window, in any order.

Smooth cuts split the spectrum into bands, and each band is white noise filtered by its share of the spectrum. A smooth
share has a short filter, so a window needs only the noise around it. That noise comes in tiles, which a counter-based
generator (Philox: Salmon et al., Supercomputing 2011) draws from the seed and the tile's position alone, so the same
place always has the same noise. Within a tile, the shift theorem moves the window exactly. When the window enters
another tile, noise beyond the reach of the filter is replaced, which changes the phase by about 1e-4 of its rms. The
first band has its noise on the samples of the window and includes the aliased frequencies beyond Nyquist; the lower
bands have theirs on coarser rasters.

Between samples of one window, and between windows that are a whole number of samples apart, the expected structure
function is von Karman's to 0.1 %. Between other windows it is accurate to 1.5 % at separations of at least one sample
and too small at shorter ones, by 13 % at half a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.random_field import COMPLEX, folded_density
from torchmask.atmosphere.von_karman import von_karman_psd
from torchmask.optics.phasor import phasor

_RATIO = 3.0  # between the lower edges of successive bands
_STEEPNESS = 8  # exponent of the cuts exp(-x^8)
_NEGLIGIBLE = 1.45  # the x beyond which a cut counts as zero
_REACH = 4.0  # reach of a band's filter, in wavelengths of its lower edge; 1.5e-4 of its amplitude lies beyond
_HOST: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}


@dataclass(frozen=True)
class NoiseRaster:
    """Raster of white noise for one band: `tiles` x `tiles` tiles of `size` (y, x) samples, `step` (y, x) [m] apart.

    `lead` (y, x) [m] is the offset of the window's corner from the corner of the noise when the window is centred in
    its tile.
    """

    tiles: int
    size: tuple[int, int]
    step: tuple[float, float]
    lead: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """Total number of samples (rows, columns), both odd so that every frequency has its negative."""
        return self.tiles * self.size[0], self.tiles * self.size[1]

    @property
    def first(self) -> tuple[int, int]:
        """Sample (row, column) nearest to `lead`."""
        return round(self.lead[0] / self.step[0]), round(self.lead[1] / self.step[1])

    def frequencies(self) -> tuple[Tensor, Tensor]:
        """Return the frequencies of the rows and the non-negative frequencies of the columns [cycles/m]."""
        (rows, columns), (dy, dx) = self.shape, self.step
        return torch.fft.fftfreq(rows, dy, **_HOST), torch.fft.rfftfreq(columns, dx, **_HOST)

    def amplitude(self, density: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Return the factor that gives the transform of unit noise the power `density(fy, fx)` [rad^2 m^2].

        The density must be even in both frequencies. The result has the shape of `torch.fft.rfft2` of the noise.
        """
        rows, columns = self.frequencies()
        quadrant = density(rows[: len(rows) // 2 + 1], columns)
        n_samples, cell = math.prod(self.shape), math.prod(self.step)
        amplitude = (quadrant / (n_samples * cell) / n_samples).sqrt()
        return torch.cat([amplitude, amplitude[1:].flip(0)])

    def locate(self, corner: tuple[float, float]) -> tuple[tuple[int, int], tuple[float, float]]:
        """Return the tile that holds a window at `corner` (y, x) [m], and the window's offset from its middle [m]."""
        pitch = [n * s for n, s in zip(self.size, self.step, strict=True)]
        tile = [math.floor(c / p + 0.5) for c, p in zip(corner, pitch, strict=True)]
        return (tile[0], tile[1]), (corner[0] - tile[0] * pitch[0], corner[1] - tile[1] * pitch[1])

    def draw(self, seed: int, band: int, tile: tuple[int, int]) -> Tensor:
        """Draw the noise around `tile`, float32 on the CPU."""
        rows = []
        for y in range(tile[0], tile[0] + self.tiles):
            row = []
            for x in range(tile[1], tile[1] + self.tiles):
                place = np.array([0, y, x, band], dtype=np.int64).view(np.uint64)
                source = np.random.Generator(np.random.Philox(counter=place, key=seed))
                row.append(source.standard_normal(self.size, dtype=np.float32))
            rows.append(np.concatenate(row, axis=1))
        return torch.from_numpy(np.concatenate(rows))


class LocalBand(NamedTuple):
    """One band of the spectrum: its noise and its filter.

    raster : raster of the noise
    amplitude : (rows, columns // 2 + 1), the filter, by which `torch.fft.rfft2` of the noise is multiplied
    waves : (rows of the window, rows) complex, evaluates the transform on the rows of the window; None if the noise
        lies on the samples of the window
    """

    raster: NoiseRaster
    amplitude: Tensor
    waves: Tensor | None


class ScreenWindow:
    """Filters, for r0 = 1 m, that evaluate endless screens of one outer scale in windows of one shape.

    Parameters
    ----------
    shape : (rows, columns)
        Number of samples of the window.
    step : (dy, dx)
        Spacing of the samples [m].
    outer_scale : float
        Outer scale of the turbulence [m].
    dtype : torch.dtype
        Type of the phases, float32 or float64.
    device : torch.device
        Device of the phases.
    """

    shape: tuple[int, int]
    dtype: torch.dtype
    device: torch.device

    def __init__(
        self,
        shape: tuple[int, int],
        step: tuple[float, float],
        outer_scale: float,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.shape, self.dtype, self.device = shape, dtype, device
        extent = ((shape[0] - 1) * step[0], (shape[1] - 1) * step[1])
        reach = max(0.35 * max(extent), 2 * _REACH * _NEGLIGIBLE * max(step))
        edge = _REACH / reach
        levels = max(1, math.ceil(math.log(1.5 * outer_scale / reach, _RATIO)))  # until a filter spans the outer scale

        def below(frequency: Tensor, level: int) -> Tensor:
            """Return the share of the spectrum that belongs to the bands below band `level`."""
            return torch.exp(-((frequency * _RATIO**level / edge) ** _STEEPNESS))

        raster = _fine_raster(extent, reach, step)
        above = raster.amplitude(
            lambda fy, fx: folded_density(fy, fx, step, 1.0, outer_scale, lambda f: 1 - below(f, 0))
        )
        self.bands: list[LocalBand] = [LocalBand(raster, above.to(device, dtype), None)]
        columns = []
        for level in range(1, levels + 1):
            raster = _coarse_raster(extent, reach * _RATIO**level, edge / _RATIO ** (level - 1))

            def density(fy: Tensor, fx: Tensor, level: int = level) -> Tensor:
                f = torch.hypot(fy[:, None], fx)
                share = below(f, level - 1) - (below(f, level) if level < levels else 0)
                return von_karman_psd(f, 1.0, outer_scale) * share

            fy, fx = raster.frequencies()
            y, x = (torch.arange(n, **_HOST) * s + lead for n, s, lead in zip(shape, step, raster.lead, strict=True))
            waves = phasor(2 * math.pi * y[:, None] * fy).to(device, COMPLEX[dtype])
            self.bands.append(LocalBand(raster, raster.amplitude(density).to(device, dtype), waves))
            # The transform stores only fx >= 0, so each fx > 0 counts twice, for -fx too.
            wave = torch.where(fx > 0, 2, 1)[:, None] * phasor(2 * math.pi * fx[:, None] * x)
            columns += [wave.real, -wave.imag]
        self.columns: Tensor = torch.cat(columns).to(device, dtype)
        """Real and imaginary waves that evaluate all bands but the first on the columns of the window."""


class Screen:
    """One endless screen, whose phase at any place depends only on `seed`.

    Parameters
    ----------
    window : ScreenWindow
        Shape and sampling of the windows in which the screen is evaluated.
    r0 : float
        Fried parameter [m].
    seed : int
        At least 0 and below 2^64. Screens with different seeds are independent.

    Examples
    --------
    >>> window = ScreenWindow((32, 32), (0.01, 0.01), 20.0, torch.float64, torch.device("cpu"))
    >>> screen = Screen(window, r0=0.1, seed=0)
    >>> here, there = screen.at((0.0, 0.0)), screen.at((0.02, 0.0))  # two samples to the right
    >>> torch.allclose(there[:, :-2], here[:, 2:])
    True
    """

    def __init__(self, window: ScreenWindow, r0: float, seed: int) -> None:
        self.window = window
        self.strength: float = r0 ** (-5 / 6)
        self.seed = seed
        self._seen: list[tuple[tuple[int, int], Tensor] | None] = [None] * len(window.bands)

    def at(self, corner: tuple[float, float]) -> Tensor:
        """Return the phase (rows, columns) [rad] in the window whose first sample is at `corner` (x, y) [m]."""
        fine, smooth = None, []
        for number, band in enumerate(self.window.bands):
            tile, offset = band.raster.locate((corner[1], corner[0]))
            moves = (phasor(2 * math.pi * f * o) for f, o in zip(band.raster.frequencies(), offset, strict=True))
            to_y, to_x = (move.to(self.window.device, COMPLEX[self.window.dtype]) for move in moves)
            waves = self._waves(number, tile)
            if band.waves is None:
                fine = self._fine(waves * to_y[:, None] * to_x, band.raster)
            else:
                rows = (band.waves * to_y) @ waves * to_x
                smooth += [rows.real, rows.imag]
        assert fine is not None
        return self.strength * (fine + torch.cat(smooth, dim=1) @ self.window.columns)

    def _waves(self, number: int, tile: tuple[int, int]) -> Tensor:
        """Return the filtered transform of a band's noise around `tile`; the latest one is kept for reuse."""
        seen = self._seen[number]
        if seen is None or seen[0] != tile:
            band = self.window.bands[number]
            noise = band.raster.draw(self.seed, number, tile).to(self.window.device, self.window.dtype)
            seen = self._seen[number] = (tile, torch.fft.rfft2(noise) * band.amplitude)
        return seen[1]

    def _fine(self, waves: Tensor, raster: NoiseRaster) -> Tensor:
        (rows, columns), (row, column) = self.window.shape, raster.first
        strip = torch.fft.ifft(waves, dim=0, norm="forward")[row : row + rows]
        return torch.fft.irfft(strip, n=raster.shape[1], dim=1, norm="forward")[:, column : column + columns]


def _fine_raster(extent: tuple[float, float], reach: float, step: tuple[float, float]) -> NoiseRaster:
    """Return the noise raster of the first band, which lies on the samples of the window.

    Tiles have at least 33 samples a side, so a window can move by 16 samples before its noise changes.
    """
    needed = [math.ceil((e + 2 * reach) / s) + 1 for e, s in zip(extent, step, strict=True)]
    choices = [(tiles, [_odd_fast(max(33, math.ceil(n / (tiles - 1)))) for n in needed]) for tiles in range(3, 17, 2)]
    tiles, size = min(choices, key=lambda choice: choice[0] ** 2 * math.prod(choice[1]))
    lead = [(tiles * n - 1 - round(e / s)) // 2 * s for n, e, s in zip(size, extent, step, strict=True)]
    return NoiseRaster(tiles, (size[0], size[1]), step, (lead[0], lead[1]))


def _coarse_raster(extent: tuple[float, float], reach: float, highest: float) -> NoiseRaster:
    """Return the noise raster of a lower band, fine enough for the band's upper edge `highest` [cycles/m]."""
    tiles = 3
    pitch = [(e + 2 * reach) / (tiles - 1) for e in extent]
    size = [_odd_fast(math.ceil(2 * _NEGLIGIBLE * highest * p)) for p in pitch]
    step = [p / n for p, n in zip(pitch, size, strict=True)]
    lead = [(tiles * p - e) / 2 for p, e in zip(pitch, extent, strict=True)]
    return NoiseRaster(tiles, (size[0], size[1]), (step[0], step[1]), (lead[0], lead[1]))


def _odd_fast(least: int) -> int:
    """Return the smallest odd FFT length of at least `least` that is fast, with no prime factor above 13."""
    number = least | 1
    while True:
        rest = number
        for prime in (3, 5, 7, 11, 13):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return number
        number += 2
