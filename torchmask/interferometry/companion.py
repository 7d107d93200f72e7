"""Forward model of exposures of a star and a faint companion through a mask.

A companion is (contrast, east, north): its flux over that of the star, and its offset on the sky [rad]. Both have the
same colour. They are imaged through aberrations common to all exposures plus small ones of each, blurred by the pixel
and by charge diffusion, on a flat background. `fit_companion` estimates all of these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.metrics import shift_transfer
from torchmask.observation import Observation
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.psf import focal_intensity
from torchmask.optics.zernike import ZernikePhase

OWN_MODES = 3  # piston, tip and tilt of every hole, which differ between exposures
_FIELD = 3  # of the PSFs, in widths of an exposure, which sets the sampling of the holes: accurate to half a percent


@dataclass(frozen=True, eq=False)
class Exposures:
    """Exposures of one star, which is centred in each to a fraction of a pixel.

    frames : (T, H, W) electrons, finite in every pixel
    errors : (T, H, W) standard deviation of the noise [electrons], finite in every pixel
    valid : (T, H, W) bool, False for pixels to ignore
    to_pixels : (T, 2, 2) matrix from (east, north) [rad] to (y, x) [pixel]

    Raises ValueError if they disagree in shape or are not finite.

    Examples
    --------
    >>> east_is_left = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64) / 3e-7  # rad per pixel
    >>> frames = torch.rand(2, 32, 32, dtype=torch.float64)
    >>> exposures = Exposures(frames, frames.sqrt(), frames > 0.01, east_is_left.expand(2, -1, -1))
    >>> exposures[:1].frames.shape
    torch.Size([1, 32, 32])
    """

    frames: Tensor
    errors: Tensor
    valid: Tensor
    to_pixels: Tensor

    def __post_init__(self) -> None:
        shape = tuple(self.frames.shape)
        shapes = {"frames": shape[:1] + shape[-2:], "errors": shape, "valid": shape, "to_pixels": (*shape[:1], 2, 2)}
        for name, needed in shapes.items():
            values = getattr(self, name)
            if tuple(values.shape) != needed:
                raise ValueError(f"{name} has shape {tuple(values.shape)}: it must be {needed}, for frames (T, H, W)")
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"{name} holds values that are not finite: mark those pixels in `valid` and fill them")

    def __getitem__(self, chosen: Sequence[int] | slice) -> Exposures:
        index = chosen if isinstance(chosen, slice) else list(chosen)
        return Exposures(self.frames[index], self.errors[index], self.valid[index], self.to_pixels[index])

    @classmethod
    def from_observations(cls, observations: Sequence[Observation]) -> Exposures:
        """Return the frames of several observations of one star, each with its own direction of north.

        Raises ValueError if no observation is given, or one lacks errors or sky coordinates.
        """
        if not observations:
            raise ValueError("observations is empty: give at least one")
        parts = []
        for number, seen in enumerate(observations):
            matrix, errors = seen.sky_matrix, seen.errors
            if matrix is None:
                raise ValueError(f"observation {number} has no CD matrix in its header, which tells where north is")
            if errors is None:
                raise ValueError(f"observation {number} has no errors, such as an ERR extension gives")
            valid = torch.ones_like(seen.frames, dtype=torch.bool) if seen.valid is None else seen.valid
            to_pixels = torch.linalg.inv(matrix).flip(0).expand(len(seen.frames), 2, 2)  # (x, y) becomes (y, x)
            parts.append((seen.frames.double(), errors.double(), valid.expand(seen.frames.shape), to_pixels))
        return cls(*(torch.cat(values) for values in zip(*parts, strict=True)))


@dataclass(frozen=True, eq=False)
class Parameters:
    """Parameters of the model of exposures of a star and its companion.

    static : (N J,) coefficients of the aberrations common to all exposures [rad rms], hole by hole
    blur : (2,) variances of the charge diffusion along y and x [pixel^2]
    own : (T, 4 + 3 N) parameters of each exposure: flux [electrons], background [electrons per pixel], y and x of the
        star [pixel], and piston, tip and tilt of every hole in addition to `static` [rad rms]
    companion : (3,) contrast, east, north; a contrast of 0 if there is none

    Examples
    --------
    >>> alone = Parameters(torch.zeros(21), torch.full((2,), 0.1), torch.zeros(5, 13), torch.zeros(3))
    >>> len(alone.of_exposures(slice(0, None, 2)).own)
    3
    """

    static: Tensor
    blur: Tensor
    own: Tensor
    companion: Tensor

    def of_exposures(self, chosen: slice) -> Parameters:
        """Return the parameters of some of the exposures."""
        return replace(self, own=self.own[chosen])


class CompanionModel:
    """Model of images of a star and a companion through a mask.

    Parameters
    ----------
    aperture : Aperture
        One mask, with centres along the axes of the detector.
    grid : Grid
        Grid of the exposures; coefficients are in rad at its wavelength.
    n_modes : int
        Number J of Zernike modes of every hole in the aberrations common to all exposures, at least 3.
    band : Band
        Wavelengths of the light. Aberrations are path differences, the same at all of them.
    radius : float
        Radius around the middle of an exposure within which pixels are compared with the model [pixel].
    flux_error : float
        Relative error of the model: the variance of a pixel is that of its noise plus (flux_error x its flux)^2. It is
        measured with `fit_companion` on a single star and `unexplained_flux`.

    Raises
    ------
    ValueError
        If there are fewer than 3 modes, or the grid samples the aperture too coarsely.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> grid = Grid.nyquist(1.0, 550e-9, 32)
    >>> model = CompanionModel(mask, grid, n_modes=3, band=Band.of([550e-9]), radius=12.0)
    >>> place = torch.tensor([1e6, 0.0, 16.0, 16.0], dtype=torch.float64)  # flux, background, y, x
    >>> companion = torch.tensor([0.01, 0.0, 1e-6], dtype=torch.float64)  # 1 rad on the sky is 1e7 pixels
    >>> to_pixels = torch.tensor([[0.0, 1.0], [-1.0, 0.0]], dtype=torch.float64) / grid.pixel_scale
    >>> model.image(torch.zeros(9).double(), torch.zeros(2).double(), place, companion, to_pixels).shape
    torch.Size([32, 32])
    """

    grid: Grid
    radius: float
    flux_error: float
    n_subapertures: int
    n_modes: int

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        n_modes: int,
        band: Band,
        radius: float,
        flux_error: float = 0.01,
    ) -> None:
        if n_modes < OWN_MODES:
            raise ValueError(f"n_modes is {n_modes}: at least {OWN_MODES}, piston, tip and tilt, are needed")
        self.grid, self.radius, self.flux_error = grid, radius, flux_error
        self.n_subapertures, self.n_modes = aperture.n_subapertures, n_modes
        self._colours = []
        for wavelength, share in zip(band.wavelengths, band.shares, strict=True):
            coloured = replace(grid, wavelength=wavelength)
            samples, phase = aperture.samples(coloured, _FIELD), ZernikePhase(aperture, coloured, n_modes, _FIELD)
            self._colours.append((samples, phase, grid.wavelength / wavelength, share / samples.weights.square().sum()))
        self._field = (_FIELD * grid.shape[0], _FIELD * grid.shape[1])
        self._nu_y = torch.fft.fftfreq(self._field[0], dtype=torch.float64)[:, None]
        self._nu_x = torch.fft.rfftfreq(self._field[1], dtype=torch.float64)
        self._pixel = torch.sinc(self._nu_y) * torch.sinc(self._nu_x)
        y, x = torch.meshgrid(*(torch.arange(n).double() - n // 2 for n in grid.shape), indexing="ij")
        self.near: Tensor = torch.hypot(y, x) <= radius  # (H, W), the pixels that are compared

    def psf(self, aberrations: Tensor) -> Tensor:
        """Return the PSF (3 H, 3 W) for aberrations (N J) [rad rms], with the origin at [0, 0].

        Its unit is the light through the mask. It is not normalised to unit sum when aberrations scatter light out of
        the field: that would couple the star's flux to all of them, and Gauss-Newton steps would zigzag.
        """
        coefficients = aberrations.view(self.n_subapertures, self.n_modes)
        colours = [
            share * focal_intensity(samples, phase(ratio * coefficients))
            for samples, phase, ratio, share in self._colours
        ]
        return torch.stack(colours).sum(0)

    def image(self, aberrations: Tensor, blur: Tensor, place: Tensor, companion: Tensor, to_pixels: Tensor) -> Tensor:
        """Return one exposure (H, W) [electrons], differentiable in all parameters but `to_pixels`.

        Parameters
        ----------
        aberrations : (N J,) tensor
            Sum of static aberrations and those of the exposure [rad rms].
        blur : (2,) tensor
            Variances of the charge diffusion along y and x [pixel^2].
        place : (4,) tensor
            Flux [electrons], background [electrons per pixel], y and x of the star [pixel].
        companion : (3,) tensor
            Contrast, east and north [rad].
        to_pixels : (2, 2) tensor
            Matrix from (east, north) [rad] to (y, x) [pixel].
        """
        flux, background, y, x = place
        contrast, offset = companion[0], to_pixels @ companion[1:]
        spread = torch.exp(-2 * math.pi**2 * (blur[0] * self._nu_y**2 + blur[1] * self._nu_x**2))
        transfer = torch.fft.rfft2(self.psf(aberrations)) * (flux * spread * self._pixel)
        star, away = (shift_transfer(self._field, shift) for shift in (torch.stack([y, x]), offset))
        sky = star * (1 + contrast * away)
        return self._window(transfer * sky) + background

    def images(self, parameters: Parameters, to_pixels: Tensor) -> Tensor:
        """Return all exposures (T, H, W) [electrons] for their matrices `to_pixels` (T, 2, 2)."""
        static, blur, companion = parameters.static, parameters.blur, parameters.companion
        shots = zip(parameters.own, to_pixels, strict=True)
        return torch.stack([self.image(self.total(static, own), blur, own[:4], companion, sky) for own, sky in shots])

    def total(self, static: Tensor, own: Tensor) -> Tensor:
        """Return the total aberrations (N J) of one exposure with its own parameters `own` (4 + 3 N)."""
        extra = own[4:].view(self.n_subapertures, OWN_MODES)
        return static + torch.nn.functional.pad(extra, (0, self.n_modes - OWN_MODES)).flatten()

    def moved(self, image: Tensor, offsets: Tensor) -> Tensor:
        """Return an image (H, W), dark outside, shifted by each of `offsets` (M, 2) [pixel, (y, x)], as (M, H, W)."""
        return self._window(torch.fft.rfft2(image, s=self._field) * shift_transfer(self._field, offsets))

    def root_weights(self, exposures: Exposures) -> Tensor:
        """Return one over the rms error of each pixel (T, H, W), 0 for pixels that are not compared."""
        variance = exposures.errors**2 + (self.flux_error * exposures.frames.clamp(min=0)) ** 2
        return torch.where(exposures.valid & self.near, variance, torch.inf).rsqrt()

    def _window(self, transfer: Tensor) -> Tensor:
        rows, columns = self.grid.shape
        return torch.fft.irfft2(transfer, s=self._field)[..., :rows, :columns]
