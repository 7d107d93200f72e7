"""What a restoration needs to know before it starts, taken from the frames themselves."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture


def noise_variance(frames: Tensor, grid: Grid, aperture: Aperture) -> float:
    """Mean noise variance of a pixel [electrons^2], from the frequencies that the aperture cannot transmit.

    White noise has the same power at all frequencies, and beyond the cut-off there is nothing else. Frames (T, H, W).
    The median over the frequencies (of power averaged over frames) leaves out the cross that a bright border makes.
    Raises ValueError if the grid is so coarse that fewer than eight frequencies lie beyond the cut-off.
    """
    nu_y, nu_x = grid.frequencies(frames.dtype, frames.device)
    beyond = torch.hypot(nu_y, nu_x) > grid.cutoff(aperture.extent)
    if int(beyond.sum()) < 8:
        raise ValueError("no frequency lies beyond the cut-off of the aperture: give readout_noise")
    power = (torch.fft.fft2(frames, norm="ortho").abs() ** 2)[..., beyond].mean(0)
    degrees = len(frames)  # power is exponential, its mean over T frames a gamma variable
    median_over_mean = math.exp(-1 / (3 * degrees)) if degrees > 1 else math.log(2)
    return float(power.median()) / median_over_mean


def mean_frame(frames: Tensor, field: Grid) -> Tensor:
    """The clipped mean of the frames (T, H, W) on the object's wider field (H', W'), zero in the margin."""
    mean = frames.mean(0).clamp(min=0)
    rows, columns = field.shape
    return torch.nn.functional.pad(mean, (0, columns - mean.shape[1], 0, rows - mean.shape[0]))
