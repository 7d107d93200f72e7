"""What a restoration assumes: edges are sparse in the object, and the aberrations are turbulence."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import Aperture

_LEAST_ERROR = 1e-3  # rad
_ROUNDING = 1e-6  # of a covariance that may come from float32


def total_variation(image: Tensor, epsilon: float = 0.01) -> tuple[Tensor, Tensor]:
    """Isotropic smoothed total variation of `image` (..., H, W) and its gradient.

    sum sqrt(dx^2 + dy^2 + epsilon^2) - epsilon over pixels, with forward differences that are periodic at the border
    (Rudin, Osher & Fatemi, Physica D 60, 259, 1992). Values are (...), the gradient has the shape of `image`.
    """
    dy, dx, length = _slopes(image, epsilon)
    return (length - epsilon).sum(dim=(-2, -1)), divergence(dy / length, dx / length)


def total_variation_curvature(image: Tensor, epsilon: float = 0.01) -> Tensor:
    """Diagonal of a quadratic that majorises `total_variation` at `image`, same shape: the sum of 1/length around."""
    inverse = 1 / _slopes(image, epsilon)[2]
    return 2 * inverse + inverse.roll(1, -2) + inverse.roll(1, -1)


def gradient(image: Tensor) -> tuple[Tensor, Tensor]:
    """Forward differences of (..., H, W), periodic, along rows and columns."""
    return image.roll(-1, -2) - image, image.roll(-1, -1) - image


def divergence(dy: Tensor, dx: Tensor) -> Tensor:
    """The adjoint of `gradient`."""
    return dy.roll(1, -2) - dy + dx.roll(1, -1) - dx


def _slopes(image: Tensor, epsilon: float) -> tuple[Tensor, Tensor, Tensor]:
    dy, dx = gradient(image)
    return dy, dx, torch.sqrt(dy**2 + dx**2 + epsilon**2)


def whitening(aperture: Aperture, n_modes: int, r0: float, outer_scale: float) -> Tensor:
    """L (N J, K) with L L^T the von Karman covariance of all modes, less the piston common to all sub-apertures.

    Coefficients a = L z, sub-aperture by sub-aperture, follow von Karman statistics if z is white noise. The mean
    piston cannot be seen; without it K = N J - 1. r0 and outer_scale in m, L in rad.
    """
    covariance = modal_covariance(aperture, n_modes, r0, outer_scale)
    n_sub = aperture.n_subapertures
    common = torch.zeros(n_sub, n_modes, dtype=covariance.dtype, device=covariance.device)
    common[:, 0] = n_sub**-0.5
    remove = torch.eye(n_sub * n_modes, dtype=covariance.dtype, device=covariance.device)
    remove = remove - torch.outer(common.flatten(), common.flatten())
    values, vectors = torch.linalg.eigh(remove @ covariance @ remove)
    return (vectors[:, 1:] * values[1:].clamp(min=0).sqrt()).flip(1)


def root(covariance: Tensor) -> Tensor:
    """Symmetric square root R (K, K) [rad] of a covariance (K, K) [rad^2], whose least error is taken as 1 mrad.

    Raises ValueError if the covariance is not finite, not symmetric or has negative eigenvalues.
    """
    if not bool(torch.isfinite(covariance).all()):
        raise ValueError("covariance holds values that are not finite")
    largest = float(covariance.abs().max())
    if float((covariance - covariance.T).abs().max()) > _ROUNDING * largest:
        raise ValueError("covariance is not symmetric")
    values, vectors = torch.linalg.eigh(covariance)
    if float(values[0]) < -_ROUNDING * largest * len(values):
        raise ValueError(f"covariance has an eigenvalue of {float(values[0]):.3g} rad^2: none may be negative")
    return (vectors * values.clamp(min=_LEAST_ERROR**2).sqrt()) @ vectors.T
