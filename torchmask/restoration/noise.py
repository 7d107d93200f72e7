"""How strong the noise of a stack of frames is, told by the frames themselves."""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.restoration.conjugate import conjugate_gradients

_ITERATIONS = 30  # of the search for what dead pixels would hold
_CLEARLY_MORE = 1.1  # than expected: a few times the error of what one small frame tells


def noise_variance(frames: Tensor, grid: Grid, aperture: Aperture, valid: Tensor | None = None) -> float | None:
    """Mean noise variance of a pixel [electrons^2], from the frequencies that the aperture cannot transmit.

    White noise has the same power at all frequencies, and beyond the cut-off there is nothing else. The median over
    frequencies (of the power averaged over T frames, a gamma variable) leaves out the cross of a bright border.
    None if fewer than eight frequencies lie beyond the cut-off.

    Pixels that are not `valid` (T, H, W) take the values that leave the least power there. That takes some of the
    noise with it: as much as of white noise with the same holes.
    """
    nu_y, nu_x = grid.frequencies(frames.dtype, frames.device)
    beyond = torch.hypot(nu_y, nu_x) > grid.cutoff(aperture.extent)
    if int(beyond.sum()) < 8:
        return None
    n = len(frames)
    median_over_mean = math.log(2) if n == 1 else (1 - 1 / (9 * n)) ** 3  # Wilson & Hilferty 1931
    if valid is not None and not bool(valid.all()):
        generator = torch.Generator().manual_seed(0)
        white = torch.randn(frames.shape, dtype=frames.dtype, device="cpu", generator=generator).to(frames.device)
        frames = _least_power(frames, valid, beyond)
        median_over_mean = _median_power(_least_power(white * valid, valid, beyond), beyond)
    return _median_power(frames, beyond) / median_over_mean


def _median_power(frames: Tensor, beyond: Tensor) -> float:
    return float((torch.fft.fft2(frames, norm="ortho").abs() ** 2)[..., beyond].mean(0).median())


def _least_power(frames: Tensor, valid: Tensor, beyond: Tensor) -> Tensor:
    """Frames whose pixels that are not valid make the power at the frequencies `beyond` (H, W) least."""
    half = beyond[:, : beyond.shape[1] // 2 + 1]

    def gradient(x: Tensor) -> Tensor:
        return torch.where(valid, 0.0, torch.fft.irfft2(torch.fft.rfft2(x) * half, s=beyond.shape))

    return frames + conjugate_gradients(gradient, -gradient(frames), lambda x: x, _ITERATIONS)


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
