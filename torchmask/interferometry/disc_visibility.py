"""Visibility of a uniform disc, as stars are to an interferometer that resolves them.

A disc of angular diameter a has V = 2 J1(x) / x, with x = pi a f at a frequency of modulus f (Hanbury Brown et al.
1974, MNRAS 167, 121).
"""

from __future__ import annotations

import math

import torch
from scipy.special import j1, jv
from torch import Tensor

FIRST_NULL = 1.22  # diameter, in periods of its fringe, at which a baseline sees none
_SMALL = 1e-3  # argument below which the first two terms of the series are exact to rounding


def disc_visibilities(frequencies: Tensor, diameters: Tensor | float) -> Tensor:
    """Return visibilities (..., F) of uniform discs of `diameters` (...) [rad] at frequencies (F, 2) [cycles per rad].

    Examples
    --------
    A baseline of 1.22 wavelengths over the diameter sees no fringes:

    >>> baseline = torch.tensor([[1.2196699e6, 0.0]], dtype=torch.float64)
    >>> bool(disc_visibilities(baseline, 1e-6).abs() < 1e-7)
    True
    """
    x = _argument(frequencies, diameters)
    first = torch.from_numpy(j1(x.numpy()))  # that of PyTorch is accurate to 1e-7 only
    return torch.where(x < _SMALL, 1 - x**2 / 8, 2 * first / x.clamp(min=_SMALL))


def disc_slopes(frequencies: Tensor, diameters: Tensor | float) -> Tensor:
    """Return derivatives (..., F) of `disc_visibilities` in the diameters [1 / rad]."""
    x = _argument(frequencies, diameters)
    by_x = torch.where(x < _SMALL, -x / 4, -2 * torch.from_numpy(jv(2, x.numpy())) / x.clamp(min=_SMALL))
    return math.pi * torch.linalg.vector_norm(frequencies, dim=1) * by_x


def _argument(frequencies: Tensor, diameters: Tensor | float) -> Tensor:
    sizes = torch.as_tensor(diameters, dtype=torch.float64)[..., None]
    return math.pi * sizes * torch.linalg.vector_norm(frequencies, dim=1)
