"""The wavefronts of successive frames, in any direction and at several times within each exposure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from torchmask.atmosphere.layers import Layers, Vector
from torchmask.atmosphere.phase import DrawnLayers, LayeredPhase, TurbulencePhase
from torchmask.optics.pupil import PupilSamples

Turbulence = TurbulencePhase | LayeredPhase | None
Wavefront = Callable[[Vector], Iterator[Tensor | None]]
"""Function from a direction (x, y) [rad] to the successive phases (N, P) [rad] of a frame; None is a perfect one."""

MOST_TAU0 = 1000.0  # of an exposure, whose image is then that of the seeing; longer ones take hours
STEPS_PER_TAU0 = 8  # of an exposure; fringe contrast is then at most 0.3 % too high (Kolmogorov)
_BLOCK = 2**23  # phase samples held at once


def with_layers(turbulence: Turbulence, wavelength: float) -> Turbulence:
    """Convert frozen flow to the equivalent single layer; return anything else unchanged."""
    if not isinstance(turbulence, TurbulencePhase) or turbulence.wind is None:
        return turbulence
    layer = Layers.from_fractions(turbulence.r0, wavelength, [0.0], [1.0], [turbulence.wind])
    return LayeredPhase(layer, wavelength, turbulence.outer_scale, turbulence.frame_interval)


def exposure_delays(turbulence: Turbulence, exposure_time: float) -> list[float]:
    """Return the midpoints [s] of the steps into which an exposure is cut, short enough that the phase hardly changes.

    Raises ValueError if `exposure_time` is positive but the turbulence has no wind, or it exceeds the frame interval or
    a thousand times tau0.
    """
    if exposure_time == 0 or turbulence is None:
        return [0.0]
    if not isinstance(turbulence, LayeredPhase) or math.isinf(turbulence.layers.tau0(turbulence.wavelength)):
        raise ValueError(
            f"exposure_time is {exposure_time:g} s, but the turbulence has no wind: give layers with winds "
            "(LayeredPhase), or wind and frame_interval (TurbulencePhase), or leave exposure_time out"
        )
    interval = turbulence.frame_interval
    if interval is not None and exposure_time > interval * (1 + 1e-9):
        raise ValueError(
            f"exposure_time is {exposure_time:g} s, longer than the {interval:g} s from one frame to the next: shorten "
            "it or increase frame_interval"
        )
    tau0 = turbulence.layers.tau0(turbulence.wavelength)
    if exposure_time > MOST_TAU0 * tau0:
        raise ValueError(
            f"exposure_time is {exposure_time:g} s, {exposure_time / tau0:.3g} times tau0, the {tau0:.3g} s in which "
            f"this turbulence changes: at most {MOST_TAU0:g} times are simulated, {MOST_TAU0 * tau0:.3g} s; in s, 5 ms "
            "are 5e-3"
        )
    steps = math.ceil(STEPS_PER_TAU0 * exposure_time / tau0)
    return [(k + 0.5) / steps * exposure_time for k in range(steps)]


def isoplanatic_angle(turbulence: Turbulence) -> float:
    """Return theta0 [rad], which is infinite for turbulence without height."""
    return turbulence.layers.theta0(turbulence.wavelength) if isinstance(turbulence, LayeredPhase) else math.inf


def wavefronts(
    turbulence: Turbulence,
    samples: PupilSamples,
    n_frames: int,
    delays: list[float],
    generator: torch.Generator,
) -> Iterator[Wavefront]:
    """Yield the wavefronts of `n_frames` frames on the samples of a pupil, at `delays` [s] after the start of each."""
    if turbulence is None:
        yield from (_steady(None) for _ in range(n_frames))
    elif isinstance(turbulence, LayeredPhase):
        draws = itertools.islice(turbulence.draws(samples, generator), n_frames)
        yield from (_moving(layers, delays) for layers in draws)
    else:
        # The block is even, because independent screens are drawn in pairs.
        block = max(2, _BLOCK // samples.weights.numel() // 2 * 2)
        for first in range(0, n_frames, block):
            phases = turbulence(samples, min(block, n_frames - first), generator)
            yield from (_steady(phase) for phase in phases)


def _steady(phase: Tensor | None) -> Wavefront:
    """Return a wavefront that is the same in all directions and constant in time."""
    return lambda direction: iter([phase])


def _moving(layers: DrawnLayers, delays: list[float]) -> Wavefront:
    return lambda direction: (layers.phase(delay, direction) for delay in delays)
