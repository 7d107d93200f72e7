"""Bases of the aberrations, which are linear in parameters that are white noise under their prior."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchmask.atmosphere.structure import coherence_distance
from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import Aperture
from torchmask.optics.unrounded import product

_STRENGTH_RANGE = (0.05, 20.0)  # limits of the turbulence's strength relative to its first guess, in (1/r0)^(5/3)
_LEAST_ERROR = 1e-3  # rad
_MOVING_MODES = 3  # piston, tip and tilt
_INSTANTS = (-0.5 / math.sqrt(3), 0.5 / math.sqrt(3))  # the two Gauss nodes, exact for what is cubic in time
_ROUNDING = 1e-6  # relative rounding error of a covariance that may come from float32


class AberrationBasis(nn.Module):
    """Linear map from the K parameters z of a frame to the Zernike coefficients a = mixing z of its sub-apertures.

    Parameters
    ----------
    mixing : (N J, K) tensor
        Matrix [rad], ordered by sub-aperture. Its last `n_common` columns are aberrations common to all frames, whose
        parameters a fit must keep equal in every frame.
    n_modes : int
        Number of Zernike modes per sub-aperture, J, from Noll mode 1.
    n_common : int
        How many of the K parameters are common to all frames.
    motion : (N J, K) tensor, optional
        Matrix [rad] that gives the change of the coefficients from the beginning to the end of a frame. None: frames
        are snapshots.
    offsets : (N, K) tensor, optional
        Matrix [rad] of phases of whole sub-apertures that are the same at every wavelength, which no path difference
        is. None: there are none.

    Examples
    --------
    >>> basis = AberrationBasis(2 * torch.eye(6, dtype=torch.float64), n_modes=3)
    >>> basis.coefficients(torch.ones(4, 6, dtype=torch.float64)).shape  # four frames of two sub-apertures
    torch.Size([4, 2, 3])
    """

    mixing: Tensor
    motion: Tensor | None
    offsets: Tensor | None

    def __init__(
        self,
        mixing: Tensor,
        n_modes: int,
        n_common: int = 0,
        motion: Tensor | None = None,
        offsets: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.register_buffer("mixing", mixing)
        self.register_buffer("motion", motion)
        self.register_buffer("offsets", offsets)
        self.n_modes: int = n_modes
        self.n_common: int = n_common

    @property
    def n_subapertures(self) -> int:
        """Number of sub-apertures, N."""
        return len(self.mixing) // self.n_modes

    @property
    def n_parameters(self) -> int:
        """Number of parameters of a frame, K."""
        return self.mixing.shape[1]

    @property
    def n_own(self) -> int:
        """How many of the parameters are a frame's own."""
        return self.n_parameters - self.n_common

    @property
    def instants(self) -> tuple[float, ...]:
        """Times within a frame, which lasts from -1/2 to 1/2, whose images are averaged with equal weights."""
        return (0.0,) if self.motion is None else _INSTANTS

    def mixing_at(self, instant: float) -> Tensor:
        """Return the matrix (N J, K) at an instant of the frame, which lasts from -1/2 to 1/2."""
        return self.mixing if self.motion is None else self.mixing + instant * self.motion

    def in_motion(self, motion: Tensor) -> AberrationBasis:
        """Return the basis with M more parameters of each frame, for the change of its coefficients.

        `motion` (N J, M) [rad] is the change for one unit of each. They stand between the frame's other parameters and
        the common ones.
        """
        assert self.offsets is None, "offsets are added after a motion"
        own, common = self.mixing.tensor_split([self.n_own], dim=1)
        motion = motion.to(own)
        mixing = torch.cat([own, torch.zeros_like(motion), common], dim=1)
        moving = torch.cat([torch.zeros_like(own), motion, torch.zeros_like(common)], dim=1)
        return AberrationBasis(mixing, self.n_modes, self.n_common, moving)

    def with_offsets(self) -> AberrationBasis:
        """Return the basis with N more parameters of each frame: phases of its sub-apertures [waves of any wavelength].

        Under the prior, by which parameters are white, such a phase is one wave rms. They stand between the frame's
        other parameters and the common ones.
        """
        assert self.offsets is None, "the basis has offsets already"

        def widened(matrix: Tensor, new: Tensor) -> Tensor:
            own, common = matrix.tensor_split([self.n_own], dim=1)
            return torch.cat([own, new, common], dim=1)

        n, none = self.n_subapertures, self.mixing.new_zeros(len(self.mixing), self.n_subapertures)
        wave = 2 * math.pi * torch.eye(n, dtype=none.dtype, device=none.device)
        motion = None if self.motion is None else widened(self.motion, none)
        offsets = widened(none.new_zeros(n, self.n_parameters), wave)
        return AberrationBasis(widened(self.mixing, none), self.n_modes, self.n_common, motion, offsets)

    def coefficients(self, z: Tensor) -> Tensor:
        """Return Zernike coefficients (..., N, J) [rad rms] of the parameters (..., K), in the middle of the frame."""
        return product(z, self.mixing.to(z).T).unflatten(-1, (self.n_subapertures, self.n_modes))

    def change(self, z: Tensor) -> Tensor | None:
        """Return the change (..., N, J) [rad rms] of the coefficients within a frame; None for snapshots."""
        if self.motion is None:
            return None
        return product(z, self.motion.to(z).T).unflatten(-1, (self.n_subapertures, self.n_modes))

    def parameters_of_change(self, change: Tensor) -> Tensor:
        """Return the parameters (T, K) whose change is closest to (T, N, J) [rad rms]; all others are zero."""
        assert self.motion is not None
        motion = self.motion.double()
        return change.to(motion).flatten(1) @ torch.linalg.pinv(motion).T

    def parameters_of(self, coefficients: Tensor) -> Tensor:
        """Return the parameters (T, K) whose coefficients are closest to (T, N, J), exact except for the mean piston.

        The mean over the frames goes to the common parameters, as far as they can represent it.
        """
        own, common = self.mixing.double().tensor_split([self.n_own], dim=1)
        flat = coefficients.to(own).flatten(1)
        shared = flat.mean(0) @ torch.linalg.pinv(common).T
        z = (flat - shared @ common.T) @ torch.linalg.pinv(own).T
        return torch.cat([z, shared.expand(len(z), -1)], dim=1)

    def parameters_of_pistons(self, pistons: Tensor) -> Tensor:
        """Return the parameters (..., K) whose coefficients are closest to pistons (..., N) [rad] and nothing else."""
        own = torch.linalg.pinv(self.mixing[:, : self.n_own].double())[:, :: self.n_modes]
        return nn.functional.pad(pistons.to(own) @ own.T, (0, self.n_common))

    def with_common_of(self, z: Tensor, other: Tensor) -> Tensor:
        """Return z (..., T, K) with the common parameters of `other` (..., T or 1, K)."""
        if not self.n_common:
            return z
        return torch.cat([z[..., : self.n_own], other[..., self.n_own :].expand(*z.shape[:-1], -1)], dim=-1)

    def mean_common(self, z: Tensor) -> Tensor:
        """Return z (..., T, K) with its common parameters replaced by their mean over the frames."""
        return self.with_common_of(z, z.mean(-2, keepdim=True))

    def draw(self, like: Tensor, rms: float, generator: torch.Generator) -> Tensor:
        """Draw parameters (T, K) of the given rms; the common ones are the same in every frame."""
        z = rms * torch.randn(like.shape, dtype=like.dtype, device="cpu", generator=generator).to(like)
        return self.with_common_of(z, z[:1])

    def unwrapped(self, z: Tensor, centre: Tensor, wave: float = 2 * math.pi) -> Tensor:
        """Return z (T, K) with whole waves subtracted from pistons where that brings it closer to `centre` (T, K).

        This leaves frames of one wavelength unchanged, a `wave` of which is so many radians of the coefficients, but
        not those of several wavelengths.
        """
        if self.n_subapertures == 1:  # its piston is the mean piston, which is not visible
            return z
        own = self.n_own
        waves = wave * torch.linalg.pinv(self.mixing[:, :own].to(z))[:, :: self.n_modes]  # (own, N)
        z = z.clone()
        for _ in range(2):  # a wave subtracted from one hole may require one from its neighbour
            for one in waves.T:
                away = z[:, :own] - centre[:, :own]
                z[:, :own] -= (away @ one / one.square().sum()).round()[:, None] * one
        return z

    def turbulence_strength(self, z: Tensor) -> float | None:
        """Return the variance of the frames' own aberrations (T, K) over that of the prior: (prior r0 / r0)^(5/3).

        It is measured from tip and tilt relative to their means over the sub-apertures, which are best determined and
        depend least on the outer scale, or from defocus to Noll mode 10 for a single aperture. None for less than two.
        """
        n_sub, n_modes = self.n_subapertures, self.n_modes
        low, high = (1, 3) if n_sub > 1 else (3, 10)
        mixing = self.mixing[:, : self.n_own]
        coefficients = (z[:, : self.n_own] @ mixing.to(z).T).unflatten(1, (n_sub, n_modes))
        covariance = (mixing @ mixing.T).to(z).unflatten(1, (n_sub, n_modes)).unflatten(0, (n_sub, n_modes))
        modes = coefficients[..., low:high]
        expected = torch.einsum("njnj->j", covariance)[low:high]
        if n_sub > 1:
            modes = modes - modes.mean(1, keepdim=True)
            expected = expected - torch.einsum("njmj->j", covariance)[low:high] / n_sub
        if int((expected > 0).sum()) < 2:
            return None
        ratio = float((modes**2).sum() / len(z) / expected.sum())
        return min(max(ratio, _STRENGTH_RANGE[0]), _STRENGTH_RANGE[1])


MakesBasis = Callable[[], AberrationBasis | None]


def plain_basis(aperture: Aperture, n_modes: int) -> AberrationBasis:
    """Return the basis whose parameters are the Zernike coefficients themselves."""
    identity = torch.eye(aperture.n_subapertures * n_modes, dtype=aperture.centers.dtype, device="cpu")
    return AberrationBasis(identity, n_modes)


def turbulent_basis(
    aperture: Aperture, n_modes: int, common_modes: int, r0: float, outer_scale: float, *, whitened: bool = True
) -> AberrationBasis:
    """Return the basis for turbulence in each frame, with aberrations common to all frames.

    Each frame has `n_modes` modes of its own and `common_modes` (0 for none) that are common to all, whose prior is
    turbulence with an r0 of one sub-aperture diameter. `r0` and `outer_scale` are in m. If `whitened` is false the
    parameters are the coefficients.
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


def moving_basis(
    still: AberrationBasis, aperture: Aperture, exposure: float, r0: float, outer_scale: float
) -> AberrationBasis:
    """Return the basis `still` with a change of piston, tip and tilt of each hole during an exposure.

    `exposure` is in units of tau0 = 0.314 r0 / wind, `r0` and `outer_scale` are in m. The parameters of the change are
    white if frozen turbulence of these scales moves in a random direction.
    """
    n_modes = min(_MOVING_MODES, still.n_modes)
    change = whitening(aperture, n_modes, r0, outer_scale, drift=exposure * coherence_distance(r0))
    change = change.unflatten(0, (still.n_subapertures, n_modes))
    return still.in_motion(nn.functional.pad(change, (0, 0, 0, still.n_modes - n_modes)).flatten(0, 1))


def estimated_basis(aperture: Aperture, n_modes: int, covariance: Tensor) -> AberrationBasis:
    """Return the basis in which errors of coefficients with `covariance` (N J, N J) [rad^2] are white.

    Raises ValueError if the matrix has another shape or is not a covariance.
    """
    n_sub, size = aperture.n_subapertures, aperture.n_subapertures * n_modes
    if tuple(covariance.shape) != (size, size):
        raise ValueError(
            f"covariance has shape {tuple(covariance.shape)}: it must be ({size}, {size}), sub-aperture by "
            f"sub-aperture, of {n_sub} x {n_modes} coefficients"
        )
    return AberrationBasis(root(covariance.double()), n_modes)


def whitening(aperture: Aperture, n_modes: int, r0: float, outer_scale: float, drift: float | None = None) -> Tensor:
    """Return L (N J, K) with L L^T the von Karman covariance of all modes, less the piston common to all sub-apertures.

    Coefficients a = L z, sub-aperture by sub-aperture, follow von Karman statistics if z is white noise. The mean
    piston cannot be seen; without it K = N J - 1. r0 and outer_scale in m, L in rad. With a `drift` [m] it is the
    covariance of the change while turbulence moves so far. It is computed on the processor, so that the same noise is
    the same aberrations on every device.
    """
    covariance = modal_covariance(aperture.still().to("cpu"), n_modes, r0, outer_scale, drift)
    n_sub = aperture.n_subapertures
    common = torch.zeros(n_sub, n_modes, dtype=covariance.dtype, device=covariance.device)
    common[:, 0] = n_sub**-0.5
    remove = torch.diag(torch.ones_like(common.flatten())) - torch.outer(common.flatten(), common.flatten())
    values, vectors = torch.linalg.eigh(remove @ covariance @ remove)
    return (vectors[:, 1:] * values[1:].clamp(min=0).sqrt()).flip(1).to(aperture.centers.device)


def root(covariance: Tensor) -> Tensor:
    """Return the symmetric square root (K, K) [rad] of a covariance (K, K) [rad^2], with errors of at least 1 mrad.

    Raises ValueError if the covariance is not finite, not symmetric or has negative eigenvalues.
    """
    if not bool(torch.isfinite(covariance).all()):
        raise ValueError("covariance holds values that are not finite: replace them")
    largest = float(covariance.abs().max())
    if float((covariance - covariance.T).abs().max()) > _ROUNDING * largest:
        raise ValueError("covariance is not symmetric: average it with its transpose")
    values, vectors = torch.linalg.eigh(covariance)
    if float(values[0]) < -_ROUNDING * largest * len(values):
        raise ValueError(f"covariance has an eigenvalue of {float(values[0]):.3g} rad^2: none may be negative")
    return (vectors * values.clamp(min=_LEAST_ERROR**2).sqrt()) @ vectors.T
