"""The phase that turbulence adds to the wavefront over a pupil."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchmask.atmosphere.endless import Screen, ScreenWindow
from torchmask.atmosphere.layers import Layers, Vector
from torchmask.atmosphere.screens import draw_seed, frozen_flow, phase_screens
from torchmask.atmosphere.von_karman import require_turbulence
from torchmask.numbers import whole_number
from torchmask.optics.pupil import PupilSamples

_BORDER = 2  # samples beyond the middle half of a raster that the cells at the border of a pupil may lie in


class TurbulencePhase(nn.Module):
    """Random phase of von Karman turbulence on the samples of a pupil.

    Parameters
    ----------
    r0 : float
        Fried parameter at the imaging wavelength [m].
    outer_scale : float
        Outer scale of the turbulence [m].
    wind : (vx, vy), optional
        Wind velocity [m/s], with which one screen drifts over the pupil (frozen flow). By default every frame has an
        independent screen.
    frame_interval : float, optional
        Time between frames [s]; needed with `wind`.

    Raises
    ------
    ValueError
        If a scale or the interval is not finite and positive, `wind` is not two finite numbers, or only one of
        `wind` and `frame_interval` is given.

    Notes
    -----
    `forward(samples, n_frames, generator)` returns (..., n_frames, N, P) [rad] with the dtype and device of the samples
    (..., N, P). With the same generator, all masks and pupils on one raster see the same screens, alone or in a
    population, as long as they lie within its middle half, as those do that a grid samples well. Frames are snapshots:
    nothing moves during an exposure.

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
            raise ValueError("only one of wind and frame_interval is given: give both (frozen flow) or neither")
        if wind is not None and not (len(wind) == 2 and all(math.isfinite(v) for v in wind)):
            raise ValueError(f"wind is {wind}: it must be two finite numbers (vx, vy), in m/s")
        _require_interval(frame_interval)
        self.r0: float = float(r0)
        self.outer_scale: float = float(outer_scale)
        self.wind = wind
        self.frame_interval = frame_interval

    def forward(self, samples: PupilSamples, n_frames: int, generator: torch.Generator | None = None) -> Tensor:
        n_frames = whole_number("n_frames", n_frames)
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


class LayeredPhase(nn.Module):
    """Random phase of layered turbulence on the samples of a pupil, for a star in any direction.

    Parameters
    ----------
    layers : Layers
        Heights, strengths and winds of the layers.
    wavelength : float
        Wavelength of the light [m].
    outer_scale : float
        Outer scale of all layers [m].
    frame_interval : float, optional
        Time between frames [s], during which the winds carry the screens on (frozen flow). By default every frame has
        independent screens, as frames taken far apart in time do.

    Raises
    ------
    ValueError
        If a length or the interval is not finite and positive.

    Notes
    -----
    `forward(samples, n_frames, generator, direction)` returns (..., n_frames, N, P) [rad] with the dtype and device of
    the samples (..., N, P). `direction` (..., 2), (x, y) [rad], is the position of the star from the middle of the
    field, where it is by default; the star's image lies direction / pixel_scale pixels from there. The leading axes of
    `direction` come before all others. A ray to the point x of the pupil crosses a layer of height h at
    x + h direction. All directions see the same screens, and so do all masks, as in `TurbulencePhase`. Frames are
    snapshots; for the phase within an exposure, see `draws`.

    Examples
    --------
    >>> from torchmask.grid import Grid
    >>> from torchmask.atmosphere.profiles import named_layers
    >>> from torchmask.optics.aperture import FullAperture
    >>> samples = FullAperture(1.0).samples(Grid.nyquist(1.0, 550e-9, 64))
    >>> turbulence = LayeredPhase(named_layers("hv57", n_layers=3), wavelength=550e-9, outer_scale=20.0)
    >>> stars = torch.tensor([[0.0, 0.0], [7e-6, 0.0]])  # the second is an isoplanatic angle to the right
    >>> turbulence(samples, n_frames=4, direction=stars).shape
    torch.Size([2, 4, 1, 1225])
    """

    def __init__(
        self, layers: Layers, wavelength: float, outer_scale: float, frame_interval: float | None = None
    ) -> None:
        super().__init__()
        require_turbulence(layers.r0(wavelength), outer_scale)
        _require_interval(frame_interval)
        self.layers = layers
        self.wavelength: float = float(wavelength)
        self.outer_scale: float = float(outer_scale)
        self.frame_interval = frame_interval

    @property
    def r0(self) -> float:
        """Fried parameter of all layers together [m]."""
        return self.layers.r0(self.wavelength)

    def forward(
        self,
        samples: PupilSamples,
        n_frames: int,
        generator: torch.Generator | None = None,
        direction: Tensor | Vector = (0.0, 0.0),
    ) -> Tensor:
        n_frames = whole_number("n_frames", n_frames)
        stars = torch.as_tensor(direction, dtype=torch.float64, device="cpu")
        if stars.shape[-1:] != (2,):
            raise ValueError(f"direction has shape {tuple(stars.shape)}: its last axis must be (x, y), in rad")
        if stars.numel() == 0:
            shape = samples.index.shape
            return samples.weights.new_zeros(*stars.shape[:-1], *shape[:-2], n_frames, *shape[-2:])
        frames = itertools.islice(self.draws(samples, generator), n_frames)
        phases = [[frame.phase(direction=(x, y)) for x, y in stars.view(-1, 2).tolist()] for frame in frames]
        together = torch.stack([torch.stack(phase) for phase in phases], dim=-3)  # (direction, ..., frame, N, P)
        return together.unflatten(0, stars.shape[:-1]) if stars.ndim > 1 else together[0]

    def draws(self, samples: PupilSamples, generator: torch.Generator | None = None) -> Iterator[DrawnLayers]:
        """Yield the layers at the start of each frame, without end."""
        place, shape = _window(samples)
        weights = samples.weights
        window = ScreenWindow(shape, samples.step, self.outer_scale, weights.dtype, weights.device)
        strengths = self.layers.layer_r0(self.wavelength)

        def draw() -> list[Screen]:
            return [Screen(window, r0, draw_seed(generator)) for r0 in strengths]

        if self.frame_interval is None:
            while True:
                yield DrawnLayers(self.layers, draw(), place, 0.0)
        screens = draw()
        for frame in itertools.count():
            yield DrawnLayers(self.layers, screens, place, frame * self.frame_interval)

    def extra_repr(self) -> str:
        flow = "" if self.frame_interval is None else f", frame_interval={self.frame_interval}"
        scales = f"wavelength={self.wavelength:.6g}, r0={self.r0:.6g}, outer_scale={self.outer_scale:.6g}"
        return f"{len(self.layers.heights)} layers, {scales}{flow}"


@dataclass(frozen=True)
class DrawnLayers:
    """The random screens of all layers above a pupil at the start of one frame."""

    layers: Layers
    """Heights, strengths and winds of the layers."""
    screens: list[Screen]
    """Screen of each layer."""
    place: Tensor
    """Indices of the pupil's samples in the flattened window of the screens."""
    time: float
    """Time at which the frame begins [s]."""

    def phase(self, delay: float = 0.0, direction: Vector = (0.0, 0.0)) -> Tensor:
        """Return the phase (..., N, P) [rad] for a star in `direction` (x, y) [rad], `delay` [s] into the frame."""
        later, parts = self.time + delay, []
        for screen, height, wind in zip(self.screens, self.layers.heights, self.layers.winds, strict=True):
            x, y = (height * angle - speed * later for angle, speed in zip(direction, wind, strict=True))
            parts.append(screen.at((x, y)))
        return functools.reduce(torch.add, parts).flatten()[self.place]


def _require_interval(frame_interval: float | None) -> None:
    if frame_interval is not None and not (math.isfinite(frame_interval) and frame_interval > 0):
        raise ValueError(f"frame_interval is {frame_interval}: it must be finite and positive, in s")


def _window(samples: PupilSamples) -> tuple[Tensor, tuple[int, int]]:
    """Return the indices of a pupil's samples in the window of the screens, and that window's shape.

    The window is the middle half of the raster, which holds every centred aperture that a grid samples well. As it does
    not depend on the pupil, all pupils on one raster see the same screens, and nothing jumps as a hole moves. A pupil
    that reaches further, or lies across the border of the raster, has the smallest rectangle around it for a window.
    Raises TypeError for anything but the samples of a pupil.
    """
    if not isinstance(samples, PupilSamples):
        raise TypeError(f"samples are of type {type(samples).__name__}: give those of a pupil, aperture.samples(grid)")
    places = (samples.index // samples.raster[1], samples.index % samples.raster[1])
    reach = [size // 4 + _BORDER for size in samples.raster]
    coordinates = [(place + most) % size for place, most, size in zip(places, reach, samples.raster, strict=True)]
    shape = [min(2 * most + 1, size) for most, size in zip(reach, samples.raster, strict=True)]
    if not all(bool((local < side).all()) for local, side in zip(coordinates, shape, strict=True)):
        coordinates, shape = _smallest_rectangle(samples, places)
    return coordinates[0] * shape[1] + coordinates[1], (shape[0], shape[1])


def _smallest_rectangle(samples: PupilSamples, places: tuple[Tensor, Tensor]) -> tuple[list[Tensor], list[int]]:
    """Return the rows and columns of a pupil's samples in the smallest rectangle around it, and that one's sides."""
    coordinates, shape = [], []
    weights = samples.weights.detach()  # holes may be trainable, but the choice of samples is not differentiable
    for place, size in zip(places, samples.raster, strict=True):
        angle = 2 * math.pi / size * place  # on a periodic raster the middle is a mean angle
        middle = torch.atan2((weights * angle.sin()).sum(), (weights * angle.cos()).sum())
        local = (place - round(float(middle) * size / (2 * math.pi)) + size // 2) % size
        coordinates.append(local - local.min())
        shape.append(int(coordinates[-1].max()) + 1)
    return coordinates, shape
