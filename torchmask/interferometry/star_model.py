"""Images of a star through a mask with an affine map of its geometry, with all derivatives in closed form.

The focal amplitude is the sum of the holes' diffraction integrals, by a quadrature over each hole. The affine map of
the pupil is in its exponent, so that holes are rotated and stretched too.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.phasor import phasor
from torchmask.optics.pixel import PixelResponse
from torchmask.optics.zernike import aperture_modes, noll

PLACE = 2  # number of parameters of a frame before its aberrations: logarithm of the light, and background
MAP = 4  # number of elements of the affine map, the first of the shared parameters
_TERMS = 12  # of the series of a pixel's blur, which leave less than 1e-16 at the Nyquist frequency
_SPARE_DEGREE = 10  # of the quadrature, beyond the largest phase: the error falls faster than exponentially


@dataclass(frozen=True, eq=False)
class Shared:
    """Parameters shared by all frames of a star.

    matrix : (2, 2) affine map from the given to the actual geometry of the mask
    log_transmission : (N,) logarithm of the light through each hole relative to the mean
    fill : () sensitive fraction of the area of square pixels, None if it is not a parameter
    """

    matrix: Tensor
    log_transmission: Tensor
    fill: Tensor | None = None

    def moved(self, step: Tensor) -> Shared:
        """Return the parameters after a step (4 + N,), or (5 + N,) with that of the pixels last."""
        end = MAP + len(self.log_transmission)
        fill = None if self.fill is None else self.fill + step[end]
        return Shared(self.matrix + step[:MAP].view(2, 2), self.log_transmission + step[MAP:end], fill)


class StarModel:
    """Model of images of a star near the middle of a square of pixels, from own and shared parameters.

    Parameters
    ----------
    aperture : SparseAperture
        Mask with its given geometry.
    grid : Grid
        Grid of the frames; coefficients are in rad at its wavelength.
    reach : int
        Half-width of the square, which has 2 reach + 1 pixels to a side.
    n_modes : int
        Number J of Zernike modes of every hole, at least 3.
    pixel : PixelResponse, optional
        Known blur by the detector's pixels. None: they are points, unless the shared parameters include their blur.

    Notes
    -----
    The parameters of a frame (2 + N J,) are the logarithm of its light at zero frequency [electrons per pixel], the
    background [electrons per pixel], and Zernike coefficients [rad rms] hole by hole. The affine map deforms the whole
    pupil, with the holes and the modes on them.
    """

    def __init__(
        self, aperture: SparseAperture, grid: Grid, reach: int, n_modes: int, pixel: PixelResponse | None = None
    ) -> None:
        grid.require_sampling(aperture.outer_diameter)  # else the images of single holes are aliased
        self.side: int = 2 * reach + 1
        most = self.side**2 // aperture.n_subapertures
        if n_modes > most:
            raise ValueError(
                f"n_modes is {n_modes}: a frame has {self.side**2} pixels around the star, fewer than unknowns of "
                f"{aperture.n_subapertures} holes, so take at most {most}, or a wider image"
            )
        self.n_modes: int = n_modes
        self.centers: Tensor = aperture.centers.detach().double().cpu()
        y, x = torch.meshgrid(*2 * [torch.arange(-reach, reach + 1, dtype=torch.float64)], indexing="ij")
        self.pixels: Tensor = torch.stack([x.flatten(), y.flatten()], -1)
        self._wave: float = 2 * math.pi / grid.period  # phase per pixel and metre
        turns = self._wave * math.sqrt(2) * reach * aperture.outer_diameter / 2
        degree = math.ceil(turns) + _SPARE_DEGREE + 2 * noll(n_modes)[0]
        self._points, self._weights = aperture.shape.quadrature(degree, aperture.subaperture_diameter)
        self._modes: Tensor = aperture_modes(aperture, self._points, n_modes)
        self._transfer: Tensor | None = None
        if pixel is not None:
            self._transfer = pixel.transfer(*self._frequencies())

    @property
    def n_holes(self) -> int:
        """Number N of holes."""
        return len(self.centers)

    def kernels(self, matrix: Tensor) -> tuple[Tensor, Tensor]:
        """Return exp(-i k x . A r) for the points of a hole (pixels, Q), and for the centres (pixels, N)."""
        directions = self._wave * self.pixels @ matrix
        return phasor(-directions @ self._points.T), phasor(-directions @ self.centers.T)

    def image(self, own: Tensor, shared: Shared, kernels: tuple[Tensor, Tensor]) -> Tensor:
        """Return the image of one frame (pixels,) [electrons]."""
        amplitude = (self._holes(own, shared) @ kernels[0].T).T * kernels[1]
        blur = self._blur(shared)
        return self._seen(own[0].exp() * amplitude.sum(1).abs() ** 2, blur) + own[1]

    def linearise(self, own: Tensor, shared: Shared, kernels: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """Return the image (pixels,) and its derivatives in own (pixels, 2 + N J) and shared (pixels, S) parameters."""
        hole, carrier = kernels
        pupil = self._holes(own, shared)  # (N, Q)
        columns = torch.cat([self._modes, self._points], 1).to(pupil)  # (Q, J + 2)
        parts = hole @ (pupil[..., None] * columns).permute(1, 0, 2).flatten(1)  # (pixels, N (J + 2))
        parts = parts.unflatten(1, (self.n_holes, -1)) * carrier[..., None]
        single, weighted = parts[..., 0], parts[..., self.n_modes :]  # of Noll mode 1, which is 1, and of x and y
        total = single.sum(1)
        light = own[0].exp()
        factor = 2 * light * total.conj()[:, None]
        by_modes = -(factor[..., None] * parts[..., : self.n_modes]).imag.flatten(1)
        by_transmission = (factor * single).real / 2
        radius = (weighted + single[..., None] * self.centers).sum(1)  # sum of amplitudes times their r, (pixels, 2)
        slope = (factor * radius).imag * self._wave  # derivative in the phase k x . A r, along r
        by_map = (self.pixels[:, :, None] * slope[:, None, :]).flatten(1)
        intensity = light * total.abs() ** 2
        blur = self._blur(shared)
        image = self._seen(intensity, blur)
        ones = torch.ones_like(image)
        by_own = torch.cat([image[:, None], ones[:, None], self._seen(by_modes, blur)], 1)
        by_shared = self._seen(torch.cat([by_map, by_transmission], 1), blur)
        if shared.fill is not None:
            slope = square_blur(shared.fill, *self._frequencies())[1]
            by_shared = torch.cat([by_shared, self._seen(intensity, slope)[:, None]], 1)
        return image + own[1], by_own, by_shared

    def offset_slopes(self, shared: Shared) -> Tensor:
        """Return the image's shift (x, y) [pixel] per unit of each own parameter (2 + N J, 2): mean tilt of the holes.

        A phase k s . A r shifts the image by s; the slope of a mode along r is its least-squares fit over a hole.
        """
        centred = self._points - self._weights @ self._points
        inertia = (centred.T * self._weights) @ centred
        slopes = torch.linalg.solve(inertia, (centred.T * self._weights) @ self._modes)  # (2, J) [rad / m]
        moves = torch.linalg.solve(shared.matrix.T, slopes) / (self._wave * self.n_holes)
        return torch.cat([moves.new_zeros(PLACE, 2), moves.T.repeat(self.n_holes, 1)])

    def _holes(self, own: Tensor, shared: Shared) -> Tensor:
        """Return the field (N, Q) on the points of every hole, of unit sum without aberrations."""
        phase = own[PLACE:].view(self.n_holes, self.n_modes) @ self._modes.T
        return (0.5 * shared.log_transmission).exp()[:, None] * self._weights * phasor(phase)

    def _frequencies(self) -> tuple[Tensor, Tensor]:
        """Return the frequencies nu_y (side, 1) and nu_x (1, side // 2 + 1) of the square [cycles/pixel]."""
        nu_y, nu_x = torch.fft.fftfreq(self.side).double(), torch.fft.rfftfreq(self.side).double()
        return nu_y[:, None], nu_x[None]

    def _blur(self, shared: Shared) -> Tensor | None:
        """Return the transfer function of the pixels, known or a parameter, or None if they are points."""
        return self._transfer if shared.fill is None else square_blur(shared.fill, *self._frequencies())[0]

    def _seen(self, images: Tensor, transfer: Tensor | None) -> Tensor:
        """Multiply the transforms of images (pixels, ...) by a function of frequency."""
        if transfer is None:
            return images
        spectrum = torch.fft.rfft2(images.view(self.side, self.side, -1), dim=(0, 1)) * transfer[..., None]
        return torch.fft.irfft2(spectrum, s=2 * [self.side], dim=(0, 1)).view_as(images)


def square_blur(fill: Tensor, nu_y: Tensor, nu_x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the transfer function of square pixels of a fill factor, as `SquarePixel`, and its slope in that factor.

    It is a power series in the fill factor and continues below 0, where a fit to pixels that are points may wander.
    """
    y, x = (torch.stack(_sinc_of_square(fill * nu**2)) for nu in (nu_y, nu_x))
    return y[0] * x[0], y[1] * nu_y**2 * x[0] + y[0] * x[1] * nu_x**2


def _sinc_of_square(square: Tensor) -> tuple[Tensor, Tensor]:
    """Return sinc(s^(1/2)) and its slope in s, by the series of sin(x) / x, for s of at most 1."""
    value, slope, term = torch.zeros_like(square), torch.zeros_like(square), 1.0
    for k in range(_TERMS):
        value = value + term * square**k
        slope = slope + (k * term * square ** (k - 1) if k else 0.0)
        term *= -(math.pi**2) / ((2 * k + 2) * (2 * k + 3))
    return value, slope
