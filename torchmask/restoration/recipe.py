"""What a model of the exposures is made from: the instrument and the aberrations it is assumed to have."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.restoration.aberrations import AberrationBasis, estimated_basis, moving_basis, turbulent_basis
from torchmask.restoration.forward import ExposureModel


@dataclass(frozen=True)
class ModelRecipe:
    """Aperture, grid and band of the exposures, and the prior on their aberrations.

    frame_modes, static_modes : Zernike modes per sub-aperture of each frame, and of what all frames have in common
    r0, outer_scale : of the turbulence [m]
    whitened : whether the parameters are white under the prior; False: they are the coefficients themselves
    pixel : the detector's; None: it samples the image
    exposure_tau0 : how long a frame lasts [tau0]; 0: frames are snapshots

    Raises
    ------
    ValueError
        For a population of apertures, and numbers that are out of range.
    """

    aperture: Aperture
    grid: Grid
    band: Band
    frame_modes: int
    static_modes: int
    r0: float
    outer_scale: float
    whitened: bool
    dtype: torch.dtype
    device: torch.device | str | None
    pixel: PixelResponse | None = None
    exposure_tau0: float = 0.0

    def __post_init__(self) -> None:
        shape = tuple(self.aperture.centers.shape)
        if len(shape) != 2:
            raise ValueError(f"centers has shape {shape}: one mask (n_subapertures, 2) is needed")
        for name, value in (("r0", self.r0), ("outer_scale", self.outer_scale)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive, in m")
        for name, count, least in (("n_modes", self.frame_modes, 1), ("static_modes", self.static_modes, 0)):
            if count < least:
                raise ValueError(f"{name} is {count}: it must be a whole number of at least {least}")
        self._check_exposure()

    def _check_exposure(self) -> None:
        if not (math.isfinite(self.exposure_tau0) and self.exposure_tau0 >= 0):
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0}: it must be finite and at least 0, in units of tau0"
            )
        if self.exposure_tau0 and not self.whitened:
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0} without aberration_prior: a change has no size then"
            )
        if self.exposure_tau0 and self.aperture.n_subapertures == 1:
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0}: only masks have motion in their model, leave it out"
            )

    @property
    def n_modes(self) -> int:
        """J, Zernike modes per sub-aperture of the coefficients."""
        return max(self.frame_modes, self.static_modes)

    @property
    def bluest_grid(self) -> Grid:
        """That of the shortest wavelength, whose cut-off is the highest."""
        return replace(self.grid, wavelength=self.band.shortest)

    def turbulent_model(self, *, follows_aperture: bool = False) -> ExposureModel:
        """The model with aberrations of turbulence, for the aperture where it lies now, or wherever it goes."""
        with torch.no_grad():
            basis = turbulent_basis(
                self.aperture, self.frame_modes, self.static_modes, self.r0, self.outer_scale, whitened=self.whitened
            )
        aperture = self.aperture if follows_aperture else self.aperture.still()
        return self._build(aperture, basis)

    def moving_basis(self, still: AberrationBasis) -> AberrationBasis | None:
        """The basis of aberrations that change during an exposure, beside those of `still`; None for snapshots."""
        if self.exposure_tau0 == 0:
            return None
        return moving_basis(still, self.aperture.still(), self.exposure_tau0, self.r0, self.outer_scale)

    def estimated_model(self, covariance: Tensor) -> ExposureModel:
        """The model whose parameters are errors of estimated coefficients, of `covariance` (N J, N J) [rad^2].

        Raises ValueError if the covariance has another shape or is not one, or there are static modes.
        """
        if self.static_modes:
            raise ValueError("covariance is given with static_modes: what is common to all frames is in the estimate")
        basis = estimated_basis(self.aperture, self.n_modes, covariance)
        return self._build(self.aperture.still(), basis)

    def _build(self, aperture: Aperture, basis: AberrationBasis) -> ExposureModel:
        options = {"pixel": self.pixel, "dtype": self.dtype, "device": self.device}
        return ExposureModel(aperture, self.grid, basis, self.band, **options)
