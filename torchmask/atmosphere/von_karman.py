"""Statistics of von Karman turbulence: spectrum, covariance, structure function and the covariance of Zernike modes.

The spectrum is W(f) = c r0^(-5/3) (f^2 + 1/L0^2)^(-11/6), f in cycles/m, with c from the definition of r0, that is from
the structure function 6.88 (r/r0)^(5/3) of Kolmogorov turbulence. Source of the covariance: Assemat & Wilson, Opt.
Express 14, 988 (2006).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from scipy import special
from torch import Tensor

from torchmask.atmosphere.mode_transforms import directions, mode_transforms
from torchmask.optics.phasor import phasor
from torchmask.optics.pupil import Aperture
from torchmask.optics.shape_base import Shape
from torchmask.optics.zernike import noll

STRUCTURE_CONSTANT = 2 * (24 / 5 * math.gamma(6 / 5)) ** (5 / 6)  # 6.883877
PSD_CONSTANT = STRUCTURE_CONSTANT * math.gamma(11 / 6) ** 2 * math.sin(5 * math.pi / 6) / (2 * math.pi ** (11 / 3))
_VARIANCE_CONSTANT = PSD_CONSTANT * 6 * math.pi / 5  # total variance in units of (L0/r0)^(5/3)
# Values of pi |f| outer_diameter, plus 2 for every radial order, above which the integral over frequencies neglects the
# coupling of sub-apertures, and where it ends.
_SHARED = 10
_HIGHEST = 24
_KEPT = 16  # covariances: a restoration asks for three or four, and the next one of the same mask for the same


def require_turbulence(r0: float, outer_scale: float) -> None:
    """Raise ValueError unless both scales are finite and positive."""
    for name, value in (("r0", r0), ("outer_scale", outer_scale)):
        if not (math.isfinite(value) and value > 0):
            hint = " (for Kolmogorov turbulence take some thousand diameters)" if value == math.inf else ""
            raise ValueError(f"{name} is {value}: it must be finite and positive, in m{hint}")


def von_karman_psd(frequency: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Return the power spectral density of the phase [rad^2 m^2] at `frequency` >= 0 [cycles/m], of any shape."""
    require_turbulence(r0, outer_scale)
    return PSD_CONSTANT * r0 ** (-5 / 3) * (frequency**2 + outer_scale**-2) ** (-11 / 6)


def von_karman_covariance(distance: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Return the covariance B [rad^2] of the phases of two points `distance` [m] apart, of any shape.

    B = 0.0863 (L0/r0)^(5/3) x^(5/6) K_5/6(x) 2^(1/6) / Gamma(5/6), x = 2 pi distance / L0. SciPy computes it on the
    CPU; it is not differentiable.
    """
    require_turbulence(r0, outer_scale)
    variance = _VARIANCE_CONSTANT * (outer_scale / r0) ** (5 / 3)
    return torch.as_tensor(variance * _correlation(_argument(distance, outer_scale)), device="cpu").to(distance)


def von_karman_structure_function(distance: Tensor, r0: float, outer_scale: float) -> Tensor:
    """Return the structure function 2 (B(0) - B(distance)) [rad^2] at `distance` [m], of any shape.

    It is accurate at all distances: where the difference would cancel, it is summed as a series in distance / L0 whose
    first term is 6.88 (distance / r0)^(5/3). SciPy computes it on the CPU; it is not differentiable.
    """
    require_turbulence(r0, outer_scale)
    variance = _VARIANCE_CONSTANT * (outer_scale / r0) ** (5 / 3)
    x = _argument(distance, outer_scale)
    # K_5/6 is a difference of two series, in x^2k and x^(2k + 5/3); the constant term of the first is B(0).
    small = np.minimum(x, 1)
    k = np.arange(1, 12)
    even = (small[..., None] / 2) ** (2 * k) / (special.gamma(k + 1) * special.poch(1 / 6, k))
    odd = special.gamma(1 / 6) / special.gamma(11 / 6) * (small / 2) ** (5 / 3) * special.hyp0f1(11 / 6, small**2 / 4)
    values = 2 * variance * np.where(x < 1, odd - even.sum(-1), 1 - _correlation(x))
    return torch.as_tensor(values, device="cpu").to(distance)


def _argument(distance: Tensor, outer_scale: float) -> np.ndarray:
    return 2 * math.pi / outer_scale * distance.detach().cpu().double().abs().numpy()


def _correlation(x: np.ndarray) -> np.ndarray:
    """Return x^(5/6) K_5/6(x), normalised to 1 at 0."""
    safe = np.where(x > 0, x, 1.0)
    return np.where(x > 0, 2 ** (1 / 6) / special.gamma(5 / 6) * safe ** (5 / 6) * special.kv(5 / 6, safe), 1.0)


def modal_covariance(
    aperture: Aperture, n_modes: int, r0: float, outer_scale: float, drift: float | None = None
) -> Tensor:
    """Return the joint covariance [rad^2] of the Zernike coefficients of all sub-apertures in von Karman turbulence.

    Parameters
    ----------
    aperture : Aperture
        One mask, with centres (N, 2).
    n_modes : int
        Number of modes J per sub-aperture, from Noll mode 1 (piston).
    r0 : float
        Fried parameter [m].
    outer_scale : float
        Outer scale of the turbulence [m].
    drift : float, optional
        With a distance [m], the covariance of the change of the coefficients while frozen turbulence moves by so much,
        all directions being equally likely. None: the covariance of the coefficients themselves.

    Returns
    -------
    Tensor
        (N J, N J), ordered by sub-aperture, then mode: row p J + j - 1 is mode j of sub-aperture p. It lies on the
        device of the centres but is always float64, because the common piston is so much larger than the high modes
        that float32 would make the matrix indefinite. If you need float32, round its Cholesky factor. It is not
        differentiable.

    Raises
    ------
    ValueError
        If the aperture is a population of masks, a scale is not finite and positive, or the drift is negative or not
        finite.

    Notes
    -----
    The last few covariances are kept, so that the next restoration of the same mask does not compute its own again.
    The covariance is the integral of W(f) M_p(f) M_q(f)* over frequencies, with M the Fourier transforms of the modes.
    For the change, the spectrum is 2 W(f) (1 - J_0(2 pi f drift)) instead of W(f).
    The quadrature has the same form, a Gram matrix, so the result is positive semi-definite to rounding. It is polar:
    Gauss nodes in |f|, denser towards f = 0 where the outer scale bends the spectrum, and uniform angles, which
    converge exponentially once they resolve the longest baseline. The error is 3e-4 of the variances up to radial order
    5 and 6e-4 at order 10.

    Examples
    --------
    >>> from torchmask.optics.aperture import FullAperture
    >>> covariance = modal_covariance(FullAperture(1.0), 3, r0=1.0, outer_scale=10.0)
    >>> [round(v, 3) for v in covariance.diagonal().tolist()]
    [3.556, 0.161, 0.161]
    """
    require_turbulence(r0, outer_scale)
    if drift is not None and not (math.isfinite(drift) and drift >= 0):
        raise ValueError(f"drift is {drift}: it must be finite and at least 0, in m")
    if aperture.centers.ndim != 2:
        raise ValueError(
            f"centers has shape {tuple(aperture.centers.shape)}: one mask, (n_subapertures, 2), is needed; pass the "
            "masks of a population one by one"
        )
    spectrum = _Spectrum(float(r0), float(outer_scale), None if drift is None else float(drift))
    return _covariance(_Holes.of(aperture), n_modes, spectrum).to(aperture.centers.device, copy=True)


@dataclass(frozen=True)
class _Holes:
    """All that the covariance depends on in an aperture, to look up what was computed; `centers` in m."""

    shape: Shape
    diameter: float
    centers: tuple[tuple[float, ...], ...]
    aperture: Aperture = field(compare=False)

    @classmethod
    def of(cls, aperture: Aperture) -> _Holes:
        still = aperture.still().to("cpu")
        return cls(still.shape, still.subaperture_diameter, tuple(map(tuple, still.centers.tolist())), still)


class _Spectrum(NamedTuple):
    """Power spectral density of the phase, or of its change over a drift [rad^2 m^2]."""

    r0: float
    outer_scale: float
    drift: float | None

    def __call__(self, frequency: Tensor) -> Tensor:
        phase = von_karman_psd(frequency, self.r0, self.outer_scale)
        if self.drift is None:
            return phase
        return 2 * phase * (1 - torch.special.bessel_j0(2 * math.pi * self.drift * frequency))


@lru_cache(maxsize=_KEPT)
def _covariance(holes: _Holes, n_modes: int, spectrum: _Spectrum) -> Tensor:
    """Return the joint covariance (N J, N J); it is kept, so nobody may change it."""
    aperture, centers = holes.aperture, torch.tensor(holes.centers, dtype=torch.float64, device="cpu")
    bend = math.pi * aperture.outer_diameter / spectrum.outer_scale + 2 * noll(n_modes)[0]
    shared, highest = _SHARED + bend, (_HIGHEST + bend) / aperture.shape.fineness
    total = _gram(aperture, n_modes, spectrum, centers, 0.0, shared)
    own = _gram(aperture, n_modes, spectrum, torch.zeros_like(centers[:1]), shared, highest)
    total = total + torch.kron(torch.eye(len(centers), dtype=own.dtype, device=own.device), own)
    return (total + total.T) / 2


def _gram(aperture: Aperture, n_modes: int, spectrum: _Spectrum, places: Tensor, start: float, stop: float) -> Tensor:
    """Return the part of the covariance of holes at `places` (N, 2) from `start` <= pi |f| outer_diameter < `stop`."""
    order, diameter = noll(n_modes)[0], aperture.outer_diameter
    transforms = mode_transforms(aperture, n_modes, stop)
    reach = float(torch.cdist(places, places).max()) + diameter + 2 * (spectrum.drift or 0.0)
    total = places.new_zeros(len(places) * n_modes, len(places) * n_modes)
    low, high = start / (math.pi * diameter), stop / (math.pi * diameter)
    for frequency, area in _panels(low, high, spectrum.outer_scale, reach):
        # On half a turn, as the other half is the conjugate.
        n_angles = math.ceil(math.pi * float(frequency[-1]) * reach) + 2 * order + 24
        weight = 2 * math.pi / n_angles * area * spectrum(frequency)
        transform = weight.sqrt()[:, None, None] * transforms(frequency, n_angles)  # (R, A, J)
        shift = phasor(2 * math.pi * frequency[:, None, None] * (directions(n_angles) @ places.T))  # (R, A, N)
        field = (shift[..., None] * transform[..., None, :]).flatten(0, 1).flatten(1)  # (R A, N J)
        total += field.real.T @ field.real + field.imag.T @ field.imag
    return total


def _panels(start: float, stop: float, outer_scale: float, reach: float) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield Gauss nodes and weights |f| d|f| on panels that double in width until phases vary too fast across them."""
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(16))
    low = start
    while low < stop:
        width = min(max(low, 0.25 / outer_scale), 3 / reach, stop - low)
        frequency = low + width / 2 * (1 + nodes)
        yield frequency, width / 2 * weights * frequency
        low = stop if width == stop - low else low + width
