"""The recipe for a model of the exposures: the instrument and its assumed aberrations."""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse, require_response
from torchmask.optics.pupil import sample_holes
from torchmask.restoration.aberrations import (
    AberrationBasis,
    MakesBasis,
    estimated_basis,
    moving_basis,
    turbulent_basis,
)
from torchmask.restoration.forward import MARGIN, ExposureModel, Window

FULL_MODES = 231  # of a full pupil, as far as nobody says
MASK_MODES = 6  # of each sub-aperture of a mask, in a search; more of them have lost objects


@dataclass(frozen=True)
class ModelRecipe:
    """Aperture, grid and band of the exposures, and the prior on their aberrations.

    aperture : one aperture, centres (N, 2)
    grid : grid of the frames
    band : wavelengths of the light
    frame_modes : number of Zernike modes per sub-aperture of each frame
    static_modes : number of Zernike modes per sub-aperture that are common to all frames
    r0 : Fried parameter of the turbulence [m]
    outer_scale : outer scale of the turbulence [m]
    whitened : whether the parameters are white under the prior; False: they are the coefficients themselves
    dtype : data type of the model
    device : device of the model
    pixel : response of the detector's pixels; None: they sample the image at their centres
    exposure_tau0 : exposure time of a frame [tau0]; 0: frames are snapshots
    last_modes : number of Zernike modes per sub-aperture of each frame after the search, if it is larger
    margin : the object's field is at least (1 + margin) times as wide as the frames

    Raises
    ------
    ValueError
        If several apertures are given, a number is out of range, the grid samples the aperture too coarsely, there are
        more modes than samples or pixels tell apart, or the data type is of half precision.
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
    last_modes: int = 0
    margin: float = MARGIN

    def __post_init__(self) -> None:
        shape = tuple(self.aperture.centers.shape)
        if len(shape) != 2:
            raise ValueError(f"centers has shape {shape}: one mask (n_subapertures, 2) is needed")
        if self.dtype not in (torch.float32, torch.float64):  # FFTs know no half, in which frames would overflow
            raise ValueError(f"dtype is {self.dtype!r}: take torch.float32 or torch.float64")
        require_response(self.pixel)
        for name, value in (("r0", self.r0), ("outer_scale", self.outer_scale)):
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive, in m")
        for field, name, least in (("frame_modes", "n_modes", 1), ("static_modes", "static_modes", 0)):
            object.__setattr__(self, field, whole_number(name, getattr(self, field), least))
        if self.whitened and self.n_modes * self.aperture.n_subapertures == 1:
            raise ValueError(
                "n_modes is 1: the piston of a single opening does not show, take at least 3 for its tilts"
            )
        self._check_exposure()
        self.aperture.require_sampling(self.bluest_grid)
        self._check_modes()

    def _check_modes(self) -> None:
        aperture, field = self.aperture, Window.around(self.grid, self.margin).field
        if self.whitened and not aperture.is_full:
            samples = sample_holes(aperture.centers.detach(), aperture.shape, aperture.subaperture_diameter, field)
            most = int((samples.weights > 0).sum(-1).max())
            where = f"a hole has {most} pupil samples"
        else:  # the modes of one opening are quick to make, and those without a prior may be known
            most = max(FULL_MODES, math.prod(self.grid.shape) // aperture.n_subapertures)
            where = f"a frame has {math.prod(self.grid.shape)} pixels"
        for name, count in (("n_modes", self.frame_modes), ("static_modes", self.static_modes)):
            if count > most:
                raise ValueError(
                    f"{name} is {count}: {where}, on which no more modes can be told apart, so take at most {most}, or "
                    "a wider image"
                )

    def _check_exposure(self) -> None:
        if not (math.isfinite(self.exposure_tau0) and self.exposure_tau0 >= 0):
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0}: it must be finite and at least 0, in units of tau0"
            )
        if self.exposure_tau0 and not self.whitened:
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0} without aberration_prior: the prior says how large changes are"
            )
        if self.exposure_tau0 and self.aperture.n_subapertures == 1:
            raise ValueError(
                f"exposure_tau0 is {self.exposure_tau0}: the model has motion for masks only, leave it out"
            )

    @property
    def n_modes(self) -> int:
        """Number J of Zernike modes per sub-aperture of the coefficients."""
        return max(self.frame_modes, self.static_modes)

    @property
    def bluest_grid(self) -> Grid:
        """Grid at the shortest wavelength, which has the highest cut-off."""
        return replace(self.grid, wavelength=self.band.shortest)

    def for_frames(self, *, in_steps: bool, faint: bool, fills_field: bool) -> ModelRecipe:
        """Return the recipe for frames of this kind, which differs from this one for a mask.

        Where modes may enter `in_steps`, a search has at most six of each sub-aperture, as more of them lead astray:
        they bend to noise. Those that are asked for beyond enter after it; those that nobody asks for do so unless the
        frames are faint. Around an object that fills the field there is a margin from which a hole brings light in.
        """
        if self.aperture.n_subapertures == 1:
            return self
        first = min(self.frame_modes, MASK_MODES) if in_steps and self.whitened else self.frame_modes
        last = self.frame_modes if faint else max(self.frame_modes, self.last_modes)
        margin = self._wide_margin() if fills_field else self.margin
        return replace(self, frame_modes=first, last_modes=last, margin=margin)

    def _wide_margin(self) -> float:
        """Return the margin that holds what a hole spreads, lambda / d on either side, at most the width of frames."""
        spread = max(self.band.wavelengths) / (self.aperture.subaperture_diameter * self.grid.pixel_scale)
        return min(max(MARGIN, 2 * spread / min(self.grid.shape)), 1.0)

    def turbulent_model(self, *, follows_aperture: bool = False) -> ExposureModel:
        """Return the model with aberrations by turbulence.

        It keeps the present centres of the aperture, or with `follows_aperture` uses those at each evaluation.
        """
        with torch.no_grad():
            basis = turbulent_basis(
                self.aperture, self.frame_modes, self.static_modes, self.r0, self.outer_scale, whitened=self.whitened
            )
        aperture = self.aperture if follows_aperture else self.aperture.still()
        return self._build(aperture, basis)

    def later_bases(self, still: AberrationBasis, *, blind: bool) -> tuple[AberrationBasis | None, MakesBasis | None]:
        """Return the moving basis that follows upon `still`, and what makes the finer one of a blind restoration.

        The latter takes seconds for tens of holes, and is made once, when it is needed.
        """
        return self.moving_basis(still), functools.cache(self.finer_basis) if blind else None

    def moving_basis(self, still: AberrationBasis) -> AberrationBasis | None:
        """Return the basis `still` extended by changes during an exposure; None for snapshots."""
        if self.exposure_tau0 == 0:
            return None
        return moving_basis(still, self.aperture.still(), self.exposure_tau0, self.r0, self.outer_scale)

    def finer_basis(self) -> AberrationBasis | None:
        """Return the basis of what follows the search, with changes during an exposure; None without more modes."""
        if self.last_modes <= self.frame_modes or not self.whitened:
            return None
        with torch.no_grad():
            finer = turbulent_basis(self.aperture, self.last_modes, self.static_modes, self.r0, self.outer_scale)
        return self.moving_basis(finer) or finer

    def estimated_model(self, covariance: Tensor) -> ExposureModel:
        """Return the model whose parameters are errors of estimated coefficients, with `covariance` (N J, N J) [rad^2].

        Raises ValueError if the matrix has another shape or is not a covariance, or if there are static modes.
        """
        if self.static_modes:
            raise ValueError("covariance is given with static_modes: the estimate includes static aberrations already")
        basis = estimated_basis(self.aperture, self.n_modes, covariance)
        return self._build(self.aperture.still(), basis)

    def _build(self, aperture: Aperture, basis: AberrationBasis) -> ExposureModel:
        options = {"pixel": self.pixel, "margin": self.margin, "dtype": self.dtype, "device": self.device}
        return ExposureModel(aperture, self.grid, basis, self.band, **options)
