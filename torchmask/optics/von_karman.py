"""Statistics of the turbulent phase: von Karman spectrum, covariance, structure function, and that of Zernike modes.

W(f) = c r0^(-5/3) (f^2 + 1/L0^2)^(-11/6), f in cycles/m, with c from the definition of r0, that is from the structure
function 6.88 (r/r0)^(5/3) of Kolmogorov turbulence. Covariance: Assemat & Wilson, Opt. Express 14, 988 (2006).
"""

from __future__ import annotations

import itertools
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
_HIGHEST = 14  # 2 pi |f| radius where the integral over frequencies ends, plus 2 for every radial order


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
        (N J, N J), ordered by sub-aperture, then mode: row p J + j - 1 is mode j of sub-aperture p. On the device of
        the centres but always float64, because the common piston is so much larger than the high modes that float32
        would make it indefinite: take its Cholesky factor first and round that. Not differentiable.

    Raises
    ------
    ValueError
        For a population of masks, or scales that are not finite and positive.

    Notes
    -----
    The covariance is the integral of W(f) M_p(f) M_q(f)* over frequencies, M the Fourier transforms of the modes. The
    quadrature keeps that form, a Gram matrix, so the result is positive semi-definite to rounding. Frequencies are
    polar: Gauss nodes in |f|, packed towards f = 0 where the outer scale bends the spectrum, and uniform angles, which
    converge exponentially once they resolve the longest baseline. What lies beyond the largest |f| is 1e-4 of the
    variance of the highest modes.

    Examples
    --------
    >>> from torchmask.optics.aperture import FullAperture
    >>> covariance = modal_covariance(FullAperture(1.0), 3, r0=1.0, outer_scale=10.0)
    >>> [round(v, 3) for v in covariance.diagonal().tolist()]
    [3.556, 0.161, 0.161]
    """
    require_turbulence(r0, outer_scale)
    if aperture.centers.ndim != 2:
        raise ValueError(
            f"centers has shape {tuple(aperture.centers.shape)}: the covariance is that of one mask, "
            "(n_subapertures, 2); take the masks of a population one by one"
        )
    centers = aperture.centers.detach().cpu().double()
    centers = centers - centers.mean(0)
    order, radius = noll(n_modes)[0], outer_radius(aperture)
    baseline = 2 * float(torch.linalg.vector_norm(centers, dim=-1).max())
    highest = (_HIGHEST + 2 * order) / (2 * math.pi * radius)
    points, weights = quadrature(aperture, math.ceil(_HIGHEST + 3 * order) + 16)
    modes = weights[:, None] * aperture_modes(aperture, points, n_modes)  # (Q, J)

    nodes, node_weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(16))
    total = torch.zeros(len(centers) * n_modes, len(centers) * n_modes, dtype=torch.float64)
    for low, high in _panels(highest, outer_scale, baseline + 2 * radius):
        frequency = (low + high) / 2 + (high - low) / 2 * nodes
        n_angles = math.ceil(math.pi * high * (baseline + 2 * radius)) + 2 * order + 12  # on half a turn
        angle = math.pi / n_angles * torch.arange(n_angles, dtype=torch.float64)
        area = node_weights * (high - low) / 2 * frequency * 2 * math.pi / n_angles
        amplitude = (area * von_karman_psd(frequency, r0, outer_scale)).sqrt()[:, None, None]
        n_known = math.ceil(2 * math.pi * high * radius) + order + 12
        transform = amplitude * _mode_transforms(points, modes, frequency, n_known, n_angles)  # (R, A, J)
        direction = torch.stack([angle.cos(), angle.sin()])
        phasor = _phasor(frequency[:, None, None] * (centers @ direction).T)  # (R, A, N)
        field = (phasor[..., None] * transform[..., None, :]).flatten(0, 1).flatten(1)  # (R A, N J)
        total += field.real.T @ field.real + field.imag.T @ field.imag
    return total.to(aperture.centers.device)


def _mode_transforms(points: Tensor, modes: Tensor, frequency: Tensor, n_known: int, n_angles: int) -> Tensor:
    """Fourier transforms of `modes` (Q, J) at `frequency` (R,) and `n_angles` angles on half a turn: (R, A, J).

    Evaluated at `n_known` angles, enough for one sub-aperture, and interpolated exactly (a trigonometric polynomial)
    to the many that a baseline needs.
    """
    angle = math.pi / n_known * torch.arange(n_known, dtype=torch.float64)
    projected = torch.stack([angle.cos(), angle.sin()], dim=-1) @ points.T  # (A, Q)
    half = _phasor(frequency[:, None, None] * projected) @ modes.to(torch.complex128)
    series = torch.fft.fft(torch.cat([half, half.conj()], dim=1), dim=1, norm="forward")
    padded = series.new_zeros(len(frequency), 2 * n_angles, modes.shape[-1])
    padded[:, :n_known] = series[:, :n_known]
    padded[:, -n_known:] = series[:, n_known:]
    return torch.fft.ifft(padded, dim=1, norm="forward")[:, :n_angles]


def _panels(highest: float, outer_scale: float, reach: float) -> list[tuple[float, float]]:
    """Panels of |f| for Gauss quadrature: doubling from the outer scale, no wider than the phases allow."""
    widest = 3 / reach
    edges = [0.0, min(0.25 / outer_scale, widest)]
    while edges[-1] < highest:
        edges.append(edges[-1] + min(edges[-1], widest))
    return list(itertools.pairwise(edges))


def _phasor(cycles: Tensor) -> Tensor:
    return torch.polar(torch.ones_like(cycles), 2 * math.pi * cycles)
