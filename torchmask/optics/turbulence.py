"""Random phase screens of von Karman turbulence, and the phase they lay on a pupil."""

from __future__ import annotations

import math
from numbers import Integral

import torch
from torch import Tensor, nn

from torchmask.optics.aperture import PupilSamples
from torchmask.optics.random_field import COMPLEX, RandomField, split_spectrum
from torchmask.optics.von_karman import require_turbulence

_MAX_SAMPLES = 2**24  # of a field: a quarter of a gigabyte in complex128, several times


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
        A screen does not depend on how many follow it.
    generator : torch.Generator, optional
        Seeded, on the CPU or on `device`.
    dtype, device : optional
        float32 or float64; by default torch's default dtype on the CPU.

    Raises
    ------
    ValueError
        If a length is not finite and positive, or a count not a whole number of at least 1.
    TypeError
        If `dtype` is neither float32 nor float64.

    Examples
    --------
    >>> generator = torch.Generator().manual_seed(0)
    >>> screens = phase_screens((64, 64), 0.02, r0=0.15, outer_scale=20.0, n_screens=3, generator=generator)
    >>> screens.shape
    torch.Size([3, 64, 64])
    """
    shape, step, dtype, device = _resolve(shape, step, dtype, device)
    _require_count("n_screens", n_screens)
    require_turbulence(r0, outer_scale)
    extent = (shape[0] * step[0], shape[1] * step[1])
    field = RandomField(
        split_spectrum(extent, _margin(extent, step), step, r0, outer_scale), shape, step, dtype, device
    )
    screens = torch.empty(n_screens, *shape, dtype=dtype, device=device)
    for first in range(0, n_screens, 2):
        pair = torch.view_as_real(field.sum(field.draw(generator))).movedim(-1, 0)
        screens[first : first + 2] = pair[: n_screens - first]
    return screens


def frozen_flow(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    r0: float,
    outer_scale: float,
    displacements: Tensor,
    generator: torch.Generator | None = None,
    dtype: torch.dtype | None = None,
    device: torch.device | str | None = None,
) -> Tensor:
    """One screen moved as a whole: (n_frames, rows, columns) [rad], frame t being screen(x - displacements[t]).

    `displacements` (n_frames, 2) [m], (x, y). Other arguments as for `phase_screens`. Every wave is moved exactly, by
    any fraction of a sample, and the field is wide enough that no part of the path is seen twice.

    Raises
    ------
    ValueError
        As `phase_screens`; or if the field would be too large, with the number of frames that fit.
    TypeError
        As `phase_screens`.
    """
    shape, step, dtype, device = _resolve(shape, step, dtype, device)
    require_turbulence(r0, outer_scale)
    path = displacements.detach().cpu().double().flip(-1)  # (y, x)
    span = path.cummax(0).values - path.cummin(0).values  # up to each frame
    own = (shape[0] * step[0], shape[1] * step[1])
    margin = _margin(own, step)
    extents = span + path.new_tensor(own)
    fits = ((extents + margin) / path.new_tensor(step)).prod(-1) <= _MAX_SAMPLES
    if not bool(fits.all()):
        raise ValueError(
            f"the wind carries the screen {float(span[-1, 1]):.4g} m by {float(span[-1, 0]):.4g} m (x, y) in "
            f"{len(path)} frames, more than fits into memory: at most {int(fits.sum())} frames are possible here, more "
            "with a shorter interval, a coarser grid or a wind along x or y"
        )
    extent = (float(extents[-1, 0]), float(extents[-1, 1]))
    field = RandomField(split_spectrum(extent, margin, step, r0, outer_scale), shape, step, dtype, device)
    coefficients = field.draw(generator)
    # The raster is at one corner of the field, whose period takes care of the sign of the path.
    return torch.stack([field.sum(field.move(coefficients, (dy, dx))).real for dy, dx in path.tolist()])


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
        If a scale or the interval is not finite and positive, `wind` is not two finite numbers, or only one of
        `wind` and `frame_interval` is given.

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
        if wind is not None and not (len(wind) == 2 and all(math.isfinite(v) for v in wind)):
            raise ValueError(f"wind is {wind}: it must be two finite numbers (vx, vy), in m/s")
        if frame_interval is not None and not (math.isfinite(frame_interval) and frame_interval > 0):
            raise ValueError(f"frame_interval is {frame_interval}: it must be finite and positive, in s")
        self.r0: float = float(r0)
        self.outer_scale: float = float(outer_scale)
        self.wind = wind
        self.frame_interval = frame_interval

    def forward(self, samples: PupilSamples, n_frames: int, generator: torch.Generator | None = None) -> Tensor:
        _require_count("n_frames", n_frames)
        place, shape = _window(samples)
        like = {"generator": generator, "dtype": samples.weights.dtype, "device": samples.weights.device}
        if self.wind is None or self.frame_interval is None:
            screens = phase_screens(shape, samples.step, self.r0, self.outer_scale, n_frames, **like)
        else:
            time = torch.arange(n_frames, dtype=torch.float64, device="cpu") * self.frame_interval
            path = time[:, None] * time.new_tensor(self.wind)
            screens = frozen_flow(shape, samples.step, self.r0, self.outer_scale, path, **like)
        return screens.flatten(1)[:, place]

    def extra_repr(self) -> str:
        flow = "" if self.wind is None else f", wind={self.wind}, frame_interval={self.frame_interval}"
        return f"r0={self.r0:.6g}, outer_scale={self.outer_scale:.6g}{flow}"


def _window(samples: PupilSamples) -> tuple[Tensor, tuple[int, int]]:
    """The smallest rectangle around a pupil that may lie across the raster's border: places in it, and its shape."""
    coordinates, shape = [], []
    places = (samples.index // samples.raster[1], samples.index % samples.raster[1])
    weights = samples.weights.detach()  # holes may train: where they lie decides which samples to take, not more
    for place, size in zip(places, samples.raster, strict=True):
        angle = 2 * math.pi / size * place  # the middle of a pupil that spans at most half the raster is a mean angle
        middle = torch.atan2((weights * angle.sin()).sum(), (weights * angle.cos()).sum())
        local = (place - round(float(middle) * size / (2 * math.pi)) + size // 2) % size
        coordinates.append(local - local.min())
        shape.append(int(coordinates[-1].max()) + 1)
    return coordinates[0] * shape[1] + coordinates[1], (shape[0], shape[1])


def _margin(extent: tuple[float, float], step: tuple[float, float]) -> float:
    """Distance [m] over which the first band loses its correlation."""
    return max(0.25 * max(extent), 16 * max(step))


def _require_count(name: str, count: int) -> None:
    if not isinstance(count, Integral) or count < 1:
        raise ValueError(f"{name} is {count}: it must be a whole number of at least 1")


def _resolve(
    shape: tuple[int, int],
    step: float | tuple[float, float],
    dtype: torch.dtype | None,
    device: torch.device | str | None,
) -> tuple[tuple[int, int], tuple[float, float], torch.dtype, torch.device]:
    for side in shape:
        _require_count("a side of shape", side)
    dy, dx = (step, step) if isinstance(step, int | float) else step
    if not all(math.isfinite(s) and s > 0 for s in (dy, dx)):
        raise ValueError(f"step is {step}: it must be finite and positive, in m")
    dtype = dtype or torch.get_default_dtype()
    if dtype not in COMPLEX:
        raise TypeError(f"dtype is {dtype}: it must be float32 or float64")
    return (shape[0], shape[1]), (float(dy), float(dx)), dtype, torch.device(device or "cpu")
