"""What not knowing the aberrations costs at least: the local Bayesian Cramer-Rao bound of the restored object."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.design.criterion import wiener_mse
from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.otf import OTF
from torchmask.optics.pupil import Aperture
from torchmask.optics.zernike import ZernikePhase
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.spectra import PSD, evaluate_psd

_AT_ONCE = 16  # derivatives of an OTF
_WIDE = 14  # samples of a sub-aperture: with twice as many the excess over known aberrations changes by at most 4 %
_EXACT = 1e-6  # of a tilt: what of it the modes may miss where they hold it


@dataclass(frozen=True)
class MyopicBound:
    """Mean squared errors of an object, relative to the mean of its PSD.

    known : of the Wiener estimate, which knows the aberrations of these frames
    unknown : the least that is possible with aberrations of which the statistics alone are known
    ratio : unknown over known

    Examples
    --------
    >>> MyopicBound(known=0.25, unknown=0.375).ratio
    1.5
    """

    known: float
    unknown: float

    @property
    def ratio(self) -> float:
        """Unknown over known, at least 1."""
        return self.unknown / self.known


@torch.no_grad()  # it returns numbers, also for power spectra that train
def myopic_bound(
    image: Tensor,
    aperture: Aperture,
    grid: Grid,
    object_psd: PSD,
    noise_psd: PSD,
    n_frames: int,
    n_modes: int = 6,
    *,
    r0: float,
    outer_scale: float = 20.0,
    oversampling: int | None = None,
    generator: torch.Generator | None = None,
) -> MyopicBound:
    """Bound the error of a blind restoration from below, at one object and one draw of the aberrations.

    Around the truth the frames are linear in object and aberrations. The information of the frames and that of the
    priors add; the aberrations are eliminated by Schur's complement over all frames (Van Trees & Bell, Bayesian
    Bounds, 2007, for the bound with random parameters; here it is taken at the truth, not averaged over it). What the
    object's place is, nobody can tell from the mean tilt of the frames: a shift of all frames counts as no error. The
    bound is local: it knows nothing of false minima far from the truth, and an estimate that is biased, as one with a
    positive object, may lie below it. It is computed in float64 on the device of the aperture.

    Parameters
    ----------
    image : (H, W) tensor
        The object in expected electrons per frame, on the pixels of `grid`; frames are its circular convolutions.
    aperture : Aperture
        One mask, or a full pupil.
    grid : Grid
        Pixels and wavelength of the frames.
    object_psd, noise_psd : callable or Tensor
        As for `AsymptoticMSE`. The prior of the object is Gaussian, stationary and of this PSD.
    n_frames : int
        Number of exposures, T.
    n_modes : int
        Zernike modes per sub-aperture, Noll 1 (piston) to this, drawn and to be found.
    r0, outer_scale : float
        Fried parameter, at the wavelength of the grid, and outer scale of the turbulence [m], the aberrations' prior.
    oversampling : int, optional
        Oversampling of the pupil. None: as much as makes a sub-aperture at least 14 samples wide. Where it is 4 samples
        wide, the excess over known aberrations is up to 30 % too small.
    generator : torch.Generator, optional
        Source of the random aberrations.

    Raises
    ------
    ValueError
        If the image does not have the grid's shape or is not finite, `n_frames` or `n_modes` is not a whole number of
        at least 1, a single opening has the piston alone, or a PSD cannot be one; that of the noise must be positive.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> grid, mask = Grid.nyquist(1.0, 550e-9, 16), SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.3, 1.0)
    >>> image = torch.zeros(16, 16, dtype=torch.float64); image[6:10, 7:9] = 1e4 / 8
    >>> psds = PowerLawPSD(1.5, 1e4, knee=1 / 4), NoisePSD(1e4)
    >>> bound = myopic_bound(image, mask, grid, *psds, 4, 3, r0=0.2, generator=torch.Generator().manual_seed(0))
    >>> 1 < bound.ratio < 1.5
    True
    """
    if tuple(image.shape) != grid.shape:
        raise ValueError(f"image has shape {tuple(image.shape)}: it must be that of the grid, {grid.shape}")
    if not bool(torch.isfinite(image).all()):
        raise ValueError("image holds values that are not finite: replace them")
    n_frames, n_modes = whole_number("n_frames", n_frames), whole_number("n_modes", n_modes)
    if aperture.is_full and n_modes == 1:
        raise ValueError(
            "n_modes is 1: the piston of a single opening does not show, so nothing would be unknown; take at least 3 "
            "for its tilts, or wiener_mse for known aberrations"
        )
    aperture = aperture.still().double()  # small differences of large sums: float32 would not do
    device = aperture.centers.device
    finer = _oversampling(aperture, grid) if oversampling is None else oversampling
    signal = evaluate_psd(object_psd, grid, "object_psd", torch.float64, device)
    noise = evaluate_psd(noise_psd, grid, "noise_psd", torch.float64, device)
    if not bool((noise > 0).all()):
        raise ValueError("noise_psd is 0 somewhere: it must be positive, or nothing would be uncertain there")
    basis = turbulent_basis(aperture, n_modes, 0, r0, outer_scale)
    z = torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, device="cpu", generator=generator).to(device)
    otfs, slopes = _otfs_and_slopes(aperture, grid, basis, z, finer)
    known = float(wiener_mse(otfs, signal, noise))
    own = 1 / ((otfs.abs() ** 2).sum(0) / noise + 1 / signal)  # of the object, known aberrations
    moved = slopes * torch.fft.fft2(image.to(signal))  # (T, K, H, W): what the frames' spectra change
    mixed = otfs.conj()[:, None] * moved / noise  # information that object and aberrations share
    half = _half_plane(grid).to(device)
    by_aberrations = _columns(moved / noise.sqrt(), half)
    information = torch.block_diag(*(part @ part.mT for part in by_aberrations))
    information.diagonal().add_(1)  # the prior of the whitened aberrations
    shared = _columns(mixed * own.sqrt(), half).flatten(0, 1)
    schur = information - shared @ shared.mT
    lost = _columns(mixed * own, half).flatten(0, 1)
    covariance = _without(torch.linalg.inv(schur), _common_tilts(aperture, grid, basis, n_frames, finer))
    more = float((covariance * (lost @ lost.mT)).sum()) / math.prod(grid.shape)
    scale = float(signal.mean())
    return MyopicBound(known / scale, (known + more) / scale)


def _oversampling(aperture: Aperture, grid: Grid) -> int:
    """Return the least oversampling that makes a sub-aperture `_WIDE` samples wide."""
    return math.ceil(_WIDE * grid.period / (min(grid.shape) * aperture.subaperture_diameter))


def _otfs_and_slopes(
    aperture: Aperture, grid: Grid, basis: AberrationBasis, z: Tensor, oversampling: int
) -> tuple[Tensor, Tensor]:
    """Return OTFs (T, H, W) at parameters (T, K), and their derivatives (T, K, H, W)."""
    otf, phase = OTF(aperture, grid, oversampling), ZernikePhase(aperture, grid, basis.n_modes, oversampling)

    def transfer(parameters: Tensor) -> Tensor:
        return otf(phase(basis.coefficients(parameters)))

    def slope(parameters: Tensor) -> Tensor:
        def along(direction: Tensor) -> Tensor:
            return torch.func.jvp(transfer, (parameters,), (direction,))[1]

        directions = torch.eye(len(parameters), dtype=parameters.dtype, device=parameters.device)
        return torch.func.vmap(along, chunk_size=_AT_ONCE)(directions)

    with torch.no_grad():
        return torch.stack([transfer(one) for one in z]), torch.stack([slope(one) for one in z])


def _half_plane(grid: Grid) -> Tensor:
    """Return the weights (H, W) of a half spectrum of real fields: 2, 1, or 0 for what repeats the other half."""
    rows, columns = grid.shape
    weights = torch.zeros(rows, columns, dtype=torch.float64, device="cpu")
    weights[:, : columns // 2 + 1] = 2.0
    weights[:, 0] = 1.0
    if columns % 2 == 0:
        weights[:, columns // 2] = 1.0
    return weights


def _columns(spectra: Tensor, weights: Tensor) -> Tensor:
    """Return spectra (..., H, W) of real fields as real vectors (..., L), whose products are those of the spectra."""
    chosen = weights > 0
    flat = spectra[..., chosen] * weights[chosen].sqrt()
    return torch.cat([flat.real, flat.imag], dim=-1)


def _common_tilts(aperture: Aperture, grid: Grid, basis: AberrationBasis, n_frames: int, oversampling: int) -> Tensor:
    """Return parameters (T K, 2) that tilt all frames alike, or (T K, 0) where the modes hold no tilt."""
    samples = aperture.samples(grid, oversampling)
    phase = ZernikePhase(aperture, grid, basis.n_modes, oversampling)
    lit = samples.weights > 0
    units = torch.eye(basis.n_parameters, dtype=torch.float64, device=samples.weights.device)
    modes = torch.stack([phase(basis.coefficients(unit))[lit] for unit in units], -1)
    modes = torch.cat([modes, torch.ones_like(modes[:, :1])], -1)  # and a piston of the whole pupil
    tilts = (aperture.centers[:, None] + samples.offsets)[lit].to(modes) / aperture.mask_diameter
    found = torch.linalg.lstsq(modes.cpu(), tilts.cpu(), driver="gelsd").solution.to(modes)  # CUDA has no such driver
    missed = (modes @ found - tilts).norm(dim=0) / tilts.norm(dim=0)
    return found[:-1].repeat(n_frames, 1)[:, missed < _EXACT]


def _without(covariance: Tensor, directions: Tensor) -> Tensor:
    """Return the covariance once the components along `directions` (n, m) are known."""
    if not directions.shape[1]:
        return covariance
    spread = covariance @ directions
    return covariance - spread @ torch.linalg.solve(directions.mT @ spread, spread.mT)
