"""Image formation from a scene and point-spread functions, and the noise of the detector."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn

from torchmask.optics.draws import draw_normal
from torchmask.optics.fourier import transform_images
from torchmask.optics.inputs import require_real
from torchmask.optics.pixel import PixelResponse, require_response
from torchmask.optics.pupil import can_be_read

NOISES = ("poisson", "gaussian")


def image_formation(scene: Tensor, psfs: Tensor) -> Tensor:
    """Blur a scene by linear convolution, so that light that leaves the field is lost.

    Parameters
    ----------
    scene : (..., H, W) tensor
        Light of the scene, zero outside the field.
    psfs : (..., rows, columns) tensor
        Unfolded PSFs on the scene's pixels, with their origin at [0, 0] (FFT order), as `psf_from_samples` returns
        them for a field at least twice as wide as the scene's. Leading axes broadcast against those of `scene`.

    Returns
    -------
    Tensor
        (..., H, W), the blurred scene, differentiable in both arguments. Negative values are rounding errors of the
        FFT, which are not clipped so that the function stays linear.

    Raises
    ------
    ValueError
        If a PSF has fewer than 2 H - 1 rows or 2 W - 1 columns, so that it cannot reach from one border to the other.

    Examples
    --------
    >>> scene = torch.zeros(4, 4); scene[1, 3] = 5.0
    >>> psf = torch.zeros(8, 8); psf[2, 0] = psf[0, 1] = 0.5  # two rows down; one column to the right
    >>> image_formation(scene, psf).round().nonzero().tolist()  # the second half has left the field
    [[3, 3]]
    """
    spectrum, transfer = _spectra(scene, psfs)
    return _cropped_image(spectrum * transfer, psfs, scene)


def image_formation_adjoint(frames: Tensor, psfs: Tensor) -> Tensor:
    """Apply the adjoint of `image_formation` with respect to the scene.

    That is, <image_formation(o, h), y> = <o, image_formation_adjoint(y, h)>: `frames` (..., H, W) are correlated with
    the same `psfs` (..., rows, columns). If the scene was broadcast along an axis, such as that of the frames, the
    caller must sum over it. Differentiable in both arguments; raises ValueError as `image_formation` does.

    Examples
    --------
    >>> psfs = torch.rand(3, 8, 8); scene = torch.rand(4, 4); frames = torch.rand(3, 4, 4)
    >>> there = (image_formation(scene, psfs) * frames).sum()
    >>> back = (scene * image_formation_adjoint(frames, psfs).sum(0)).sum()
    >>> torch.allclose(there, back)
    True
    """
    spectrum, transfer = _spectra(frames, psfs)
    return _cropped_image(spectrum * transfer.conj(), psfs, frames)


def _spectra(image: Tensor, psfs: Tensor) -> tuple[Tensor, Tensor]:
    """Return the transforms of an image and of PSFs on their raster, where no wrapped light falls inside the image."""
    rows, columns = psfs.shape[-2:]
    height, width = image.shape[-2:]
    if rows < 2 * height - 1 or columns < 2 * width - 1:
        raise ValueError(
            f"PSFs of {rows} x {columns} pixels are too small for a scene of {height} x {width}: at least "
            f"{2 * height - 1} x {2 * width - 1} are needed, unfolded (sample the pupil with more oversampling)"
        )
    on_raster = partial(torch.fft.rfft2, s=(rows, columns))
    return transform_images(on_raster, image), transform_images(on_raster, psfs)


def _cropped_image(spectrum: Tensor, psfs: Tensor, like: Tensor) -> Tensor:
    """Return the part of the image with this spectrum, on the raster of the PSFs, that has the size of another."""
    image = transform_images(partial(torch.fft.irfft2, s=psfs.shape[-2:]), spectrum)
    return image[..., : like.shape[-2], : like.shape[-1]]


class Detector(nn.Module):
    """Pixels of a detector, with photon noise and read-out noise that are independent from pixel to pixel.

    Parameters
    ----------
    readout_noise : float
        Standard deviation of the Gaussian read-out noise [electrons per pixel and frame].
    noise : {"poisson", "gaussian"}
        Model of the photon noise. "poisson" counts photons, as a detector does; its frames carry no gradient, because
        a count is a step function of the light. "gaussian" adds normal noise of the same total variance,
        `expected + readout_noise**2`, and is differentiable, so use it for training.
    pixel : PixelResponse, optional
        Blur by the pixels, such as `SquarePixel(0.9)`; points by default. `simulate_observation` multiplies the
        transfer function of every exposure by it; `forward` only draws noise.

    Raises
    ------
    ValueError
        If `readout_noise` is not finite or is negative, or `noise` is neither of the two.
    TypeError
        If `pixel` is no response.

    Notes
    -----
    A Gaussian frame is y = m + s e, with m the expected light, s^2 = m + readout_noise^2 and e a standard normal number
    drawn independently of m (Kingma & Welling, Auto-Encoding Variational Bayes, 2014, section 2.4). Hence
    dy/dm = 1 + e / (2 s), which includes the growth of the noise. The second term is at most |e| / (2 readout_noise).
    Without read-out noise it diverges as m goes to 0, so it is dropped where s^2 is within the rounding error of the
    FFTs that formed m. Gaussian pixels may be negative, and are a poor model below about ten photons.

    Examples
    --------
    >>> detector = Detector(readout_noise=1.5)
    >>> frame = detector(torch.full((64, 64), 100.0), generator=torch.Generator().manual_seed(0))
    >>> bool((frame.mean() - 100).abs() < 1)
    True
    >>> light = torch.full((64, 64), 100.0, requires_grad=True)
    >>> Detector(1.5, noise="gaussian")(light).requires_grad, Detector(1.5)(light).requires_grad
    (True, False)
    """

    def __init__(self, readout_noise: float = 0.0, noise: str = "poisson", pixel: PixelResponse | None = None) -> None:
        super().__init__()
        if not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and not negative, in electrons rms")
        if noise not in NOISES:
            raise ValueError(f"noise is {noise!r}: it must be one of {', '.join(NOISES)}")
        require_response(pixel)
        self.readout_noise: float = float(readout_noise)
        self.noise: str = noise
        self.pixel: PixelResponse | None = pixel

    def forward(self, expected: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw frames (..., H, W) [electrons] whose mean is `expected` (..., H, W) [electrons].

        A `generator` on the CPU works for any device of `expected`, and gives the same noise on all of them. Noise is
        drawn in float64 with any generator, so that float32 sees that of float64.

        Raises TypeError if `expected` is no tensor of float32 or float64, and ValueError if a value is not finite, or
        is negative beyond the rounding error of the FFTs that formed its image (values are not checked under
        `torch.func.vmap`).
        """
        require_real("expected", expected)
        image = (-2, -1) if expected.ndim > 1 else None
        norm = torch.linalg.vector_norm(expected.detach(), dim=image, keepdim=True)
        rounding = 32 * torch.finfo(expected.dtype).eps * norm
        if can_be_read(expected):
            _require_light(expected, rounding)
        normal = draw_normal(expected.shape, expected.dtype, expected.device, generator)
        if self.noise == "gaussian":
            variance = expected.clamp(min=0) + self.readout_noise**2
            return expected + _root(variance, rounding) * normal
        mean = expected.detach().clamp(min=0)
        mean = mean if generator is None else mean.to(generator.device, torch.float64)
        return torch.poisson(mean, generator=generator).to(expected) + self.readout_noise * normal

    def extra_repr(self) -> str:
        pixel = "" if self.pixel is None else f", pixel={self.pixel}"
        return f"readout_noise={self.readout_noise:.6g}, noise={self.noise!r}{pixel}"


def _require_light(expected: Tensor, rounding: Tensor) -> None:
    """Raise ValueError unless expected light is finite and, but for rounding errors, not negative."""
    if not bool(torch.isfinite(expected).all()):
        raise ValueError("expected holds values that are not finite: electrons per pixel are needed")
    if bool((expected < -rounding).any()):
        raise ValueError("expected holds negative light beyond rounding errors: clip it at 0")


def _root(variance: Tensor, rounding: Tensor) -> Tensor:
    """Return the square root, without gradient where the variance is within rounding errors."""
    known = variance > rounding
    return torch.where(known, torch.where(known, variance, 1).sqrt(), variance.detach().sqrt())
