"""Von Karman phase screens without end, of which any window can be looked at, again and again.

The spectrum is split by smooth cuts into bands, and each band is white noise filtered by its share of the spectrum. A
smooth share has a short filter, so a window needs the noise of its own surroundings only; and the noise of any place is
known, because a counter-based generator (Philox: Salmon et al., Supercomputing 2011) draws every tile of it by seed and
place alone. Within a tile the window moves by the shift theorem, exactly; from tile to tile the noise further away than
the filter reaches is exchanged, which changes the phase by some 1e-4 of its rms. The first band has the noise on the
samples of the window, and holds the frequencies beyond Nyquist, folded; the lower ones have it on coarser rasters.

The expected structure function is von Karman's to 0.1 % between samples of a window. Between windows it is so when they
are whole samples apart, right to 1.5 % from one sample on, and too small by less: half a sample away by 13 %.
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

_RATIO = 3.0  # of the lower edges of successive bands
_STEEPNESS = 8  # of the cuts exp(-x^8)
_NEGLIGIBLE = 1.45  # their x where they end
_REACH = 4.0  # of a band's filter, over the wavelength of its lower edge: 1.5e-4 of its amplitude lie beyond
_HOST: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}


@dataclass(frozen=True)
class NoiseRaster:
    """White noise as one band uses it: `tiles` x `tiles` tiles of `size` (y, x) samples in steps of `step` (y, x) [m].

    `lead` (y, x) [m] is the way from the corner of the noise to that of the window when the window is in mid-tile.
    """

    tiles: int
    size: tuple[int, int]
    step: tuple[float, float]
    lead: tuple[float, float]

    @property
    def shape(self) -> tuple[int, int]:
        """Samples in all, odd: no wave is without its opposite."""
        return self.tiles * self.size[0], self.tiles * self.size[1]

    @property
    def first(self) -> tuple[int, int]:
        """The sample (row, column) nearest to `lead`."""
        return round(self.lead[0] / self.step[0]), round(self.lead[1] / self.step[1])

    def frequencies(self) -> tuple[Tensor, Tensor]:
        """Of rows and of columns from 0 on [cycles/m]."""
        (rows, columns), (dy, dx) = self.shape, self.step
        return torch.fft.fftfreq(rows, dy, **_HOST), torch.fft.rfftfreq(columns, dx, **_HOST)

    def amplitude(self, density: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        """Of waves of power `density(fy, fx)` [rad^2 m^2], even in both, over that of the noise's transform."""
        rows, columns = self.frequencies()
        quadrant = density(rows[: len(rows) // 2 + 1], columns)
        n_samples, cell = math.prod(self.shape), math.prod(self.step)
        amplitude = (quadrant / (n_samples * cell) / n_samples).sqrt()
        return torch.cat([amplitude, amplitude[1:].flip(0)])

    def locate(self, corner: tuple[float, float]) -> tuple[tuple[int, int], tuple[float, float]]:
        """The tile in which a window at `corner` (y, x) [m] is, and how far from its middle [m]."""
        pitch = [n * s for n, s in zip(self.size, self.step, strict=True)]
        tile = [math.floor(c / p + 0.5) for c, p in zip(corner, pitch, strict=True)]
        return (tile[0], tile[1]), (corner[0] - tile[0] * pitch[0], corner[1] - tile[1] * pitch[1])

    def draw(self, seed: int, band: int, tile: tuple[int, int]) -> Tensor:
        """The noise around `tile`, float32 on the CPU."""
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
    """A band of the spectrum: its noise and how strong its waves are.

    raster : where the noise is
    amplitude : (rows, columns // 2 + 1) of the waves of the noise's transform, those of `torch.fft.rfft2`
    waves : (rows of the window, rows) complex, which carry them to the window's rows; None if the window's samples are
        those of the noise
    """

    raster: NoiseRaster
    amplitude: Tensor
    waves: Tensor | None


class ScreenWindow:
    """What endless screens of one outer scale, with r0 = 1 m, need to be seen through windows of one shape.

    Parameters
    ----------
    shape : (rows, columns)
        Of the window.
    step : (dy, dx)
        Distance of samples [m].
    outer_scale : float
        [m].
    dtype, device
        float32 or float64.
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
            """Share of the spectrum that is left to the bands below band `level`."""
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
            waves = _phasor(y[:, None] * fy).to(device, COMPLEX[dtype])
            self.bands.append(LocalBand(raster, raster.amplitude(density).to(device, dtype), waves))
            wave = torch.where(fx > 0, 2, 1)[:, None] * _phasor(fx[:, None] * x)  # the opposite waves have no column
            columns += [wave.real, -wave.imag]
        self.columns: Tensor = torch.cat(columns).to(device, dtype)
        """Real and imaginary waves that carry all bands but the first to the window's columns."""


class Screen:
    """One endless screen: its phase is a function of place alone, given `seed`.

    Parameters
    ----------
    window : ScreenWindow
    r0 : float
        Fried parameter [m].
    seed : int
        At least 0 and below 2^64; screens of other seeds are independent.

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
        """The phase (rows, columns) [rad] on the samples of the window; the first of them is at `corner` (x, y) [m]."""
        fine, smooth = None, []
        for number, band in enumerate(self.window.bands):
            tile, offset = band.raster.locate((corner[1], corner[0]))
            moves = (_phasor(f * o) for f, o in zip(band.raster.frequencies(), offset, strict=True))
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
        """The transform of a band's noise around `tile`, filtered; the last one is kept."""
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
    """On the window's own samples: tiles of at least 33, so that a window moves by 16 before the noise changes."""
    needed = [math.ceil((e + 2 * reach) / s) + 1 for e, s in zip(extent, step, strict=True)]
    choices = [(tiles, [_odd_fast(max(33, math.ceil(n / (tiles - 1)))) for n in needed]) for tiles in range(3, 17, 2)]
    tiles, size = min(choices, key=lambda choice: choice[0] ** 2 * math.prod(choice[1]))
    lead = [(tiles * n - 1 - round(e / s)) // 2 * s for n, e, s in zip(size, extent, step, strict=True)]
    return NoiseRaster(tiles, (size[0], size[1]), step, (lead[0], lead[1]))


def _coarse_raster(extent: tuple[float, float], reach: float, highest: float) -> NoiseRaster:
    """So fine that it holds the band, whose cut has the edge `highest` [cycles/m]."""
    tiles = 3
    pitch = [(e + 2 * reach) / (tiles - 1) for e in extent]
    size = [_odd_fast(math.ceil(2 * _NEGLIGIBLE * highest * p)) for p in pitch]
    step = [p / n for p, n in zip(pitch, size, strict=True)]
    lead = [(tiles * p - e) / 2 for p, e in zip(pitch, extent, strict=True)]
    return NoiseRaster(tiles, (size[0], size[1]), (step[0], step[1]), (lead[0], lead[1]))


def _odd_fast(least: int) -> int:
    """The smallest odd number from `least` on that has no prime factor above 13: a fast length for an FFT."""
    number = least | 1
    while True:
        rest = number
        for prime in (3, 5, 7, 11, 13):
            while rest % prime == 0:
                rest //= prime
        if rest == 1:
            return number
        number += 2


def _phasor(cycles: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)
