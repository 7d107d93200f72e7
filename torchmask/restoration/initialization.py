"""What a restoration needs to know beforehand, taken from the frames themselves."""

from __future__ import annotations

import math
import warnings

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.restoration.conjugate import conjugate_gradients

_ITERATIONS = 30  # of the search for what dead pixels would hold
_STRENGTH_RANGE = (0.05, 20.0)  # of the turbulence against its first guess, in (1/r0)^(5/3)


def check_frames(frames: Tensor | np.ndarray, valid: Tensor | np.ndarray | None, grid: Grid) -> tuple[Tensor, Tensor]:
    """Frames (T, H, W) in floating point with pixels that are not valid filled in, and `valid` as (T, H, W).

    Raises ValueError if a shape is wrong, a valid pixel is not finite, or a frame holds no light.
    """
    frames = frames if isinstance(frames, Tensor) else torch.as_tensor(frames)  # which also moves to a default device
    if frames.ndim != 3 or tuple(frames.shape[1:]) != grid.shape or not len(frames):
        raise ValueError(
            f"frames has shape {tuple(frames.shape)}: it must be (n_frames, {grid.shape[0]}, {grid.shape[1]}), with "
            "at least one frame, as the grid says"
        )
    frames = frames.detach().double()
    if valid is None:
        valid = torch.ones_like(frames, dtype=torch.bool)
    else:
        valid = torch.as_tensor(valid, device=frames.device)
        if valid.dtype != torch.bool or tuple(valid.shape) not in (grid.shape, tuple(frames.shape)):
            raise ValueError(
                f"valid is {valid.dtype} of shape {tuple(valid.shape)}: it must be bool, of shape {grid.shape} or "
                f"{tuple(frames.shape)}"
            )
        valid = valid.expand(frames.shape)
        frames = _fill(frames, valid)
    bad = ~torch.isfinite(frames).flatten(1).all(1)
    if bool(bad.any()):
        raise ValueError(
            f"frames {bad.nonzero().flatten().tolist()} hold values that are not finite: mark those pixels in `valid`"
        )
    dark = frames.mean((1, 2)) <= 0
    if bool(dark.any()):
        raise ValueError(f"frames {dark.nonzero().flatten().tolist()} hold no light: leave them out")
    return frames, valid


def _fill(frames: Tensor, valid: Tensor) -> Tensor:
    """Replace pixels that are not valid by the mean of their valid neighbours, from the rim of a dead region inwards.

    They carry no weight in the restoration; this keeps them from spoiling the mean frame. 0 in frames without any.
    """
    frames = torch.where(valid, frames, 0.0)
    kernel = torch.ones(1, 1, 3, 3, dtype=frames.dtype, device=frames.device)
    for _ in range(max(frames.shape[1:])):
        if bool(valid.all()):
            break
        around = torch.nn.functional.conv2d(frames[:, None], kernel, padding=1)[:, 0]
        count = torch.nn.functional.conv2d(valid[:, None].to(frames), kernel, padding=1)[:, 0]
        frames = torch.where(valid, frames, around / count.clamp(min=1))
        valid = valid | (count > 0)
    return frames


def noise_variance(frames: Tensor, grid: Grid, aperture: Aperture, valid: Tensor | None = None) -> float | None:
    """Mean noise variance of a pixel [electrons^2], from the frequencies that the aperture cannot transmit.

    White noise has the same power at all frequencies, and beyond the cut-off there is nothing else. The median over
    frequencies (of the power averaged over T frames, a gamma variable) leaves out the cross of a bright border.
    None if fewer than eight frequencies lie beyond the cut-off.

    Pixels that are not `valid` (T, H, W) take the values that leave the least power there. That takes some of the
    noise with it: as much as of white noise with the same holes.
    """
    nu_y, nu_x = grid.frequencies(frames.dtype, frames.device)
    beyond = torch.hypot(nu_y, nu_x) > grid.cutoff(aperture.extent)
    if int(beyond.sum()) < 8:
        return None
    n = len(frames)
    median_over_mean = math.log(2) if n == 1 else (1 - 1 / (9 * n)) ** 3  # Wilson & Hilferty 1931
    if valid is not None and not bool(valid.all()):
        generator = torch.Generator().manual_seed(0)
        white = torch.randn(frames.shape, dtype=frames.dtype, device="cpu", generator=generator).to(frames.device)
        frames = _least_power(frames, valid, beyond)
        median_over_mean = _median_power(_least_power(white * valid, valid, beyond), beyond)
    return _median_power(frames, beyond) / median_over_mean


def _median_power(frames: Tensor, beyond: Tensor) -> float:
    return float((torch.fft.fft2(frames, norm="ortho").abs() ** 2)[..., beyond].mean(0).median())


def _least_power(frames: Tensor, valid: Tensor, beyond: Tensor) -> Tensor:
    """Frames whose pixels that are not valid make the power at the frequencies `beyond` (H, W) least."""
    half = beyond[:, : beyond.shape[1] // 2 + 1]

    def gradient(x: Tensor) -> Tensor:
        return torch.where(valid, 0.0, torch.fft.irfft2(torch.fft.rfft2(x) * half, s=beyond.shape))

    return frames + conjugate_gradients(gradient, -gradient(frames), lambda x: x, _ITERATIONS)


def expected_variance(
    frames: Tensor, grid: Grid, aperture: Aperture, readout_noise: float | None, valid: Tensor | None = None
) -> float:
    """Mean noise variance of a pixel [electrons^2]: photon and read-out noise, or what `noise_variance` measures.

    Raises ValueError if nothing tells the noise; warns if both ways are open and disagree by more than a factor of 2.
    """
    measured = noise_variance(frames, grid, aperture, valid)
    if readout_noise is None:
        if measured is None or measured <= 0:
            raise ValueError("the noise cannot be measured beyond the cut-off frequency: give readout_noise")
        return measured
    variance = float(frames.mean()) + readout_noise**2
    if measured is not None and not 0.5 < measured / variance < 2:
        warnings.warn(
            f"the frames' noise is {measured**0.5:.3g} electrons rms, but photon noise and readout_noise make "
            f"{variance**0.5:.3g}: check the gain and readout_noise",
            stacklevel=4,
        )
    return variance


def border_brightness(frames: Tensor) -> float:
    """Mean of the mean frame's outermost pixels over the mean of all."""
    mean = frames.mean(0)
    border = torch.cat([mean[0], mean[-1], mean[1:-1, 0], mean[1:-1, -1]])
    return float(border.mean() / mean.mean())


def mean_frame(frames: Tensor, field: Grid) -> Tensor:
    """The clipped mean of the frames (T, H, W) on the object's wider field (H', W'), zero in the margin."""
    mean = frames.mean(0).clamp(min=0)
    rows, columns = field.shape
    return torch.nn.functional.pad(mean, (0, columns - mean.shape[1], 0, rows - mean.shape[0]))


def turbulence_strength(coefficients: Tensor, mixing: Tensor) -> float | None:
    """Variance of restored aberrations (T, N, J) over that of the prior, mixing (N J, K): (r0 of the prior / r0)^(5/3).

    From tips and tilts relative to their mean over the sub-apertures, which are seen best and depend least on the
    outer scale; from defocus to Noll 10 for a single aperture. None where there are no such modes.
    """
    n_frames, n_sub, n_modes = coefficients.shape
    low, high = (1, 3) if n_sub > 1 else (3, 10)
    if n_modes < low + 2:
        return None
    covariance = (mixing @ mixing.T).to(coefficients).unflatten(1, (n_sub, n_modes)).unflatten(0, (n_sub, n_modes))
    modes = coefficients[..., low:high]
    expected = torch.einsum("njnj->j", covariance)[low:high].sum()
    if n_sub > 1:
        modes = modes - modes.mean(1, keepdim=True)
        expected = expected - torch.einsum("njmj->j", covariance)[low:high].sum() / n_sub
    ratio = float((modes**2).sum() / n_frames / expected)
    return min(max(ratio, _STRENGTH_RANGE[0]), _STRENGTH_RANGE[1])
