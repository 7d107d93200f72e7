"""The noise variance of a stack of frames, from what is known about it and from the frames themselves."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.observation import number_frames
from torchmask.optics.aperture import Aperture
from torchmask.optics.noise import noise_variance

_CLEARLY_MORE = 1.1  # times the expected variance, a few times the error of the estimate from one small frame


class FrameNoise(NamedTuple):
    """Noise of single frames, which photons make larger where there is more light.

    level : (T,) mean variance of a frame's pixels, over that of the stack
    unevenness : (T,) mean square of the variances of a frame's pixels, over the square of their mean
    """

    level: Tensor
    unevenness: Tensor

    @classmethod
    def of(cls, frames: Tensor, variance: float) -> FrameNoise:
        """Return the noise of frames (T, H, W) [electrons], whose mean variance is known [electrons^2].

        The variance of a pixel is a constant plus its light. That of the light over a frame is the variance of its
        pixels less their noise.
        """
        frames = frames.double()
        light, mean = frames.mean((1, 2)), float(frames.mean())
        share = min(1.0, mean / variance)  # of photons in the noise
        level = 1 + share * (light / mean - 1)
        spread = (frames.var((1, 2)) - level * variance).clamp(min=0) / mean**2
        return cls(level, 1 + share**2 * spread / level**2)

    @classmethod
    def even(cls, n_frames: int) -> FrameNoise:
        """Return the noise of frames whose residuals are in units of each pixel's own noise."""
        return cls(torch.ones(n_frames, dtype=torch.float64), torch.ones(n_frames, dtype=torch.float64))


def expected_variance(
    frames: Tensor,
    grid: Grid,
    aperture: Aperture,
    readout_noise: float | None,
    valid: Tensor | None = None,
    errors: Tensor | None = None,
) -> float:
    """Return the mean noise variance of a pixel [electrons^2].

    It is that of `errors` if they are given, else that of photon and read-out noise if `readout_noise` is given, else
    measured by `noise_variance`. Noise clearly above that of photons and read-out comes from a sky that was subtracted
    or from a dark current; then the measured value is used. Raises ValueError if the noise is neither given nor
    measurable. Warns if the given and the measured variance differ by more than a factor of 2.
    """
    measured = noise_variance(frames, grid, aperture, valid)
    if errors is not None:
        variance, told = float((errors if valid is None else errors[valid]).square().mean()), "errors"
    elif readout_noise is not None:
        variance, told = float(frames.mean()) + readout_noise**2, "photon noise and readout_noise"
    elif measured is not None and measured > 0:
        return measured
    else:
        raise ValueError("the noise cannot be measured beyond the cut-off frequency: give readout_noise or errors")
    if measured is not None and not 0.5 < measured / variance < 2:
        warnings.warn(
            f"the noise of the frames is {measured**0.5:.3g} electrons rms, but {told} give {variance**0.5:.3g}: check "
            f"the gain and {told.split()[-1]}",
            stacklevel=4,
        )
    more_than_light = errors is None and measured is not None and measured > _CLEARLY_MORE * variance
    return measured if measured is not None and more_than_light else variance


def check_errors(errors: Tensor | np.ndarray, frames: Tensor, valid: Tensor, numbers: Sequence[int] = ()) -> Tensor:
    """Return `errors`, standard deviations of pixels [electrons], as (T, H, W); (H, W) applies to every frame.

    Raises ValueError if they have another shape, or that of a valid pixel is not finite and positive; the message names
    the frame by `numbers`, or from 0 if none are given.
    """
    given = torch.as_tensor(errors, dtype=frames.dtype, device=frames.device)
    if tuple(given.shape) not in (tuple(frames.shape), tuple(frames.shape[1:])):
        raise ValueError(
            f"errors has shape {tuple(given.shape)}: it must be {tuple(frames.shape)}, or {tuple(frames.shape[1:])} "
            "for all frames"
        )
    given = given.expand_as(frames)
    wrong = (valid & ~(torch.isfinite(given) & (given > 0))).nonzero()
    if len(wrong):
        frame, row, column = wrong[0].tolist()
        number = number_frames(numbers, len(frames))[frame]
        value = float(given[frame, row, column])
        raise ValueError(
            f"errors is not positive at {len(wrong)} valid pixels, the first is {value:.3g} at (frame, row, column) "
            f"{(number, row, column)}: standard deviations in electrons are needed, or False in `valid`"
        )
    return given
