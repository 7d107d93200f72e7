"""The best linear restoration when every transfer function is known."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.spectra import PSD, evaluate_psd


def multiframe_wiener(frames: Tensor, otfs: Tensor, object_psd: PSD, noise_psd: PSD) -> Tensor:
    """Multi-frame Wiener estimate: O = sum_t conj(H_t) Y_t / (sum_t |H_t|^2 + S_n / S_o).

    Parameters
    ----------
    frames : (..., T, H, W) tensor
    otfs : (..., T, H, W) complex tensor
        In FFT order, 1 at zero frequency.
    object_psd, noise_psd : callable or Tensor
        As for `torchmask.design.criterion.wiener_mse`, in the convention of an unnormalised DFT; that of the noise is
        of one frame. An object PSD of zero sets that frequency to zero.

    Returns
    -------
    Tensor
        (..., H, W) in the units of the frames, of their dtype; differentiable. Its mean squared error is `wiener_mse`.

    Raises
    ------
    ValueError, TypeError
        If frames and OTFs do not broadcast to each other, or a PSD is of a wrong type, shape or sign.

    Examples
    --------
    >>> frames = torch.rand(4, 16, 16, dtype=torch.float64)
    >>> perfect = torch.ones(4, 16, 16, dtype=torch.complex128)
    >>> restored = multiframe_wiener(frames, perfect, torch.tensor(1.0), torch.tensor(0.0))
    >>> torch.allclose(restored, frames.mean(0))  # no blur, no noise: the mean
    True
    """
    if not frames.is_floating_point() or not otfs.is_complex():
        raise TypeError(
            f"frames are {frames.dtype} and otfs {otfs.dtype}: they must be real floating point and complex"
        )
    if frames.ndim < 3 or otfs.ndim < 3 or frames.shape[-3:] != otfs.shape[-3:]:
        raise ValueError(
            f"frames have shape {tuple(frames.shape)} and otfs {tuple(otfs.shape)}: both must end in the same "
            "(frame, rows, columns)"
        )
    grid = Grid((frames.shape[-2], frames.shape[-1]), 1.0, 1.0)  # PSDs are functions of cycles/pixel only
    signal = evaluate_psd(object_psd, grid, "object_psd", frames.dtype, frames.device)
    noise = evaluate_psd(noise_psd, grid, "noise_psd", frames.dtype, frames.device)
    matched = (otfs.conj() * torch.fft.fft2(frames)).sum(-3)
    power = (otfs.real**2 + otfs.imag**2).sum(-3)
    denominator = signal * power + noise
    # Where nothing is known, neither signal nor noise, the estimate is 0.
    gain = torch.where(denominator > 0, signal / torch.where(denominator > 0, denominator, 1), 0)
    return torch.fft.ifft2(matched * gain).real
