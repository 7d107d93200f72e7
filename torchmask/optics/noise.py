"""Estimation of the noise variance of a stack of frames from the frames themselves."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.conjugate import conjugate_gradients

_ITERATIONS = 30  # conjugate-gradient iterations that find values for dead pixels


def noise_variance(frames: Tensor, grid: Grid, aperture: Aperture, valid: Tensor | None = None) -> float | None:
    """Estimate the mean noise variance of a pixel [electrons^2] from frequencies that the aperture cannot transmit.

    White noise has the same power at all frequencies, and beyond the cut-off there is nothing else. The median over
    frequencies (of the power averaged over T frames, which is gamma distributed) ignores the cross that a bright border
    makes. Returns None if fewer than eight frequencies lie beyond the cut-off.

    Pixels that are not `valid` (T, H, W) take the values that minimise the power there. That also removes some noise
    power, which is calibrated on simulated white noise with the same pixels missing.
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
        frames = fill_with_least_power(frames, valid, beyond)
        median_over_mean = _median_power(fill_with_least_power(white * valid, valid, beyond), beyond)
    return _median_power(frames, beyond) / median_over_mean


def fill_with_least_power(frames: Tensor, valid: Tensor, beyond: Tensor) -> Tensor:
    """Return frames whose pixels that are not valid minimise the power at the frequencies `beyond` (H, W)."""
    half = beyond[:, : beyond.shape[1] // 2 + 1]

    def gradient(x: Tensor) -> Tensor:
        return torch.where(valid, 0.0, torch.fft.irfft2(torch.fft.rfft2(x) * half, s=beyond.shape))

    return frames + conjugate_gradients(gradient, -gradient(frames), lambda x: x, _ITERATIONS)


def _median_power(frames: Tensor, beyond: Tensor) -> float:
    return float((torch.fft.fft2(frames, norm="ortho").abs() ** 2)[..., beyond].mean(0).median())
