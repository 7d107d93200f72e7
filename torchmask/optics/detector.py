"""From a scene and point-spread functions to what a detector reads."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn


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
    """Photon noise, and Gaussian read-out noise of zero mean.

    Parameters
    ----------
    readout_noise : float
        Electrons rms per pixel and frame.

    Raises
    ------
    ValueError
        If `readout_noise` is not finite or is negative.

    Examples
    --------
    >>> detector = Detector(readout_noise=1.5)
    >>> frame = detector(torch.full((64, 64), 100.0), generator=torch.Generator().manual_seed(0))
    >>> bool((frame.mean() - 100).abs() < 1)
    True
    """

    def __init__(self, readout_noise: float = 0.0) -> None:
        super().__init__()
        if not (math.isfinite(readout_noise) and readout_noise >= 0):
            raise ValueError(f"readout_noise is {readout_noise}: it must be finite and not negative, in electrons rms")
        self.readout_noise: float = float(readout_noise)

    def forward(self, expected: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """Draw frames (..., H, W) [electrons] whose mean is `expected` (..., H, W) [electrons].

        `generator` may live on the CPU whatever the device of `expected`, for the same noise everywhere.

        Raises ValueError if a value is not finite, or negative beyond the rounding of the FFTs that formed it.
        """
        if not bool(torch.isfinite(expected).all()):
            raise ValueError("expected holds values that are not finite: electrons per pixel are needed")
        rounding = 32 * torch.finfo(expected.dtype).eps * torch.linalg.vector_norm(expected)
        if bool((expected < -rounding).any()):
            raise ValueError("expected holds negative light beyond rounding errors: no pixel may be negative")
        device = expected.device if generator is None else generator.device
        mean = expected.clamp(min=0).to(device)
        noise = torch.randn(mean.shape, generator=generator, dtype=mean.dtype, device=device)
        counts = torch.poisson(mean, generator=generator)
        return (counts + self.readout_noise * noise).to(expected.device)

    def extra_repr(self) -> str:
        return f"readout_noise={self.readout_noise:.6g}"
