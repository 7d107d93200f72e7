"""Estimation of the noise variance of a stack of frames from the frames themselves."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.conjugate import conjugate_gradients
from torchmask.optics.fading import beyond_faded, fading

_ITERATIONS = 30  # conjugate-gradient iterations that find values for dead pixels
FEWEST = 8  # frequencies beyond the cut-off that tell noise
_SURE = 5.0  # standard errors that do not occur by chance


def noise_variance(frames: Tensor, grid: Grid, aperture: Aperture, valid: Tensor | None = None) -> float | None:
    """Estimate the mean noise variance of a pixel [electrons^2] from frequencies that the aperture cannot transmit.

    White noise has the same power at all frequencies, and beyond the cut-off there is nothing else. The median over
    frequencies (of the power averaged over T frames, which is gamma distributed) ignores the cross that an even bright
    border makes. A star near the border has power everywhere, though, as it is cut off there. So where frames whose
    border fades have clearly less, that counts. Returns None if fewer than eight frequencies lie beyond the cut-off.

    Pixels that are not `valid` (T, H, W) take the values that minimise the power there. That also removes some noise
    power, which is calibrated on simulated white noise with the same pixels missing.
    """
    nu_y, nu_x = grid.frequencies(frames.dtype, frames.device)
    beyond = torch.hypot(nu_y, nu_x) > grid.cutoff(aperture.extent)
    if int(beyond.sum()) < FEWEST:
        return None
    variance = _variance(frames, valid, beyond, torch.ones_like(frames[0]))
    beyond = beyond_faded(grid, aperture, frames)
    n_telling = int(beyond.sum())
    if n_telling < FEWEST:
        return variance
    inner = _variance_of_faded(frames, valid, beyond)
    # the standard error of a median of squares, half of which are alike, is at most 2 over the root of their number
    return inner if variance > (1 + _SURE * 2 / math.sqrt(len(frames) * n_telling)) * inner else variance


def _variance_of_faded(frames: Tensor, valid: Tensor | None, beyond: Tensor) -> float:
    """Return the mean noise variance of a pixel from frames whose border fades.

    That of the pixels as they weigh there lacks photons of the border, whose noise is as the light that counts for one
    electron each, or for what all the noise allows.
    """
    window = fading(frames)
    weight = window**2 if valid is None else window**2 * valid
    variance = _variance(frames, valid, beyond, window)
    weighed = float((weight * frames).sum() / weight.expand_as(frames).sum())
    mean = float(frames.mean() if valid is None else frames[valid].mean())
    if min(mean, weighed) <= 0:  # too much was subtracted for the light to tell its noise
        return variance
    return variance + min(1.0, variance / weighed) * (mean - weighed)


def _variance(frames: Tensor, valid: Tensor | None, beyond: Tensor, window: Tensor) -> float:
    """Return the noise variance of pixels weighed by a window (H, W), from the power at frequencies `beyond` (H, W)."""
    n = len(frames)
    median_over_mean = math.log(2) if n == 1 else (1 - 1 / (9 * n)) ** 3  # Wilson & Hilferty 1931
    frames, calibration = window * frames, float(window.square().mean()) * median_over_mean
    if valid is not None and not bool(valid.all()):
        generator = torch.Generator().manual_seed(0)
        white = torch.randn(frames.shape, dtype=frames.dtype, device="cpu", generator=generator).to(frames.device)
        frames = fill_with_least_power(frames, valid, beyond)
        calibration = _median_power(fill_with_least_power(window * white * valid, valid, beyond), beyond)
    return _median_power(frames, beyond) / calibration


def fill_with_least_power(frames: Tensor, valid: Tensor, beyond: Tensor) -> Tensor:
    """Return frames whose pixels that are not valid minimise the power at the frequencies `beyond` (H, W)."""
    half = beyond[:, : beyond.shape[1] // 2 + 1]

    def gradient(x: Tensor) -> Tensor:
        return torch.where(valid, 0.0, torch.fft.irfft2(torch.fft.rfft2(x) * half, s=beyond.shape))

    return frames + conjugate_gradients(gradient, -gradient(frames), lambda x: x, _ITERATIONS)


def _median_power(frames: Tensor, beyond: Tensor) -> float:
    return float((torch.fft.fft2(frames, norm="ortho").abs() ** 2)[..., beyond].mean(0).median())
