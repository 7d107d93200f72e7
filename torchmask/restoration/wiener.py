"""The best linear restoration for known transfer functions."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.fourier import transform_images
from torchmask.spectra import PSD, evaluate_psd

_REAL, _COMPLEX = (torch.float32, torch.float64), (torch.complex64, torch.complex128)


def multiframe_wiener(frames: Tensor, otfs: Tensor, object_psd: PSD, noise_psd: PSD) -> Tensor:
    """Return the multi-frame Wiener estimate: O = sum_t conj(H_t) Y_t / (sum_t |H_t|^2 + S_n / S_o).

    Parameters
    ----------
    frames : (..., T, H, W) tensor
        Exposures in any unit.
    otfs : (..., T, H, W) complex tensor
        OTF of each frame in FFT order, 1 at zero frequency.
    object_psd : callable or Tensor
        PSD of the object in the convention of an unnormalised DFT, as for `torchmask.design.criterion.wiener_mse`.
        Frequencies at which it is zero become zero.
    noise_psd : callable or Tensor
        PSD of the noise of one frame, in the same convention.

    Returns
    -------
    Tensor
        (..., H, W) in the unit and dtype of the frames, differentiable in all arguments that are tensors. Its mean
        squared error is `wiener_mse`.

    Raises
    ------
    ValueError, TypeError
        If frames or OTFs are not of single or double precision or do not broadcast to each other, or a PSD has a wrong
        type, shape or sign.

    Examples
    --------
    >>> frames = torch.rand(4, 16, 16, dtype=torch.float64)
    >>> perfect = torch.ones(4, 16, 16, dtype=torch.complex128)
    >>> restored = multiframe_wiener(frames, perfect, torch.tensor(1.0), torch.tensor(0.0))
    >>> torch.allclose(restored, frames.mean(0))  # no blur, no noise: the mean
    True
    """
    if frames.dtype not in _REAL or otfs.dtype not in _COMPLEX:
        raise TypeError(
            f"frames are {frames.dtype} and otfs {otfs.dtype}: they must be float32 or float64, and complex64 or "
            "complex128"
        )
    if frames.ndim < 3 or otfs.ndim < 3 or frames.shape[-3:] != otfs.shape[-3:] or not _broadcast(frames, otfs):
        raise ValueError(
            f"frames have shape {tuple(frames.shape)} and otfs {tuple(otfs.shape)}: both must end in the same "
            "(frame, rows, columns), and what comes before must broadcast"
        )
    grid = Grid((frames.shape[-2], frames.shape[-1]), 1.0, 1.0)  # PSDs are functions of cycles/pixel only
    signal = evaluate_psd(object_psd, grid, "object_psd", frames.dtype, frames.device)
    noise = evaluate_psd(noise_psd, grid, "noise_psd", frames.dtype, frames.device)
    matched = (otfs.conj() * transform_images(torch.fft.fft2, frames)).sum(-3)
    power = (otfs.real**2 + otfs.imag**2).sum(-3)
    denominator = signal * power + noise
    # Where signal and noise are both zero, the estimate is 0.
    gain = torch.where(denominator > 0, signal / torch.where(denominator > 0, denominator, 1), 0)
    return transform_images(torch.fft.ifft2, matched * gain).real.to(frames.dtype)


def _broadcast(one: Tensor, other: Tensor) -> bool:
    """Return whether two tensors broadcast to each other."""
    try:
        torch.broadcast_shapes(one.shape, other.shape)
    except RuntimeError:
        return False
    return True
