"""Statistics of the turbulent phase: von Karman spectrum, covariance, structure function, and that of Zernike modes.

W(f) = c r0^(-5/3) (f^2 + 1/L0^2)^(-11/6), f in cycles/m, with c from the definition of r0, that is from the structure
function 6.88 (r/r0)^(5/3) of Kolmogorov turbulence. Covariance: Assemat & Wilson, Opt. Express 14, 988 (2006).
"""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import special
from torch import Tensor

from torchmask.optics.aperture import Aperture
from torchmask.optics.zernike import aperture_modes, noll, outer_radius, quadrature

STRUCTURE_CONSTANT = 2 * (24 / 5 * math.gamma(6 / 5)) ** (5 / 6)  # 6.883877
PSD_CONSTANT = STRUCTURE_CONSTANT * math.gamma(11 / 6) ** 2 * math.sin(5 * math.pi / 6) / (2 * math.pi ** (11 / 3))
_VARIANCE_CONSTANT = PSD_CONSTANT * 6 * math.pi / 5  # of the total variance, in (L0/r0)^(5/3)


def require_turbulence(r0: float, outer_scale: float) -> None:
    """Raise ValueError unless both scales are finite and positive."""
    for name, value in (("r0", r0), ("outer_scale", outer_scale)):
        if not (math.isfinite(value) and value > 0):
            hint = " (for Kolmogorov turbulence take some thousand diameters)" if value == math.inf else ""
            raise ValueError(f"{name} is {value}: it must be finite and positive, in m{hint}")


def von_karman_psd(frequency: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Power spectral density of the phase [rad^2 m^2] at `frequency` >= 0 [cycles/m], any shape."""
    require_turbulence(r0, outer_scale)
    return PSD_CONSTANT * r0 ** (-5 / 3) * (frequency**2 + outer_scale**-2) ** (-11 / 6)


def von_karman_covariance(distance: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Covariance of the phase [rad^2] of two points `distance` [m] apart, any shape.

    0.0863 (L0/r0)^(5/3) times x^(5/6) K_5/6(x) 2^(1/6) / Gamma(5/6), x = 2 pi distance / L0. Evaluated by SciPy on
    the CPU; not differentiable.
    """
    require_turbulence(r0, outer_scale)
    variance = _VARIANCE_CONSTANT * (outer_scale / r0) ** (5 / 3)
    return variance * _matern(distance, outer_scale)


def von_karman_structure_function(distance: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Mean square phase difference [rad^2] of two points `distance` [m] apart, any shape: 2 (B(0) - B(distance))."""
    require_turbulence(r0, outer_scale)
    variance = _VARIANCE_CONSTANT * (outer_scale / r0) ** (5 / 3)
    return 2 * variance * (1 - _matern(distance, outer_scale))


def _matern(distance: Tensor, outer_scale: float) -> Tensor:
    x = 2 * math.pi / outer_scale * distance.detach().cpu().double().abs().numpy()
    safe = np.where(x > 0, x, 1.0)
    value = 2 ** (1 / 6) / special.gamma(5 / 6) * safe ** (5 / 6) * special.kv(5 / 6, safe)
    return torch.from_numpy(np.where(x > 0, value, 1.0)).to(distance)


def modal_covariance(aperture: Aperture, n_modes: int, r0: float, outer_scale: float) -> Tensor:
    """Joint covariance [rad^2] of the Zernike coefficients of all sub-apertures under von Karman turbulence.

    Parameters
    ----------
    aperture : Aperture
        One mask: centres (N, 2).
    n_modes : int
        J, Noll modes 1 (piston) to J.
    r0, outer_scale : float
        [m].

    Returns
    -------
    Tensor
        (N J, N J), ordered by sub-aperture, then mode: row p * J + j - 1 is mode j of sub-aperture p. dtype and
        device of the centres; not differentiable.

    Raises
    ------
    ValueError
        For a population of masks, or scales that are not finite and positive.

    Notes
    -----
    The covariance is the integral of W(f) M_p(f) M_q(f)* over frequencies, M the Fourier transforms of the modes.
    The quadrature keeps that form, the Gram matrix Q^T Q, so the result is positive semi-definite to rounding.
    Frequencies are polar: Gauss nodes in |f|, packed towards f = 0 where the outer scale bends the spectrum, and
    uniform angles, which converge exponentially once they resolve the longest baseline.
    """
    require_turbulence(r0, outer_scale)
    if aperture.centers.ndim != 2:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: one mask (n_subapertures, 2) is needed")
    centers = aperture.centers.detach().cpu().double()
    centers = centers - centers.mean(0)
    reach = float(torch.linalg.vector_norm(centers, dim=-1).max()) * 2 + 2 * outer_radius(aperture)
    total = torch.zeros(len(centers) * n_modes, len(centers) * n_modes, dtype=torch.float64)
    order = noll(n_modes)[0]
    highest = (20 + 2 * order) / (math.pi * aperture.subaperture_diameter)
    degree = math.ceil(2 * math.pi * highest * outer_radius(aperture)) + order + 16
    points, weights = quadrature(aperture, degree)
    modes = weights[:, None] * aperture_modes(aperture, points, n_modes)  # (Q, J)
    modes = torch.complex(modes, torch.zeros_like(modes))
    for low, high in _panels(highest, outer_scale, reach):
        nodes, node_weights = np.polynomial.legendre.leggauss(16)
        n_angles = math.ceil(math.pi * high * reach + 2 * order + 12)
        angle = torch.arange(n_angles, dtype=torch.float64) * math.pi / n_angles  # half a turn: the rest is conjugate
        radius = torch.from_numpy((low + high) / 2 + (high - low) / 2 * nodes)
        weight = torch.from_numpy(node_weights) * (high - low) / 2 * radius * 2 * math.pi / n_angles
        weight = (weight * von_karman_psd(radius, r0, outer_scale)).sqrt()
        frequency = radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], dim=-1)  # (R, A, 2)
        frequency = frequency.flatten(0, 1)
        transform = _unit_phasor(frequency @ points.T) @ modes  # (R A, J)
        transform = transform * weight.repeat_interleave(n_angles)[:, None]
        field = _unit_phasor(frequency @ centers.T)[:, :, None] * transform[:, None, :]
        factor = torch.view_as_real(field.flatten(1)).movedim(-1, 0).flatten(0, 1)  # real and imaginary rows
        total += factor.T @ factor
    return total.to(aperture.centers)


def _panels(highest: float, outer_scale: float, reach: float) -> list[tuple[float, float]]:
    """Panels of |f| for Gauss quadrature: doubling from the outer scale, no wider than the phases allow."""
    widest = 1.5 / reach
    edges = [0.0, min(0.25 / outer_scale, widest)]
    while edges[-1] < highest:
        edges.append(edges[-1] + min(edges[-1], widest))
    return list(zip(edges[:-1], edges[1:], strict=True))


def _unit_phasor(cycles: Tensor) -> Tensor:
    phase = 2 * math.pi * cycles
    return torch.complex(phase.cos(), phase.sin())
