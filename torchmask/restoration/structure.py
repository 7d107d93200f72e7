"""How steep an image is around each pixel and in which direction: its structure tensor, and a metric that evens it out.

The structure tensor is the local mean of g g^T, with g the gradient: across an edge it is large, along it small
(Foerstner & Guelch, Proc. ISPRS Intercommission Conf. Interlaken, 281, 1987).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.restoration.slopes import gradient

_POWER = 0.7  # of the local slope: 0 leaves slopes as they are, 1 makes all alike; 0.7 to 1 tried
_LEAST = 0.05  # local slope, over the root of the mean of tr J / 2 by slopes, that counts as even: 0.02 to 0.2 tried


class Metric(NamedTuple):
    """By how much slopes count around each pixel, all (H', W'): g as |M g|, with the symmetric matrix M, bends by size.

    yy, xy, xx : the elements of M
    size : by how much bends count
    """

    yy: Tensor
    xy: Tensor
    xx: Tensor
    size: Tensor

    def of(self, dy: Tensor, dx: Tensor) -> tuple[Tensor, Tensor]:
        """Return M times (dy, dx)."""
        return self.yy * dy + self.xy * dx, self.xy * dy + self.xx * dx


def even_metric(image: Tensor, reach: float) -> Metric | None:
    """Return the metric in which the slopes of `image` (H', W') are more even; None if it has none.

    Each slope is multiplied by the local root mean square of the slopes in its direction, to the power -0.7, and bends
    by that over all directions: M is the structure tensor to the power -0.35. The local mean is by a Gaussian whose
    standard deviation is `reach` pixels. Both are scaled so that all slopes of the image cost what they did together.
    """
    dy, dx = gradient(image)
    steepest = torch.hypot(dy, dx).max()
    if not steepest > 0:
        return None
    dy, dx = dy / steepest, dx / steepest  # of any unit: squares would vanish
    length = torch.hypot(dy, dx)
    total = length.sum()
    yy, xx, xy = smooth(torch.stack([dy * dy, dx * dx, dy * dx]), reach)
    mean, half = (yy + xx) / 2, (yy - xx) / 2
    spread = torch.hypot(half, xy)
    unit = (mean * length).sum() / total

    def counts(square: Tensor) -> Tensor:
        return (square / unit).clamp(min=_LEAST**2) ** (-_POWER / 2)

    across, along, size = counts(mean + spread), counts(mean - spread), counts(mean)
    straight = torch.where(spread > 0, (across - along) / 2 / spread.clamp(min=torch.finfo(spread.dtype).tiny), 0.0)
    level = (across + along) / 2
    metric = Metric(level + straight * half, straight * xy, level - straight * half, size)
    scale = total / torch.hypot(*metric.of(dy, dx)).sum()
    size = size * total / (size * length).sum()
    return Metric(scale * metric.yy, scale * metric.xy, scale * metric.xx, size)


def smooth(image: Tensor, width: float) -> Tensor:
    """Convolve images (..., H, W) periodically with a Gaussian of standard deviation `width` [pixels]."""
    nu_y = torch.fft.fftfreq(image.shape[-2], dtype=image.dtype, device=image.device)[:, None]
    nu_x = torch.fft.rfftfreq(image.shape[-1], dtype=image.dtype, device=image.device)
    response = torch.exp(-2 * (math.pi * width) ** 2 * (nu_y**2 + nu_x**2))
    return torch.fft.irfft2(torch.fft.rfft2(image) * response, s=image.shape[-2:])
