"""From a scene and point-spread functions to what a detector reads."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

NOISES = ("poisson", "gaussian")


def image_formation(scene: Tensor, psfs: Tensor) -> Tensor:
    """Blur a scene by linear convolution: light that leaves the field is lost, none comes back on the other side.

    Parameters
    ----------
    scene : (..., H, W) tensor
        Nothing shines outside the field.
    psfs : (..., rows, columns) tensor
        Unfolded, on the scene's pixels, with their origin at [0, 0] (FFT order), as `psf_from_samples` gives them for
        a field at least twice as wide as the scene's. Leading axes broadcast against those of `scene`.

    Returns
    -------
    Tensor
        (..., H, W), the scene's field. Negative values are rounding errors of the FFT, not clipped, so that the
        function stays linear. Differentiable in both arguments.

    Raises
    ------
    ValueError
        If a PSF has fewer than 2 H - 1 rows or 2 W - 1 columns: it could not reach from one border to the other.

    Examples
    --------
    >>> scene = torch.zeros(4, 4); scene[1, 3] = 5.0
    >>> psf = torch.zeros(8, 8); psf[2, 0] = psf[0, 1] = 0.5  # two rows down; one column to the right
    >>> image_formation(scene, psf).round().nonzero().tolist()  # the second half has left the field
    [[3, 3]]
    """
    raster, (height, width) = _wide_raster(psfs, scene), scene.shape[-2:]
    spectrum = torch.fft.rfft2(scene, s=raster) * torch.fft.rfft2(psfs)
    return torch.fft.irfft2(spectrum, s=raster)[..., :height, :width]


def image_formation_adjoint(frames: Tensor, psfs: Tensor) -> Tensor:
    """The adjoint of `image_formation` in the scene: <image_formation(o, h), y> = <o, image_formation_adjoint(y, h)>.

    `frames` (..., H, W) are correlated with the same `psfs` (..., rows, columns). An axis along which a scene was
    broadcast, such as that of the frames, is left for the caller to sum. Differentiable in both; raises ValueError
    likewise.

    Examples
    --------
    >>> psfs = torch.rand(3, 8, 8); scene = torch.rand(4, 4); frames = torch.rand(3, 4, 4)
    >>> there = (image_formation(scene, psfs) * frames).sum()
    >>> back = (scene * image_formation_adjoint(frames, psfs).sum(0)).sum()
    >>> torch.allclose(there, back)
    True
    """
    raster, (height, width) = _wide_raster(psfs, frames), frames.shape[-2:]
    spectrum = torch.fft.rfft2(frames, s=raster) * torch.fft.rfft2(psfs).conj()
    return torch.fft.irfft2(spectrum, s=raster)[..., :height, :width]


def _wide_raster(psfs: Tensor, image: Tensor) -> tuple[int, int]:
    """Rows and columns of the PSFs: so wide that what wraps around falls outside the image."""
    rows, columns = psfs.shape[-2:]
    height, width = image.shape[-2:]
    if rows < 2 * height - 1 or columns < 2 * width - 1:
        raise ValueError(
            f"PSFs of {rows} x {columns} pixels are too small for a scene of {height} x {width}: at least "
            f"{2 * height - 1} x {2 * width - 1} are needed, unfolded (sample the pupil with more oversampling)"
        )
    return rows, columns


class Detector(nn.Module):
    """Noise of the light and of the read-out, independent from pixel to pixel.

    Parameters
    ----------
    readout_noise : float
        Electrons rms per pixel and frame: Gaussian, of zero mean.
    noise : {"poisson", "gaussian"}
        Of the light. "poisson" counts photons, as a detector does. Its frames carry no gradient, because a count is a
        step function of the light. "gaussian" adds normal noise of the same variance as count and read-out together,
        `expected + readout_noise**2`, and differentiates: train through this one.

    Raises
    ------
    ValueError
        If `readout_noise` is not finite or is negative, or `noise` is neither of the two.

    Notes
    -----
    A Gaussian frame is y = m + s e with m the expected light, s^2 = m + readout_noise^2 and e a standard normal number
    that is drawn whatever m is (Kingma & Welling, Auto-Encoding Variational Bayes, 2014, section 2.4). So
    dy/dm = 1 + e / (2 s), with the growth of the noise included. The second term is at most |e| / (2 readout_noise);
    without read-out noise it grows without bound towards the dark, and is left out where s^2 is no more than the
    rounding of the FFTs that formed m: a dark pixel has the gradient 1 of its mean. Gaussian pixels may be negative,
    and stand in poorly for counts of less than about ten photons.

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

    def __init__(self, readout_noise: float = 0.0, noise: str = "poisson") -> None:
        super().__init__()
        if not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and not negative, in electrons rms")
        if noise not in NOISES:
            raise ValueError(f"noise is {noise!r}: it must be one of {', '.join(NOISES)}")
        self.readout_noise: float = float(readout_noise)
        self.noise: str = noise

    def forward(self, expected: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw frames (..., H, W) [electrons] whose mean is `expected` (..., H, W) [electrons].

        `generator` may live on the CPU whatever the device of `expected`, for the same noise everywhere.

        Raises ValueError if a value is not finite, or negative beyond the rounding of the FFTs that formed it.
        """
        if not bool(torch.isfinite(expected).all()):
            raise ValueError("expected holds values that are not finite: electrons per pixel are needed")
        rounding = 32 * torch.finfo(expected.dtype).eps * torch.linalg.vector_norm(expected.detach())
        if bool((expected < -rounding).any()):
            raise ValueError("expected holds negative light beyond rounding errors: no pixel may be negative")
        device = expected.device if generator is None else generator.device
        normal = torch.randn(expected.shape, generator=generator, dtype=expected.dtype, device=device)
        if self.noise == "gaussian":
            variance = expected.clamp(min=0) + self.readout_noise**2
            return expected + _root(variance, rounding) * normal.to(expected.device)
        counts = torch.poisson(expected.detach().clamp(min=0).to(device), generator=generator)
        return (counts + self.readout_noise * normal).to(expected.device)

    def extra_repr(self) -> str:
        return f"readout_noise={self.readout_noise:.6g}, noise={self.noise!r}"


def _root(variance: Tensor, rounding: Tensor) -> Tensor:
    """Square root, without its gradient where that would divide by no more than rounding errors."""
    known = variance > rounding
    return torch.where(known, torch.where(known, variance, 1).sqrt(), variance.detach().sqrt())
