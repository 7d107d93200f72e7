"""Fading of the border of frames, which keeps light that is cut off there from the frequencies beyond the cut-off.

The Fourier transform takes a frame for a period of a periodic image. Light that differs between two opposite borders
makes a step then, which has power at all frequencies. In a frame whose border fades to zero there is no step.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture

_PART = 6  # of the frame's side, over which its border fades


def fading(frames: Tensor) -> Tensor:
    """Return a window (H, W) for frames (T, H, W) that is 1 but near the border, where it falls to 0."""
    down, across = (_fading(side).to(frames) for side in frames.shape[1:])
    return down[:, None] * across


def beyond_faded(grid: Grid, aperture: Aperture, frames: Tensor) -> Tensor:
    """Return which frequencies (H, W) of faded frames (T, H, W) hold no light.

    Where pixels are fine enough they are as far beyond the cut-off as the fading spreads light.
    """
    nu_y, nu_x = grid.frequencies(frames.dtype, frames.device)
    cutoff, spread = grid.cutoff(aperture.extent), _PART / min(frames.shape[1:])
    return torch.hypot(nu_y, nu_x) > max(cutoff, min(0.5, cutoff + spread))


def _fading(side: int) -> Tensor:
    """Return a window (side,) that rises from 0 at either end to 1."""
    place = torch.arange(side, dtype=torch.float64, device="cpu") + 0.5
    return torch.sin(math.pi / 2 * (torch.minimum(place, side - place) * _PART / side).clamp(max=1)) ** 2
