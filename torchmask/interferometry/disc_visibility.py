"""Visibility of a uniform disc, as stars are to an interferometer that resolves them.

A disc of angular diameter a has V = 2 J1(x) / x, with x = pi a f at a frequency of modulus f (Hanbury Brown et al.
1974, MNRAS 167, 121).
"""

from __future__ import annotations

import math

import torch
from scipy.special import jv
from torch import Tensor

from torchmask.optics.shapes import Disc

FIRST_NULL = 1.22  # diameter, in periods of its fringe, at which a baseline sees none
_TINY = torch.finfo(torch.float64).tiny


def disc_visibilities(frequencies: Tensor, diameters: Tensor | float) -> Tensor:
    """Return visibilities (..., F) of uniform discs of `diameters` (...) [rad] at frequencies (F, 2) [cycles per rad].

    They are as the amplitude that a round hole diffracts.

    Examples
    --------
    A baseline of 1.22 wavelengths over the diameter sees no fringes:

    >>> baseline = torch.tensor([[1.2196699e6, 0.0]], dtype=torch.float64)
    >>> bool(disc_visibilities(baseline, 1e-6).abs() < 1e-7)
    True
    """
    return torch.from_numpy(Disc().amplitude((_sizes(diameters)[..., None] * frequencies).numpy(), 1.0))


def disc_slopes(frequencies: Tensor, diameters: Tensor | float) -> Tensor:
    """Return derivatives (..., F) of `disc_visibilities` in the diameters [1 / rad]."""
    turns = math.pi * torch.linalg.vector_norm(frequencies, dim=1)
    x = turns * _sizes(diameters)
    return -2 * turns * torch.from_numpy(jv(2, x.numpy())) / x.clamp(min=_TINY)


def _sizes(diameters: Tensor | float) -> Tensor:
    return torch.as_tensor(diameters, dtype=torch.float64)[..., None]
