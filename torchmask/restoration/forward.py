"""The forward model of a restoration: frames from an object and aberrations.

It is composed of the sampled pupil, with its aberrations and its band, and of the window of the frames within the wider
field of the object.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.aperture import Aperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse
from torchmask.restoration.aberrations import AberrationBasis, plain_basis
from torchmask.restoration.background import Background
from torchmask.restoration.pupil import OpenSamples, SampledPupil

MARGIN = 0.25  # minimum by which the object's field is wider, as a fraction of the frames' width
_CHUNK = AtATime(processor=2**20, gpu=2**28)  # bytes of one complex work array


@dataclass(frozen=True)
class Window:
    """The pixels of the frames within the wider field of the object.

    Light may enter the frames from outside and leave them; only the pixels of the frames are compared.

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
        """Return the window of frames on `grid` in a field at least (1 + margin) times as wide, with fast FFTs."""
        rows, columns = (fast_size(math.ceil(side * (1 + margin))) for side in grid.shape)
        return cls(grid, Grid((rows, columns), grid.pixel_scale, grid.wavelength))

    def crop(self, image: Tensor) -> Tensor:
        """Return the frames' pixels (..., H, W) of images (..., H', W')."""
        return image[..., : self.grid.shape[0], : self.grid.shape[1]]

    def embed(self, image: Tensor, outside: float = 0.0) -> Tensor:
        """Pad images (..., H, W) to (..., H', W') with a margin that has the brightness `outside`."""
        rows, columns = self.field.shape
        return nn.functional.pad(image, (0, columns - image.shape[-1], 0, rows - image.shape[-2]), value=outside)


class ExposureModel(nn.Module):
    """Forward model of the exposures, y_t = window(p * h_t * o).

    p is the response of a pixel and h_t = sum_w share_w |FFT(P_w exp(i B_w z_t))|^2 the PSF, of unit sum.

    Parameters
    ----------
    aperture : Aperture
        One aperture, centres (N, 2). If its centres change, so do the samples, which are differentiable in them.
    grid : Grid
        Grid of the frames, H x W.
    aberrations : AberrationBasis or int
        Basis of the aberrations with parameters z, or a number J: the Noll modes 1 to J of every sub-aperture.
    band : Band, optional
        Wavelengths of the light. None: that of the grid. Aberrations are path differences, and coefficients are in rad
        at the wavelength of the grid.
    margin : float
        The object's field is at least (1 + margin) times as wide as the frames.
    background : Background
        Background that frames may have; `forward` does not include it.
    pixel : PixelResponse, optional
        Response of the detector's pixels. None: pixels sample the image at their centres.

    Raises
    ------
    ValueError
        If the shortest wavelength undersamples the image, a sub-aperture is narrower than two samples, or `background`
        is `Background.IF_SEEN`, which only frames decide.

    Notes
    -----
    `forward(object, z)` takes an object (H', W') on `window.field` and z (T, K), and returns frames (T, H, W),
    differentiable by autograd in both and in the centres of the aperture. `restoration.adjoint` computes the gradients
    of the misfit at less cost.

    Unlike `PSF`, the model keeps the attenuation of the image by the finite cells of the pupil samples: on a field of
    this size it represents the light that leaves the field, and fits end-to-end simulations better.

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

    @torch.inference_mode(False)  # it may train later, whatever mode it is made in
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
        band = Band.given(band, grid.wavelength)
        basis = copy.deepcopy(basis).to(device=device)
        self.window: Window = Window.around(grid, margin)
        self.background: Background = _of_a_model(background)
        response = None if pixel is None else _half_plane(pixel, self.window.field).to(device)
        self.register_buffer("response", response, persistent=False)
        self.pupil: SampledPupil = SampledPupil(aperture, self.window.field, band, basis, dtype=dtype, device=device)

    @property
    def aberrations(self) -> AberrationBasis:
        """Basis of the aberrations with parameters z."""
        return self.pupil.aberrations

    @property
    def band(self) -> Band:
        """Wavelengths of the model."""
        return self.pupil.band

    @property
    def dtype(self) -> torch.dtype:
        """Data type of the frames."""
        return self.pupil.basis.dtype

    @property
    def device(self) -> torch.device:
        """Device of the frames."""
        return self.pupil.basis.device

    def single(self) -> ExposureModel:
        """Return the model with its arrays in float32, which shares the aberration basis."""
        twin = copy.deepcopy(self).float()
        twin.pupil.aberrations = self.aberrations
        return twin

    @property
    def cutoff(self) -> float:
        """Highest frequency that the aperture transmits at the grid's wavelength and pixels sample [cycles/pixel]."""
        return min(0.5, self.window.grid.cutoff(self.pupil.aperture.extent))

    def beside(self, background: Background) -> ExposureModel:
        """Return the model for frames with the given background; it shares all arrays."""
        twin = copy.copy(self)
        twin.background = _of_a_model(background)
        return twin

    def chunks(self, n_frames: int) -> Iterator[slice]:
        """Return slices of the frames whose work arrays fit into a core's cache, or large ones for other devices."""
        pixels = self.pupil.n_rasters * math.prod(self.window.field.shape)
        size = max(1, _CHUNK.on(self.device) // (2 * self.dtype.itemsize * pixels))
        return (slice(start, min(start + size, n_frames)) for start in range(0, n_frames, size))

    def amplitude(self, samples: OpenSamples, field: Tensor) -> Tensor:
        """Return the focal amplitude (T, wavelength, H', W') of a pupil field (T, P)."""
        return torch.fft.fft2(self.raster(samples, field))

    def raster(self, samples: OpenSamples, field: Tensor) -> Tensor:
        """Return the rasters (T, wavelength, H', W') of a pupil field (T, P)."""
        rasters = (self.pupil.n_rasters, *self.window.field.shape)
        pupil = field.new_zeros(len(field), math.prod(rasters)).index_add_(1, samples.index, field)
        return pupil.unflatten(1, rasters)

    def spectrum(self, image: Tensor) -> Tensor:
        """Return the Fourier transform (..., H', W'/2 + 1) of objects (..., H', W') convolved with the pixel."""
        spectrum = torch.fft.rfft2(image.to(self.dtype))
        return spectrum if self.response is None else spectrum * self.response.to(spectrum)

    def spectrum_adjoint(self, spectrum: Tensor) -> Tensor:
        """Apply the adjoint of `spectrum`, up to the normalisation of the FFT; returns (..., H', W')."""
        if self.response is not None:
            spectrum = spectrum * self.response.conj().to(spectrum)
        return torch.fft.irfft2(spectrum, s=self.window.field.shape)

    def through(self, aperture: Aperture, aberrations: AberrationBasis | None = None) -> ExposureModel:
        """Return the model with another aperture of as many sub-apertures, or with other aberrations."""
        twin = copy.deepcopy(self)
        kwargs = {"dtype": self.dtype, "device": self.device}
        twin.pupil = SampledPupil(aperture, self.window.field, self.band, aberrations or self.aberrations, **kwargs)
        return twin

    def psf(self, z: Tensor, samples: OpenSamples | None = None) -> Tensor:
        """Return the PSFs (T, H', W') of the optics for z (T, K), of unit sum, with the origin at [0, 0].

        `samples` are those of a moved pupil; None: those of the model's own.
        """
        samples = samples or self.pupil.samples()
        return intensity(self.amplitude(samples, samples.field(samples.phase(z))))

    def forward(self, image: Tensor, z: Tensor, samples: OpenSamples | None = None) -> Tensor:
        self._check(image, z)
        transfer = torch.fft.rfft2(self.psf(z, samples))
        return self.window.crop(torch.fft.irfft2(transfer * self.spectrum(image), s=self.window.field.shape))

    def _check(self, image: Tensor, z: Tensor) -> None:
        """Raise ValueError unless an object and aberrations are those of this model."""
        if image.shape[-2:] != self.window.field.shape:
            raise ValueError(
                f"the object has shape {tuple(image.shape)}: (..., *{self.window.field.shape}) is needed, that of the "
                "field, into which model.window.embed puts an object on the pixels of the frames"
            )
        if z.ndim != 2 or z.shape[-1] != self.aberrations.n_parameters:
            raise ValueError(
                f"z has shape {tuple(z.shape)}: (T, {self.aberrations.n_parameters}) is needed, the parameters of all "
                "sub-apertures in each frame, as model.aberrations.parameters_of(coefficients) returns; "
                "torch.func.vmap(model) takes batches of stacks"
            )


def intensity(amplitude: Tensor) -> Tensor:
    """Return the intensity (T, H', W') of amplitudes (T, wavelength, H', W'), summed over wavelengths."""
    power = torch.addcmul(amplitude.real.square(), amplitude.imag, amplitude.imag)
    return power[:, 0] if power.shape[1] == 1 else power.sum(1)


def _half_plane(pixel: PixelResponse, field: Grid) -> Tensor:
    """Return the transfer function (H', W'/2 + 1) of pixels on the frequencies of a real FFT."""
    rows, columns = field.shape
    like = {"dtype": torch.float64, "device": "cpu"}
    nu_y, nu_x = torch.fft.fftfreq(rows, **like), torch.fft.rfftfreq(columns, **like)
    return pixel.transfer(nu_y[:, None], nu_x[None])


def fast_size(n: int) -> int:
    """Return the smallest even number >= `n` with no prime factor above 5, for which FFTs are fast.

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


def _of_a_model(background: Background) -> Background:
    """Return the background. Raises ValueError for `IF_SEEN`."""
    if background is Background.IF_SEEN:
        raise ValueError(
            "background is Background.IF_SEEN, which frames decide and no model: give Background.NONE, PER_FRAME or "
            "COMMON, or what `FrameStack.of` finds"
        )
    return background
