"""How strong the noise of a stack of frames is: what is known of it beside what the frames tell."""

from __future__ import annotations

import warnings

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.noise import noise_variance

_CLEARLY_MORE = 1.1  # than expected: a few times the error of what one small frame tells


def expected_variance(
    frames: Tensor,
    grid: Grid,
    aperture: Aperture,
    readout_noise: float | None,
    valid: Tensor | None = None,
    errors: Tensor | None = None,
) -> float:
    """Mean noise variance of a pixel [electrons^2]: that of `errors`, else photon and read-out noise, else measured.

    Noise that is clearly more than the light of the frames tells is what is left of a sky that was subtracted, or of a
    dark current: what `noise_variance` measures counts then. Raises ValueError if nothing tells the noise; warns if two
    ways are open and disagree by more than a factor of 2.
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
            f"the frames' noise is {measured**0.5:.3g} electrons rms, but {told} make {variance**0.5:.3g}: check the "
            f"gain and {told.split()[-1]}",
            stacklevel=4,
        )
    more_than_light = errors is None and measured is not None and measured > _CLEARLY_MORE * variance
    return measured if measured is not None and more_than_light else variance


def check_errors(errors: Tensor | np.ndarray, frames: Tensor, valid: Tensor) -> Tensor:
    """Standard deviations of pixels (T, H, W) [electrons], where (H, W) are those of every frame (T, H, W).

    Raises ValueError if their shape is another, or that of a valid pixel is not finite and positive.
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
        place = tuple(wrong[0].tolist())
        raise ValueError(
            f"errors is not positive at {len(wrong)} valid pixels, the first is {float(given[place]):.3g} at (frame, "
            f"row, column) {place}: standard deviations in electrons are needed, or False in `valid`"
        )
    return given
