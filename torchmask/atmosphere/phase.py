"""The phase that turbulence lays on a pupil."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchmask.atmosphere.screens import frozen_flow, phase_screens, require_count
from torchmask.atmosphere.von_karman import require_turbulence
from torchmask.optics.aperture import PupilSamples


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
    `forward(samples, n_frames, generator)` returns (..., n_frames, N, P) [rad], dtype and device of the samples
    (..., N, P); all masks of a population see the same screens. Frames are snapshots: nothing moves during an exposure.

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
        require_count("n_frames", n_frames)
        place, shape = _window(samples)
        like = {"generator": generator, "dtype": samples.weights.dtype, "device": samples.weights.device}
        if self.wind is None or self.frame_interval is None:
            screens = phase_screens(shape, samples.step, self.r0, self.outer_scale, n_frames, **like)
        else:
            time = torch.arange(n_frames, dtype=torch.float64, device="cpu") * self.frame_interval
            path = time[:, None] * time.new_tensor(self.wind)
            screens = frozen_flow(shape, samples.step, self.r0, self.outer_scale, path, **like)
        return screens.flatten(1)[:, place].movedim(0, -3)

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
