"""The PSF of an exposure with finite duration, bandwidth and pixel size."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.observation import PHASE_OVERSAMPLING
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.pupil import Aperture, PupilSamples


class ExposedPSF:
    """PSF of an exposure, computed from the successive phases of its wavefront.

    Parameters
    ----------
    aperture : Aperture
        Aperture through which the exposure is taken.
    grid : Grid
        Pixels of the image, and the wavelength at which phases are given.
    band : Band, optional
        Wavelengths and their shares of the light; the wavelength of the grid by default.
    pixel : PixelResponse, optional
        Blur by the detector's pixels, which are points by default.

    Raises
    ------
    ValueError
        If the grid samples the image too coarsely at the shortest wavelength.

    Notes
    -----
    The pupil is sampled once, for the shortest wavelength. Phases scale as 1 / wavelength. The image at a longer
    wavelength is wider in proportion; because intensities are band-limited, their Fourier series resamples it onto the
    pixels exactly.

    Examples
    --------
    >>> from torchmask.optics.aperture import FullAperture
    >>> optics = ExposedPSF(FullAperture(1.0), Grid.nyquist(1.0, 550e-9, 16, 1.2), Band.top_hat(550e-9, 80e-9, 3))
    >>> optics([None]).shape
    torch.Size([64, 64])
    """

    def __init__(
        self, aperture: Aperture, grid: Grid, band: Band | None = None, pixel: PixelResponse | None = None
    ) -> None:
        band = Band.given(band, grid.wavelength)
        finest = Grid(grid.n_pixels, grid.pixel_scale, band.shortest)
        self.samples: PupilSamples = aperture.samples(finest, PHASE_OVERSAMPLING)
        self.shares: tuple[float, ...] = band.shares
        self.phase_factors: list[float] = [grid.wavelength / wavelength for wavelength in band.wavelengths]
        like = self.samples.weights
        self.wider: list[tuple[Tensor, Tensor] | None] = [
            None if wavelength == band.shortest else _widen(self.samples.raster, wavelength / band.shortest, like)
            for wavelength in band.wavelengths
        ]
        self.blur: Tensor | None = None if pixel is None else _transfer(pixel, self.samples.raster, like)

    def __call__(self, phases: Iterable[Tensor | None]) -> Tensor:
        """Return the mean PSF (rows, columns) over `phases` (N, P) [rad], on the raster of `samples`, origin at [0, 0].

        A phase of None is a perfect wavefront. At the shortest wavelength the PSF has unit sum; at longer ones the
        light that falls outside the raster is missing.
        """
        count, images = 0, [torch.zeros(()) for _ in self.shares]
        for count, phase in enumerate(phases, 1):
            for k, factor in enumerate(self.phase_factors):
                scaled = phase if phase is None or factor == 1 else factor * phase
                one = psf_from_samples(self.samples, scaled)
                images[k] = one if count == 1 else images[k] + one
        total = None
        for image, share, wider in zip(images, self.shares, self.wider, strict=True):
            image = image if count == 1 else image / count
            image = image if wider is None else wider[0] @ image @ wider[1].T
            image = image if share == 1 else share * image
            total = image if total is None else total + image
        assert total is not None
        return total if self.blur is None else torch.fft.ifft2(torch.fft.fft2(total) * self.blur).real


def _widen(raster: tuple[int, int], factor: float, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return matrices for rows and columns that widen an image by `factor` >= 1 around [0, 0] of a periodic raster.

    They evaluate the Fourier series of the image, whose number of samples is even, and conserve the light that stays on
    the raster.
    """
    matrices = []
    for size in raster:
        place = torch.fft.fftfreq(size, 1 / size, dtype=torch.float64, device="cpu")
        x = place[:, None] / factor - place
        kernel = torch.sin(math.pi * x) / torch.tan(math.pi * x / size) / size
        matrices.append((torch.where(x == 0, 1.0, kernel) / factor).to(like))
    return matrices[0], matrices[1]


def _transfer(pixel: PixelResponse, raster: tuple[int, int], like: Tensor) -> Tensor:
    nu_y, nu_x = (torch.fft.fftfreq(size, dtype=like.dtype, device=like.device) for size in raster)
    return pixel.transfer(nu_y[:, None], nu_x[None])
