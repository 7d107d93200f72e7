"""Local means of an image."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def smooth(image: Tensor, width: float) -> Tensor:
    """Convolve images (..., H, W) periodically with a Gaussian of standard deviation `width` [pixels]."""
    nu_y = torch.fft.fftfreq(image.shape[-2], dtype=image.dtype, device=image.device)[:, None]
    nu_x = torch.fft.rfftfreq(image.shape[-1], dtype=image.dtype, device=image.device)
    response = torch.exp(-2 * (math.pi * width) ** 2 * (nu_y**2 + nu_x**2))
    return torch.fft.irfft2(torch.fft.rfft2(image) * response, s=image.shape[-2:])
