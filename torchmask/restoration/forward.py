"""The image formation that a restoration inverts: object and aberrations in, frames out.

It is composed of parts, each an object of its own: the sampled pupil with its aberrations and its band, and the window
through which the frames see a wider object.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.restoration.aberrations import AberrationBasis, plain_basis
from torchmask.restoration.background import Background
from torchmask.restoration.pupil import OpenSamples, SampledPupil

MARGIN = 0.25  # of the frames' width, by which the object's field is wider at least
_CHUNK = 2**20  # bytes of one complex work array: it stays in a core's cache


@dataclass(frozen=True)
class Window:
    """The pixels of the frames within the wider field of the object.

    Light may come from beyond the frames and leave them; only their own pixels are compared.

    Examples
    --------
    >>> window = Window.around(Grid.nyquist(1.0, 550e-9, 128))
    >>> window.field.shape
    (160, 160)
    """

    grid: Grid
    field: Grid

    @classmethod
    def around(cls, grid: Grid, margin: float = MARGIN) -> Window:
        """The window of frames on `grid` in a field at least (1 + margin) times as wide, of fast FFTs."""
        rows, columns = (fast_size(math.ceil(side * (1 + margin))) for side in grid.shape)
        return cls(grid, Grid((rows, columns), grid.pixel_scale, grid.wavelength))

    def crop(self, image: Tensor) -> Tensor:
        """The frames' pixels (..., H, W) of images (..., H', W')."""
        return image[..., : self.grid.shape[0], : self.grid.shape[1]]

    def embed(self, image: Tensor) -> Tensor:
        """Images (..., H', W') that hold `image` (..., H, W), and zero in the margin."""
        rows, columns = self.field.shape
        return nn.functional.pad(image, (0, columns - image.shape[-1], 0, rows - image.shape[-2]))


class ExposureModel(nn.Module):
    """Frames y_t = window(p * h_t * o), p the pixel, h_t = sum_w share_w |FFT(P_w exp(i B_w z_t))|^2 with unit sum.

    Parameters
    ----------
    aperture : Aperture
        One aperture, centres (N, 2). Its samples are followed where it moves, and differentiable in its centres.
    grid : Grid
        Of the frames, H x W.
    aberrations : AberrationBasis or int
        What the parameters z stand for; a number J: the Noll modes 1 to J of every sub-aperture themselves.
    band : Band, optional
        None: the wavelength of the grid. Aberrations are path differences: coefficients are rad at that wavelength.
    margin : float
        The object's field is at least (1 + margin) times as wide as the frames.
    background : Background
        What frames may hold besides; `forward` makes them without.
    pixel : PixelResponse, optional
        Of the detector. None: pixels sample the image at their centres.

    Raises
    ------
    ValueError
        If the shortest wavelength undersamples the image, or a sub-aperture is narrower than two samples.

    Notes
    -----
    `forward(object, z)` takes an object (H', W') on `window.field` and z (T, K), and returns frames (T, H, W),
    differentiable by autograd in both and in the centres of the aperture. `restoration.adjoint` holds gradients of the
    misfit that cost less.

    The attenuation of the image by the cells of the pupil samples, which `PSF` divides out, is left in: on a field of
    this size it stands in for the light that leaves the field, and fits end-to-end simulations better.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
    >>> model = ExposureModel(mask, Grid.nyquist(1.0, 550e-9, 32), 3)
    >>> image = torch.rand(model.window.field.shape, dtype=torch.float64)
    >>> model(image, torch.zeros(5, model.aberrations.n_parameters, dtype=torch.float64)).shape
    torch.Size([5, 32, 32])
    """

    response: Tensor | None

    def __init__(
        self,
        aperture: Aperture,
        grid: Grid,
        aberrations: AberrationBasis | int,
        band: Band | None = None,
        margin: float = MARGIN,
        background: Background = Background.NONE,
        pixel: PixelResponse | None = None,
        *,
        dtype: torch.dtype | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        super().__init__()
        basis = plain_basis(aperture, aberrations) if isinstance(aberrations, int) else aberrations
        band = band or Band.of([grid.wavelength])
        basis = copy.deepcopy(basis).to(device=device)
        self.window: Window = Window.around(grid, margin)
        self.background: Background = background
        response = None if pixel is None else _half_plane(pixel, self.window.field).to(device)
        self.register_buffer("response", response, persistent=False)
        self.pupil: SampledPupil = SampledPupil(aperture, self.window.field, band, basis, dtype=dtype, device=device)

    @property
    def aberrations(self) -> AberrationBasis:
        """What the parameters z stand for."""
        return self.pupil.aberrations

    @property
    def band(self) -> Band:
        """The wavelengths of the model."""
        return self.pupil.band

    @property
    def dtype(self) -> torch.dtype:
        """In which frames are made."""
        return self.pupil.basis.dtype

    @property
    def device(self) -> torch.device:
        """On which frames are made."""
        return self.pupil.basis.device

    def single(self) -> ExposureModel:
        """The same model with its arrays in float32, on the very same aberration basis."""
        twin = copy.deepcopy(self).float()
        twin.pupil.aberrations = self.aberrations
        return twin

    @property
    def cutoff(self) -> float:
        """Highest frequency that the frames can tell of an object [cycles/pixel]."""
        return min(0.5, self.window.grid.cutoff(self.pupil.aperture.extent))

    def beside(self, background: Background) -> ExposureModel:
        """The same model, arrays and all, of frames that may hold such a background."""
        twin = copy.copy(self)
        twin.background = background
        return twin

    def chunks(self, n_frames: int) -> Iterator[slice]:
        """Slices of the frames whose work arrays stay small."""
        pixels = self.pupil.n_rasters * math.prod(self.window.field.shape)
        size = max(1, _CHUNK // (2 * self.dtype.itemsize * pixels))
        return (slice(start, min(start + size, n_frames)) for start in range(0, n_frames, size))

    def amplitude(self, samples: OpenSamples, field: Tensor) -> Tensor:
        """Focal amplitude (T, wavelength, H', W') of a pupil field (T, P)."""
        rasters = (self.pupil.n_rasters, *self.window.field.shape)
        pupil = field.new_zeros(len(field), math.prod(rasters)).index_add(1, samples.index, field)
        return torch.fft.fft2(pupil.unflatten(1, rasters))

    def spectrum(self, image: Tensor) -> Tensor:
        """Fourier transform (..., H', W'/2 + 1) of objects (..., H', W'), as the detector's pixels see it."""
        spectrum = torch.fft.rfft2(image.to(self.dtype))
        return spectrum if self.response is None else spectrum * self.response.to(spectrum)

    def spectrum_adjoint(self, spectrum: Tensor) -> Tensor:
        """The adjoint of `spectrum`, up to the normalisation of the FFT: what pulls back to objects (..., H', W')."""
        if self.response is not None:
            spectrum = spectrum * self.response.conj().to(spectrum)
        return torch.fft.irfft2(spectrum, s=self.window.field.shape)

    def through(self, aperture: Aperture, aberrations: AberrationBasis | None = None) -> ExposureModel:
        """The same model through another aperture of as many sub-apertures, or with other aberrations."""
        twin = copy.deepcopy(self)
        kwargs = {"dtype": self.dtype, "device": self.device}
        twin.pupil = SampledPupil(aperture, self.window.field, self.band, aberrations or self.aberrations, **kwargs)
        return twin

    def psf(self, z: Tensor, samples: OpenSamples | None = None) -> Tensor:
        """PSFs (T, H', W') of the optics, of unit sum, origin at [0, 0], for z (T, K).

        `samples` are those of a pupil that lies elsewhere; None: where the model has it.
        """
        samples = samples or self.pupil.samples()
        return intensity(self.amplitude(samples, samples.field(samples.phase(z))))

    def forward(self, image: Tensor, z: Tensor, samples: OpenSamples | None = None) -> Tensor:
        transfer = torch.fft.rfft2(self.psf(z, samples))
        return self.window.crop(torch.fft.irfft2(transfer * self.spectrum(image), s=self.window.field.shape))


def intensity(amplitude: Tensor) -> Tensor:
    """(T, H', W') of amplitudes (T, wavelength, H', W')."""
    power = amplitude.real**2 + amplitude.imag**2
    return power[:, 0] if power.shape[1] == 1 else power.sum(1)


def _half_plane(pixel: PixelResponse, field: Grid) -> Tensor:
    """The transfer function (H', W'/2 + 1) of pixels on the frequencies of a real FFT."""
    rows, columns = field.shape
    like = {"dtype": torch.float64, "device": "cpu"}
    nu_y, nu_x = torch.fft.fftfreq(rows, **like), torch.fft.rfftfreq(columns, **like)
    return pixel.transfer(nu_y[:, None], nu_x[None])


def fast_size(n: int) -> int:
    """The least even number of at least `n` without prime factors beyond 5: a fast FFT.

    >>> fast_size(128), fast_size(154)
    (128, 160)
    """
    while True:
        rest = n
        for prime in (2, 3, 5):
            while rest % prime == 0:
                rest //= prime
        if rest == 1 and n % 2 == 0:
            return n
        n += 1
