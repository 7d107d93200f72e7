"""Random numbers that do not depend on where, and how precisely, they are used."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def draw_normal(
    shape: Sequence[int], dtype: torch.dtype, device: torch.device | str, generator: torch.Generator | None
) -> Tensor:
    """Draw standard normal numbers, real or complex; those of a generator are the same on all devices and precisions.

    >>> single, double = (
    ...     draw_normal((3,), dtype, "cpu", torch.Generator().manual_seed(0))
    ...     for dtype in (torch.float32, torch.float64)
    ... )
    >>> bool((single == double.float()).all())
    True
    """
    if generator is None:
        return torch.randn(shape, dtype=dtype, device=device)
    double = torch.complex128 if dtype.is_complex else torch.float64
    return torch.randn(shape, dtype=double, device=generator.device, generator=generator).to(device, dtype)
