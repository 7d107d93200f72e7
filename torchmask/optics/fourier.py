"""Fourier transforms of images, of which there may be none."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def transform_images(transform: Callable[[Tensor], Tensor], images: Tensor) -> Tensor:
    """Apply an FFT over the last two axes of images (..., H, W); an empty batch, which the FFT of MKL refuses, too.

    Examples
    --------
    >>> transform_images(torch.fft.rfft2, torch.zeros(0, 5, 8, 8)).shape
    torch.Size([0, 5, 8, 5])
    """
    if 0 not in images.shape[:-2]:
        return transform(images)
    one = images.new_zeros(1, *images.shape[-2:])  # together with which there are some
    return transform(torch.cat([images.flatten(0, -3), one]))[:-1].unflatten(0, images.shape[:-2])
