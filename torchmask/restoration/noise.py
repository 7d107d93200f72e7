"""The noise variance of a stack of frames, from what is known about it and from the frames themselves."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.io import as_tensor
from torchmask.observation import number_frames
from torchmask.optics.aperture import Aperture
from torchmask.optics.fading import beyond_faded
from torchmask.optics.noise import noise_variance

_UNEVEN = 1.25  # times the least variance of a frame: below, one variance for all costs 1.3 % of the light at most
_CLEARLY_MORE = 1.1  # times the expected variance, a few times the error of the estimate from one small frame
_CLEARLY_LESS = 0.75  # times the expected variance: gains are known to 10 %, and neighbouring pixels share as much
_SURE = 4.0  # standard errors that do not occur by chance
_LEFT = 1 / 64  # of the powers beyond the cut-off that count, where many pixels are missing (measured)


class FrameNoise(NamedTuple):
    """Noise of single frames, which photons make larger where there is more light.

    level : (T,) mean variance of a frame's pixels, in units of the assumed ones
    unevenness : (T,) mean square of these variances, over the square of their mean
    """

    level: Tensor
    unevenness: Tensor

    @classmethod
    def of(
        cls, frames: Tensor, valid: Tensor, precision: Tensor, grain: float, excess: Tensor | None = None
    ) -> FrameNoise:
        """Return the noise of frames (T, H, W) over their valid pixels.

        The assumed variance is 1 / `precision`, which broadcasts to the frames; of it the photons of a mean pixel are
        `grain` times its light, with what a frame has in `excess` (T,) of the mean. Where the light is more by d, the
        variance is 1 + precision grain d of the assumed one. Of the mean square of that, the part that the noise in d
        makes is taken off.
        """
        mean = float(frames[valid].mean())
        means = [mean] * len(frames) if excess is None else (mean + excess).tolist()
        squares, levels = [], []
        for frame, seen, weight, mean in zip(frames, valid, precision.expand_as(frames), means, strict=True):
            by_light = grain * weight[seen].double()
            variance = 1 + by_light * (frame[seen].double() - mean)
            levels.append(variance.mean())
            squares.append((variance**2 - grain * by_light * variance).mean())
        level = torch.stack(levels)
        return cls(level, (torch.stack(squares) / level**2).clamp(min=1))


def expected_variance(
    frames: Tensor,
    grid: Grid,
    aperture: Aperture,
    readout_noise: float | None,
    valid: Tensor | None = None,
    errors: Tensor | None = None,
) -> float:
    """Return the mean noise variance of a valid pixel [electrons^2].

    It is that of `errors` if they are given, else that of photon and read-out noise if `readout_noise` is given, else
    measured by `noise_variance`. Noise clearly above that of photons and read-out comes from a sky that was subtracted
    or from a dark current; then the measured value is used. Raises ValueError if the noise is neither given nor
    measurable. Warns if the measured variance is more than twice the given one, or less than chance allows
    (`least_by_chance`; half, if `errors` are given), and without `errors` also if it is less than that of photons.
    """
    measured = noise_variance(frames, grid, aperture, valid)
    seen = frames if valid is None else frames[valid]
    light = float(seen.mean())
    if errors is not None:
        variance = float((errors if valid is None else errors[valid]).square().mean())
        told = option = "errors"
    elif readout_noise is not None:
        variance = max(0.0, light) + readout_noise**2  # too much may have been subtracted
        told, option = "photon noise and readout_noise", "readout_noise"
    elif measured is not None and measured > 0:
        variance, told, option = measured, "", ""
    else:
        raise ValueError("the noise cannot be measured beyond the cut-off frequency: give readout_noise or errors")
    if measured is None:
        return variance
    n_powers = len(frames) * int(beyond_faded(grid, aperture, frames).sum())
    n_missing = frames.numel() - seen.numel()
    least = 0.5 if errors is not None else least_by_chance(seen, variance, n_powers, n_missing)
    if errors is None and measured < light * least_by_chance(seen, light, n_powers, n_missing):
        warnings.warn(
            f"the noise of the frames is {measured**0.5:.3g} electrons rms, but photons alone give {light**0.5:.3g}: "
            "the frames seem to be in ADU or normalised (multiply them by the gain), to hold a bias (subtract it), or "
            "to be smoothed or means of several reads (give errors)",
            stacklevel=5,
        )
    elif not least * variance <= measured <= 2 * variance:
        warnings.warn(
            f"the noise of the frames is {measured**0.5:.3g} electrons rms, but {told} give {variance**0.5:.3g}: check "
            f"the gain and {option}",
            stacklevel=5,
        )
    return measured if errors is None and measured > _CLEARLY_MORE * variance else variance


def least_by_chance(seen: Tensor, variance: float, n_powers: int, n_missing: int = 0) -> float:
    """Return the part of the noise `variance` of valid pixels `seen` [electrons] that is the least to be measured.

    The median of `n_powers` powers of noise beyond the cut-off, of which half are alike, has a relative standard error
    of at most 2 over the root of their number. Where light is uneven, powers at neighbouring frequencies rise and fall
    together, so that fewer of them count, by the mean square of the pixels' variances over the square of their mean.
    Counts stand for the variances here: their own noise adds what chance changes in the number of photons. Each missing
    pixel takes up to one power, and then the calibration on simulated noise has the same error again.
    """
    unevenness = 1 + float(seen.var(correction=0) / variance**2)
    n_left = max(n_powers - n_missing, _LEFT * n_powers) / (2 if n_missing else 1)
    return min(_CLEARLY_LESS, math.exp(-_SURE * 2 * math.sqrt(unevenness / n_left)))


def check_errors(errors: Tensor | np.ndarray, frames: Tensor, valid: Tensor, numbers: Sequence[int] = ()) -> Tensor:
    """Return `errors`, standard deviations of pixels [electrons], as (T, H, W); (H, W) applies to every frame.

    Raises ValueError if they have another shape, or that of a valid pixel is not finite and positive; the message names
    the frame by `numbers`, or from 0 if none are given.
    """
    given = as_tensor(errors, frames.device, frames.dtype)
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


def photon_slope(frames: Tensor, errors: Tensor, valid: Tensor) -> float:
    """Return by how much the square of `errors` (T, H, W) rises with the counts of `frames`, at least 0.

    It is 1 for errors in electrons that include photon noise, and 0 for those of the detector alone. Only changes from
    one frame to the next count, as a map of the detector may resemble the object by chance; the slope has the least
    absolute deviations from them, so that cosmic rays do not matter. Errors that are the same in all frames, or of a
    single frame, have slope 0.
    """
    pairs = 2 * (len(frames) // 2)
    lit = valid & (frames > 0)  # many pipelines take negative counts for none
    seen = lit[0:pairs:2] & lit[1:pairs:2] & (frames[0:pairs:2] != frames[1:pairs:2])
    run, rise = ((values[0:pairs:2] - values[1:pairs:2])[seen] for values in (frames, errors.square()))
    slopes, order = (rise / run).sort()
    weight = run.abs()[order].cumsum(0)
    if not len(weight):
        return 0.0
    return max(0.0, float(slopes[int((weight < weight[-1] / 2).sum())]))


def uneven_light(frames: Tensor, valid: Tensor, variance: float, slope: float) -> Tensor | None:
    """Return by how much the mean light (T,) of each frame's valid pixels exceeds that of all, if clouds make their
    noise clearly unlike, else None.

    Their noise has `variance` in the mean, which rises by `slope` with the light. A frame of next to no light counts as
    one that has a hundredth of that variance, so that none can rule the others.
    """
    light = frames.where(valid, 0).sum((1, 2)) / valid.sum((1, 2)).clamp(min=1)
    excess = light - frames[valid].mean()
    if slope:
        excess = excess.clamp(min=-0.99 * variance / slope)
    own = variance + slope * excess
    return excess if float(own.max()) > _UNEVEN * float(own.min()) else None


def even_photons(frames: Tensor, errors: Tensor, valid: Tensor, slope: float, excess: Tensor | None = None) -> Tensor:
    """Return `errors` (T, H, W) [electrons] whose photon noise is that of a mean valid pixel in all pixels, with what a
    frame has in `excess` (T,) of its light.

    True photon noise would weigh bright pixels least, where most of the object is to be seen. Restorations lose by it,
    see docs/tried.md. `slope` is that of `photon_slope`; the rest of the variance stays as it is.
    """
    rest = (errors.square() - slope * frames.clamp(min=0)).clamp(min=0)
    light = frames[valid].mean()
    return (slope * (light if excess is None else light + excess[:, None, None]) + rest).sqrt()
