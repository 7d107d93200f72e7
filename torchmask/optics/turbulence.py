"""Random phase screens of von Karman turbulence, and the phase they lay on a pupil.

The spectrum is split by smooth windows into bands, each sampled on a frequency lattice of its own: the first by FFT,
the lower ones, the sub-harmonics, as explicit sums of waves on lattices three times finer from one to the next. A band
has a finite correlation length; its lattice makes it periodic, with a period that exceeds the screen by at least that
length. So the periodicity is not seen inside the screen, and covariance at the screen's own lags is that of the
spectrum (Poisson's summation formula) - to about 0.2 % in the structure function at all separations within it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from scipy.fft import next_fast_len
from torch import Tensor, nn

from torchmask.optics.aperture import PupilSamples
from torchmask.optics.von_karman import (
    modal_covariance,
    require_turbulence,
    von_karman_covariance,
    von_karman_psd,
    von_karman_structure_function,
)

__all__ = [
    "TurbulencePhase",
    "frozen_flow",
    "modal_covariance",
    "phase_screens",
    "von_karman_covariance",
    "von_karman_structure_function",
]

_RATIO = 3.0  # of the frequencies of successive bands
_CUTOFF = 2.0  # of the first band, in units of 1 / margin
_STEEPNESS = 6
_REACH = 1.55  # a window exp(-x^6) is negligible beyond this x
_MAX_SAMPLES = 2**25  # of the FFT band: half a gigabyte in complex128


class _Band(NamedTuple):
    """Waves on a rectangular lattice: frequencies [cycles/m] of rows and columns, rms amplitudes [rad]."""

    frequency_y: Tensor
    frequency_x: Tensor
    amplitude: Tensor


def _bands(
    extent: tuple[float, float], margin: float, step: tuple[float, float], r0: float, outer_scale: float
) -> list[_Band]:
    """Bands for a field over `extent` (y, x) [m] in steps of `step`; the first is the FFT's. float64, on the CPU."""
    cutoff = _CUTOFF / margin

    def window(frequency: Tensor, level: int) -> Tensor:
        return torch.exp(-((frequency * _RATIO**level / cutoff) ** _STEEPNESS))

    sizes = [next_fast_len(math.ceil((e + margin) / s)) for e, s in zip(extent, step, strict=True)]
    fy, fx = (torch.fft.fftfreq(n, s, dtype=torch.float64) for n, s in zip(sizes, step, strict=True))
    power = torch.zeros(sizes[0], sizes[1], dtype=torch.float64)
    for alias_y in range(-2, 3):  # the samples also hold what lies beyond the Nyquist frequency
        for alias_x in range(-2, 3):
            f = torch.hypot(fy[:, None] + alias_y / step[0], fx + alias_x / step[1])
            power += von_karman_psd(f, r0, outer_scale) * (1 - window(f, 0))
    cell = 1 / (sizes[0] * step[0] * sizes[1] * step[1])
    bands = [_Band(fy, fx, (power * cell).sqrt())]
    levels = max(1, math.ceil(math.log(2 * outer_scale / margin, _RATIO)))
    for level in range(1, levels + 1):
        periods = [e + margin * _RATIO**level for e in extent]
        highest = _REACH * cutoff / _RATIO ** (level - 1)
        fy, fx = (torch.arange(-math.ceil(highest * p), math.ceil(highest * p) + 1).double() / p for p in periods)
        f = torch.hypot(fy[:, None], fx)
        share = window(f, level - 1) - (window(f, level) if level < levels else 0)
        power = von_karman_psd(f, r0, outer_scale) * share / (periods[0] * periods[1])
        bands.append(_Band(fy, fx, power.sqrt()))
    return bands


def _draw(
    bands: list[_Band], generator: torch.Generator | None, dtype: torch.dtype, device: torch.device
) -> list[Tensor]:
    """Complex coefficients of all waves; the real and the imaginary part of their sum are independent fields."""
    source = generator.device if generator is not None else device
    kind = torch.complex64 if dtype == torch.float32 else torch.complex128
    return [
        torch.randn(b.amplitude.shape, generator=generator, dtype=kind, device=source).to(device)
        * (math.sqrt(2) * b.amplitude).to(device, dtype)
        for b in bands
    ]


def _synthesise(
    bands: list[_Band],
    coefficients: list[Tensor],
    shape: tuple[int, int],
    step: tuple[float, float],
    displacement: tuple[float, float] = (0.0, 0.0),
) -> Tensor:
    """Sum of all waves on the samples: complex (rows, columns). `displacement` (y, x) [m] moves the field."""
    total = 0.0
    for number, (band, values) in enumerate(zip(bands, coefficients, strict=True)):
        wave = []
        for frequency, n, s, d in zip(band[:2], shape, step, displacement, strict=True):
            place = torch.zeros(1) if number == 0 else torch.arange(n) * s
            phase = 2 * math.pi * frequency[:, None] * (place.double() - d)
            wave.append(torch.polar(torch.ones_like(phase), phase).to(values))
        if number == 0:
            moved = values * wave[0] * wave[1].T if any(displacement) else values
            moved = torch.fft.ifft(moved, dim=-2, norm="forward")[: shape[0]]
            total = total + torch.fft.ifft(moved, dim=-1, norm="forward")[:, : shape[1]]
        else:
            total = total + wave[0].T @ values @ wave[1]
    return total


def phase_screens(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    r0: float,
    outer_scale: float,
    n_screens: int,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """Independent von Karman phase screens (n_screens, rows, columns) [rad].

    Parameters
    ----------
    shape : (rows, columns)
    step : float or (dy, dx)
        Distance of samples [m].
    r0, outer_scale : float
        Fried parameter and outer scale [m].
    n_screens : int
    generator : torch.Generator, optional
        Seeded, on the CPU or on `device`.
    dtype, device : optional
        float32 or float64; by default torch's default dtype on the CPU.

    Raises
    ------
    ValueError
        If a length is not finite and positive, or a count not a whole number of at least 1.

    Examples
    --------
    >>> screens = phase_screens((64, 64), 0.02, r0=0.15, outer_scale=20.0, n_screens=3)
    >>> screens.shape
    torch.Size([3, 64, 64])
    """
    shape, step = _require_raster(shape, step, r0, outer_scale)
    _require_count("n_screens", n_screens)
    dtype, device = dtype or torch.get_default_dtype(), torch.device(device or "cpu")
    extent = (shape[0] * step[0], shape[1] * step[1])
    bands = _bands(extent, _margin(extent, step), step, r0, outer_scale)
    screens = torch.empty(n_screens, *shape, dtype=dtype, device=device)
    for first in range(0, n_screens, 2):
        field = _synthesise(bands, _draw(bands, generator, dtype, device), shape, step)
        screens[first : first + 2] = torch.view_as_real(field).movedim(-1, 0)[: n_screens - first]
    return screens


def frozen_flow(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    r0: float,
    outer_scale: float,
    displacement: Tensor,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """One screen, moved as a whole: (n_frames, rows, columns) [rad], frame t being screen(x - displacement[t]).

    `displacement` (n_frames, 2) [m], (x, y). Other arguments as for `phase_screens`. Every wave is shifted exactly, by
    any fraction of a sample, and the field is wide enough that none of the path is seen twice.

    Raises
    ------
    ValueError
        As `phase_screens`; or if the path is too long to hold, with the length that fits.
    """
    shape, step = _require_raster(shape, step, r0, outer_scale)
    dtype, device = dtype or torch.get_default_dtype(), torch.device(device or "cpu")
    path = displacement.detach().cpu().double().flip(-1)  # (y, x)
    span = (path.amax(0) - path.amin(0)).tolist()
    own = (shape[0] * step[0], shape[1] * step[1])
    margin = _margin(own, step)
    extent = (own[0] + span[0], own[1] + span[1])
    samples = (extent[0] + margin) / step[0] * (extent[1] + margin) / step[1]
    if samples > _MAX_SAMPLES:
        raise ValueError(
            f"a path of {span[1]:.4g} m by {span[0]:.4g} m (x, y) needs a screen of {samples:.3g} samples, above "
            f"{_MAX_SAMPLES}: take fewer frames, a shorter interval or a coarser grid"
        )
    bands = _bands(extent, margin, step, r0, outer_scale)
    coefficients = _draw(bands, generator, dtype, device)
    moves = (path - path[0]).tolist()
    return torch.stack([_synthesise(bands, coefficients, shape, step, (dy, dx)).real for dy, dx in moves])


class TurbulencePhase(nn.Module):
    """Phase of von Karman turbulence on the samples of a pupil.

    Parameters
    ----------
    r0, outer_scale : float
        Fried parameter at the imaging wavelength and outer scale [m].
    wind : (vx, vy), optional
        [m/s]. Without it every frame has a screen of its own; with it one screen drifts by (frozen flow).
    frame_interval : float, optional
        Time between frames [s]; needed with `wind`.

    Raises
    ------
    ValueError
        If a scale is not finite and positive, or only one of `wind` and `frame_interval` is given.

    Notes
    -----
    `forward(samples, n_frames, generator)` returns (n_frames, ..., N, P) [rad], dtype and device of the samples; all
    masks of a population see the same screens. Frames are snapshots: nothing moves during an exposure.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import FullAperture
    >>> samples = FullAperture(1.0).samples(Grid.nyquist(1.0, 550e-9, 64))
    >>> TurbulencePhase(r0=1 / 7, outer_scale=20.0)(samples, n_frames=4).shape
    torch.Size([4, 1, 1225])
    """

    def __init__(
        self,
        r0: float,
        outer_scale: float,
        wind: tuple[float, float] | None = None,
        frame_interval: float | None = None,
    ) -> None:
        super().__init__()
        require_turbulence(r0, outer_scale)
        if (wind is None) != (frame_interval is None):
            raise ValueError("wind and frame_interval belong together: give both (frozen flow) or neither")
        self.r0 = float(r0)
        self.outer_scale = float(outer_scale)
        self.wind = wind
        self.frame_interval = frame_interval

    def forward(self, samples: PupilSamples, n_frames: int, generator: torch.Generator | None = None) -> Tensor:
        _require_count("n_frames", n_frames)
        place, shape = _window(samples)
        like = {"generator": generator, "dtype": samples.weights.dtype, "device": samples.weights.device}
        if self.wind is None or self.frame_interval is None:
            screens = phase_screens(shape, samples.step, self.r0, self.outer_scale, n_frames, **like)
        else:
            time = torch.arange(n_frames, dtype=torch.float64)[:, None] * self.frame_interval
            path = time * torch.tensor(self.wind, dtype=torch.float64)
            screens = frozen_flow(shape, samples.step, self.r0, self.outer_scale, path, **like)
        return screens.flatten(1)[:, place]

    def extra_repr(self) -> str:
        return f"r0={self.r0:.6g}, outer_scale={self.outer_scale:.6g}, wind={self.wind}"


def _window(samples: PupilSamples) -> tuple[Tensor, tuple[int, int]]:
    """The smallest rectangle around a pupil that may lie across the raster's border: places in it, and its shape."""
    shape, coordinates = [], []
    for position, size in zip(
        (samples.index // samples.raster[1], samples.index % samples.raster[1]), samples.raster, strict=True
    ):
        angle = 2 * math.pi / size * position
        middle = torch.atan2((samples.weights * angle.sin()).sum(), (samples.weights * angle.cos()).sum())
        start = int(torch.round(middle * size / (2 * math.pi))) - size // 2
        local = (position - start) % size
        shape.append(int(local.max() - local.min()) + 1)
        coordinates.append(local - local.min())
    return coordinates[0] * shape[1] + coordinates[1], (shape[0], shape[1])


def _margin(extent: tuple[float, float], step: tuple[float, float]) -> float:
    return max(0.25 * max(extent), 16 * max(step))


def _require_count(name: str, count: int) -> None:
    if count != int(count) or count < 1:
        raise ValueError(f"{name} is {count}: it must be a whole number of at least 1")


def _require_raster(
    shape: tuple[int, int], step: float | tuple[float, float], r0: float, outer_scale: float
) -> tuple[tuple[int, int], tuple[float, float]]:
    require_turbulence(r0, outer_scale)
    for side in shape:
        _require_count("a side of shape", side)
    dy, dx = (step, step) if isinstance(step, int | float) else step
    if not all(math.isfinite(s) and s > 0 for s in (dy, dx)):
        raise ValueError(f"step is {step}: it must be finite and positive, in m")
    return (int(shape[0]), int(shape[1])), (float(dy), float(dx))
