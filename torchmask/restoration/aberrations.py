"""The aberrations of every frame as linear functions of parameters that are white under their prior."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import Aperture

_STRENGTH_RANGE = (0.05, 20.0)  # of the turbulence against its first guess, in (1/r0)^(5/3)
_LEAST_ERROR = 1e-3  # rad
_ROUNDING = 1e-6  # of a covariance that may come from float32


class AberrationBasis(nn.Module):
    """Zernike coefficients a = mixing z of all sub-apertures of a frame, from its K parameters z.

    Parameters
    ----------
    mixing : (N J, K) tensor
        Sub-aperture by sub-aperture, in rad. Its last `n_common` columns are aberrations common to all frames: whoever
        fits the parameters keeps those equal in every frame.
    n_modes : int
        J, Zernike modes per sub-aperture, Noll 1 to J.
    n_common : int
        How many of the K parameters are common to all frames.

    Examples
    --------
    >>> basis = AberrationBasis(2 * torch.eye(6, dtype=torch.float64), n_modes=3)
    >>> basis.coefficients(torch.ones(4, 6, dtype=torch.float64)).shape  # four frames of two sub-apertures
    torch.Size([4, 2, 3])
    """

    mixing: Tensor

    def __init__(self, mixing: Tensor, n_modes: int, n_common: int = 0) -> None:
        super().__init__()
        self.register_buffer("mixing", mixing)
        self.n_modes: int = n_modes
        self.n_common: int = n_common

    @property
    def n_subapertures(self) -> int:
        """N."""
        return len(self.mixing) // self.n_modes

    @property
    def n_parameters(self) -> int:
        """K, the number of parameters of a frame."""
        return self.mixing.shape[1]

    @property
    def n_own(self) -> int:
        """How many of the parameters are a frame's own."""
        return self.n_parameters - self.n_common

    def coefficients(self, z: Tensor) -> Tensor:
        """Zernike coefficients (..., N, J) [rad rms] of the parameters (..., K)."""
        return (z @ self.mixing.to(z).T).unflatten(-1, (self.n_subapertures, self.n_modes))

    def parameters_of(self, coefficients: Tensor) -> Tensor:
        """The parameters (T, K) whose coefficients come closest to (T, N, J): exact but for the mean piston.

        What all frames share goes to the common parameters as far as those reach, which makes them equal.
        """
        own, common = self.mixing.double().tensor_split([self.n_own], dim=1)
        flat = coefficients.to(own).flatten(1)
        shared = flat.mean(0) @ torch.linalg.pinv(common).T
        z = (flat - shared @ common.T) @ torch.linalg.pinv(own).T
        return torch.cat([z, shared.expand(len(z), -1)], dim=1)

    def with_common_of(self, z: Tensor, other: Tensor) -> Tensor:
        """z (..., T, K) whose common parameters are those of `other` (..., T or 1, K)."""
        if not self.n_common:
            return z
        return torch.cat([z[..., : self.n_own], other[..., self.n_own :].expand(*z.shape[:-1], -1)], dim=-1)

    def mean_common(self, z: Tensor) -> Tensor:
        """z (..., T, K) whose common parameters are replaced by their mean over the frames."""
        return self.with_common_of(z, z.mean(-2, keepdim=True))

    def draw(self, like: Tensor, rms: float, generator: torch.Generator) -> Tensor:
        """Random parameters (T, K) of the given rms; the common ones are the same in every frame."""
        z = rms * torch.randn(like.shape, dtype=like.dtype, device="cpu", generator=generator).to(like)
        return self.with_common_of(z, z[:1])

    def unwrapped(self, z: Tensor, centre: Tensor) -> Tensor:
        """z (T, K) with full waves taken off the pistons where that brings it closer to `centre` (T, K).

        Frames of one wavelength do not change by it; those of several would.
        """
        if self.n_subapertures == 1:  # its piston is that of all
            return z
        own = self.n_own
        waves = 2 * math.pi * torch.linalg.pinv(self.mixing[:, :own].to(z))[:, :: self.n_modes]  # (own, N)
        z = z.clone()
        for _ in range(2):  # a wave off one hole may ask for one off its neighbour
            for wave in waves.T:
                away = z[:, :own] - centre[:, :own]
                z[:, :own] -= (away @ wave / wave.square().sum()).round()[:, None] * wave
        return z

    def turbulence_strength(self, z: Tensor) -> float | None:
        """Variance of the frames' own aberrations (T, K) over that of the prior: (r0 of the prior / r0)^(5/3).

        From tips and tilts relative to their mean over the sub-apertures, which are seen best and depend least on the
        outer scale; from defocus to Noll 10 for a single aperture. None where there are no such modes.
        """
        n_sub, n_modes = self.n_subapertures, self.n_modes
        low, high = (1, 3) if n_sub > 1 else (3, 10)
        if n_modes < low + 2:
            return None
        mixing = self.mixing[:, : self.n_own]
        coefficients = (z[:, : self.n_own] @ mixing.to(z).T).unflatten(1, (n_sub, n_modes))
        covariance = (mixing @ mixing.T).to(z).unflatten(1, (n_sub, n_modes)).unflatten(0, (n_sub, n_modes))
        modes = coefficients[..., low:high]
        expected = torch.einsum("njnj->j", covariance)[low:high].sum()
        if n_sub > 1:
            modes = modes - modes.mean(1, keepdim=True)
            expected = expected - torch.einsum("njmj->j", covariance)[low:high].sum() / n_sub
        ratio = float((modes**2).sum() / len(z) / expected)
        return min(max(ratio, _STRENGTH_RANGE[0]), _STRENGTH_RANGE[1])


def plain_basis(aperture: Aperture, n_modes: int) -> AberrationBasis:
    """The basis whose parameters are the Zernike coefficients themselves."""
    identity = torch.eye(aperture.n_subapertures * n_modes, dtype=aperture.centers.dtype, device="cpu")
    return AberrationBasis(identity, n_modes)


def turbulent_basis(
    aperture: Aperture, n_modes: int, common_modes: int, r0: float, outer_scale: float, *, whitened: bool = True
) -> AberrationBasis:
    """The basis of turbulence, with aberrations common to all frames beside those of each.

    `n_modes` are those of each frame, `common_modes` those common to all (0: none), whose prior is turbulence as strong
    as a sub-aperture is wide. r0 and outer_scale [m]. With `whitened` false the parameters are the coefficients.
    """
    total = max(n_modes, common_modes)

    def columns(modes: int, strength: float) -> Tensor:
        n_sub = aperture.n_subapertures
        if whitened:
            mixing = whitening(aperture, modes, strength, outer_scale)
        else:
            mixing = torch.eye(n_sub * modes, device="cpu")
        return nn.functional.pad(mixing.unflatten(0, (n_sub, modes)), (0, 0, 0, total - modes)).flatten(0, 1)

    own = columns(n_modes, r0)
    common = columns(common_modes, aperture.subaperture_diameter).to(own) if common_modes else own[:, :0]
    return AberrationBasis(torch.cat([own, common], dim=1), total, common.shape[1])


def estimated_basis(aperture: Aperture, n_modes: int, covariance: Tensor) -> AberrationBasis:
    """The basis in which the errors of estimated coefficients, of `covariance` (N J, N J) [rad^2], are white.

    Raises ValueError if the covariance has another shape or is not one.
    """
    n_sub, size = aperture.n_subapertures, aperture.n_subapertures * n_modes
    if tuple(covariance.shape) != (size, size):
        raise ValueError(
            f"covariance has shape {tuple(covariance.shape)}: it must be ({size}, {size}), sub-aperture by "
            f"sub-aperture, of {n_sub} x {n_modes} coefficients"
        )
    return AberrationBasis(root(covariance.double()), n_modes)


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
