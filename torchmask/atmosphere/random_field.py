"""Stationary Gaussian fields with the spectrum of von Karman turbulence, on a raster.

Smooth windows split the spectrum into bands, each sampled on its own frequency lattice: the first band by FFT, the
lower ones (the sub-harmonics) as explicit sums of waves on finer and finer lattices. A lattice makes its band periodic,
but the smooth window gives the band a finite correlation length, and the period exceeds the field by at least that
length. So no separation within the field is affected by the periodicity, and the covariance there is that of the
spectrum (Poisson's summation formula). The first band includes the aliased frequencies beyond Nyquist. From one sample
to the whole field, the expected structure function is von Karman's to 0.3 %, or 0.2 % for outer scales up to 20 times
the field.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from scipy.fft import next_fast_len
from torch import Tensor

from torchmask.atmosphere.von_karman import PSD_CONSTANT, von_karman_psd
from torchmask.optics.draws import draw_normal
from torchmask.optics.phasor import phasor

_RATIO = 3.0  # between the frequencies of successive bands
_CUTOFF = 2.0  # lower edge of the first band, in units of 1 / margin
_STEEPNESS = 6  # exponent of the windows exp(-x^6)
_NEGLIGIBLE = 1.55  # the x beyond which a window counts as zero
_ALIASES = 1  # aliases on either side that are summed one by one
COMPLEX = {torch.float32: torch.complex64, torch.float64: torch.complex128}
_HOST: dict[str, Any] = {"dtype": torch.float64, "device": "cpu"}  # for small arrays, always made on the CPU


class Band(NamedTuple):
    """Waves on a rectangular lattice, with row and column frequencies [cycles/m] and rms amplitudes [rad]."""

    frequency_y: Tensor
    frequency_x: Tensor
    amplitude: Tensor


def split_spectrum(
    extent: tuple[float, float], margin: float, step: tuple[float, float], r0: float, outer_scale: float
) -> list[Band]:
    """Return the bands, float64 on the CPU, for a field over `extent` (y, x) [m] sampled every `step` (y, x) [m].

    The first band is the one for the FFT. `margin` [m] is the distance over which it loses its correlation.
    """
    cutoff = _CUTOFF / margin

    def below(frequency: Tensor, level: int) -> Tensor:
        """Return the share of the spectrum that belongs to the bands below band `level`."""
        return torch.exp(-((frequency * _RATIO**level / cutoff) ** _STEEPNESS))

    sizes = [int(next_fast_len(math.ceil((e + margin) / s)) or 0) for e, s in zip(extent, step, strict=True)]
    # The spectrum is even, so one quadrant is enough.
    fy, fx = (torch.arange(n // 2 + 1, **_HOST) / (n * s) for n, s in zip(sizes, step, strict=True))
    density = folded_density(fy, fx, step, r0, outer_scale, lambda f: 1 - below(f, 0))
    density /= sizes[0] * step[0] * sizes[1] * step[1]
    fy, fx = (torch.fft.fftfreq(n, s, **_HOST) for n, s in zip(sizes, step, strict=True))
    places = (torch.arange(n, device="cpu") for n in sizes)
    rows, columns = (torch.minimum(k, len(k) - k) for k in places)
    bands = [Band(fy, fx, density.sqrt()[rows][:, columns])]

    levels = max(1, math.ceil(math.log(2 * outer_scale / margin, _RATIO)))  # until the lattice resolves 1 / L0
    for level in range(1, levels + 1):
        periods = [e + margin * _RATIO**level for e in extent]
        counts = [math.ceil(_NEGLIGIBLE * cutoff / _RATIO ** (level - 1) * p) for p in periods]
        fy, fx = (torch.arange(-n, n + 1, **_HOST) / p for n, p in zip(counts, periods, strict=True))
        f = torch.hypot(fy[:, None], fx)
        share = below(f, level - 1) - (below(f, level) if level < levels else 0)
        density = von_karman_psd(f, r0, outer_scale) * share / (periods[0] * periods[1])
        bands.append(Band(fy, fx, density.sqrt()))
    return bands


def folded_density(
    fy: Tensor,
    fx: Tensor,
    step: tuple[float, float],
    r0: float,
    outer_scale: float,
    share: Callable[[Tensor], Tensor],
) -> Tensor:
    """Return the von Karman spectrum times `share(frequency)`, aliased by sampling every `step` (y, x) [m].

    The result (len(fy), len(fx)) [rad^2 m^2] is float64 on the CPU.
    """
    density = torch.full((len(fy), len(fx)), _beyond(step, r0, outer_scale), **_HOST)
    for alias_y in range(-_ALIASES, _ALIASES + 1):
        for alias_x in range(-_ALIASES, _ALIASES + 1):
            f = torch.hypot(fy[:, None] + alias_y / step[0], fx + alias_x / step[1])
            density += von_karman_psd(f, r0, outer_scale) * share(f)
    return density


def _beyond(step: tuple[float, float], r0: float, outer_scale: float) -> float:
    """Return the density [rad^2 m^2] that the power beyond the explicit aliases adds, treated as white.

    The radial integral of the spectrum, from the rectangular edge of the aliases to infinity, has a closed form; the
    angular one is a mean over a quarter turn.
    """
    n = 64
    angle = math.pi / (2 * n) * (torch.arange(n, **_HOST) + 0.5)
    edge = (_ALIASES + 0.5) * torch.minimum(1 / (step[0] * angle.sin()), 1 / (step[1] * angle.cos()))
    power = 1.2 * math.pi * PSD_CONSTANT * r0 ** (-5 / 3) * (edge**2 + outer_scale**-2) ** (-5 / 6)
    return float(power.mean()) * step[0] * step[1]


class RandomField:
    """A random field made of `bands` and summed on a raster. Its coefficients are a list, one tensor for each band."""

    def __init__(
        self,
        bands: list[Band],
        shape: tuple[int, int],
        step: tuple[float, float],
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.bands = bands
        self.shape = shape
        self.kind: dict[str, Any] = {"dtype": COMPLEX[dtype], "device": device}
        # Complex randn has a mean square of 1, of which the real and the imaginary field have half each.
        self.amplitudes: list[Tensor] = [(math.sqrt(2) * band.amplitude).to(device, dtype) for band in bands]
        places = [torch.arange(n, **_HOST) * s for n, s in zip(shape, step, strict=True)]
        self.waves: list[tuple[Tensor, Tensor]] = [
            (
                phasor(2 * math.pi * places[0][:, None] * fy).to(**self.kind),
                phasor(2 * math.pi * fx[:, None] * places[1]).to(**self.kind),
            )
            for fy, fx, _ in bands[1:]
        ]

    def draw(self, generator: torch.Generator | None) -> list[Tensor]:
        """Draw random coefficients; the real and the imaginary part of their sum are two independent screens."""
        return [draw_normal(a.shape, **self.kind, generator=generator) * a for a in self.amplitudes]

    def sum(self, coefficients: list[Tensor]) -> Tensor:
        """Return the field on the raster, complex (rows, columns)."""
        rows, columns = self.shape
        strip = torch.fft.ifft(coefficients[0], dim=0, norm="forward")[:rows]
        field = torch.fft.ifft(strip, dim=1, norm="forward")[:, :columns]
        for c, (wave_y, wave_x) in zip(coefficients[1:], self.waves, strict=True):
            field = field + wave_y @ c @ wave_x
        return field
