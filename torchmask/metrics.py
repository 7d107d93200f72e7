"""Scores of a restoration against the truth that ignore position and brightness.

A restoration with unknown aberrations determines neither the position of the object nor its brightness, nor anything
beyond the diffraction limit. Estimates are therefore low-passed, registered and scaled before they are compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from torchmask.io import as_tensor, extra

_ROUNDING = 1e-9  # relative tolerance, so that frequencies exactly at the cut-off are kept
_PEAK_PERCENTILE = 99.5  # glints above it would set the range of the structural similarity


def lowpass(image: Any, cutoff: float) -> Tensor:
    """Remove all frequencies above `cutoff` [cycles/pixel] from images (..., H, W) by a sharp circular cut.

    `image` is a tensor or an array; whole numbers become float64. The result is differentiable and keeps any other
    dtype, and the device. Raises ValueError if `cutoff` is not finite and positive, and TypeError if `image` is in half
    precision, which FFTs do not know.
    """
    if not (math.isfinite(cutoff) and cutoff > 0):
        raise ValueError(
            f"cutoff is {cutoff}: it must be positive, in cycles/pixel (diameter * pixel_scale / wavelength)"
        )
    image = _real(image)
    nu_y, nu_x = _frequencies(image.shape, torch.float64, image.device)
    kept = torch.hypot(nu_y, nu_x) <= cutoff * (1 + _ROUNDING)
    return torch.fft.irfft2(torch.fft.rfft2(image) * kept, s=image.shape[-2:])


def shift(image: Any, offset: Tensor | tuple[float, float]) -> Tensor:
    """Shift images by any fraction of a pixel, with wrap-around, by the shift theorem, exact for band-limited images.

    Parameters
    ----------
    image : (..., H, W) tensor or array
        Images to shift; whole numbers become float64.
    offset : (..., 2) tensor or (dy, dx)
        Shift of each image along rows and columns [pixels]; leading axes broadcast against those of `image`.

    Returns
    -------
    Tensor
        (..., H, W), with the dtype and device of `image`; differentiable in both arguments.

    Raises
    ------
    ValueError
        If the last axis of `offset` is not (dy, dx).
    TypeError
        If `image` is in half precision, which FFTs do not know.

    Notes
    -----
    A shift by whole pixels is a roll, and the adjoint is the shift by `-offset`. Shifts add up, and that by `-offset`
    is the inverse, except at the Nyquist frequency of an even side, whose wave a shift by half a pixel removes.

    Examples
    --------
    >>> image = torch.zeros(5, 6); image[1, 2] = 1.0
    >>> shift(image, (1.0, -2.0)).round().nonzero().tolist()
    [[2, 0]]
    """
    image = _real(image)
    move = torch.as_tensor(offset, dtype=image.dtype, device=image.device)
    return torch.fft.irfft2(torch.fft.rfft2(image) * shift_transfer(image.shape, move), s=image.shape[-2:])


def shift_transfer(shape: Sequence[int], offset: Tensor) -> Tensor:
    """Return the factor (..., H, W // 2 + 1) by which a shift multiplies the transform `torch.fft.rfft2` of an image.

    `shape` (..., H, W) is that of the image, and `offset` (..., 2) the shift (dy, dx) [pixels]. Differentiable; raises
    ValueError as `shift` does.
    """
    if offset.shape[-1:] != (2,):
        raise ValueError(f"offset has shape {tuple(offset.shape)}: its last axis must be (dy, dx), in pixels")
    nu_y, nu_x = _frequencies(shape, offset.dtype, offset.device)
    angle = -2 * math.pi * (nu_y * offset[..., 0, None, None] + nu_x * offset[..., 1, None, None])
    return torch.complex(angle.cos(), angle.sin())  # torch.polar takes four times as long


def align(estimate: Any, truth: Any, cutoff: float) -> Tensor:
    """Low-pass, shift and scale `estimate` so that it fits the low-passed `truth` best.

    Parameters
    ----------
    estimate : (H, W) tensor or array
        Restored image, in any unit and at any position, with wrap-around.
    truth : (H, W) tensor or array
        True image, in any unit.
    cutoff : float
        Highest frequency that is compared, diameter * pixel_scale / wavelength [cycles/pixel].

    Returns
    -------
    Tensor
        (H, W), on the pixels and in the unit of `truth`, float64 on the CPU. Compare it with `lowpass(truth, cutoff)`.

    Raises
    ------
    ValueError
        If the shapes differ, a value is not finite, the sum of `truth` is not positive, or `estimate` is zero below the
        cut-off.

    Examples
    --------
    >>> truth = torch.zeros(32, 32); truth[10:20, 12:18] = 1
    >>> aligned = align(3 * truth.roll((5, -2), (0, 1)), truth, cutoff=0.4)
    >>> bool((aligned - lowpass(truth.double(), 0.4)).abs().max() < 1e-6)
    True
    """
    estimate, truth = _checked(estimate, truth)
    reference, image = lowpass(truth, cutoff), lowpass(estimate, cutoff)
    if not float(image.norm()) > 0:
        raise ValueError("the estimate is zero below the cut-off: no gain fits it to the truth")
    image = shift(image, registration(image, reference))
    return image * ((image * reference).sum() / (image * image).sum())


def relative_error(estimate: Any, truth: Any, cutoff: float) -> float:
    """Return the relative error of a restoration up to the diffraction limit: 0 is perfect, 1 no better than nothing.

    It is ||align(estimate) - lowpass(truth)|| / ||lowpass(truth)||. Registration is much finer than the 1e-3 pixels
    that this needs. Arguments and errors are those of `align`.
    """
    reference = lowpass(_checked(estimate, truth)[1], cutoff)
    return float((align(estimate, truth, cutoff) - reference).norm() / reference.norm())


def ssim(estimate: Any, truth: Any, cutoff: float) -> float:
    """Return the structural similarity of the aligned estimate and the low-passed truth, 1 at best (scikit-image).

    Both are clipped to [0, the 99.5th percentile of the low-passed truth], which is also the data range, so that a few
    glints do not set the scale. Arguments and errors are those of `align`; images need at least 7 x 7 pixels.
    """
    with extra("data"):
        from skimage.metrics import structural_similarity

    aligned = align(estimate, truth, cutoff).numpy()
    reference = lowpass(_checked(estimate, truth)[1], cutoff).numpy()
    peak = float(np.percentile(reference, _PEAK_PERCENTILE))
    if peak <= 0:
        raise ValueError("fewer than 0.5 % of the pixels of the truth are positive: structural similarity needs more")
    similarity: Any = structural_similarity(aligned.clip(0, peak), reference.clip(0, peak), data_range=peak)
    return float(similarity)


def _checked(estimate: Any, truth: Any) -> tuple[Tensor, Tensor]:
    images = []
    for name, values in (("estimate", estimate), ("truth", truth)):
        image = as_tensor(values, "cpu").detach().double()
        if image.ndim != 2:
            raise ValueError(f"{name} has shape {tuple(image.shape)}: it must be one image, (rows, columns)")
        if not bool(torch.isfinite(image).all()):
            raise ValueError(f"{name} holds values that are not finite")
        images.append(image)
    if images[0].shape != images[1].shape:
        raise ValueError(
            f"estimate has shape {tuple(images[0].shape)} and truth {tuple(images[1].shape)}: they must be equal"
        )
    if not float(images[1].sum()) > 0:
        raise ValueError("the sum of truth is not positive: an image of light is needed")
    return images[0], images[1]


def _real(values: Any) -> Tensor:
    image = as_tensor(values)
    image = image if image.is_floating_point() or image.is_complex() else image.double()
    if image.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"image is {image.dtype}: float32 or float64 is needed, as FFTs know no half precision")
    return image


def _frequencies(shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    nu_y = torch.fft.fftfreq(shape[-2], dtype=dtype, device=device)
    nu_x = torch.fft.rfftfreq(shape[-1], dtype=dtype, device=device)
    return nu_y[:, None], nu_x


@torch.inference_mode(False)
@torch.enable_grad()
def registration(image: Tensor, reference: Tensor) -> Tensor:
    """Return the shift (dy, dx) of `image` that correlates best with `reference`.

    The FFT gives the best shift by whole pixels. From there a trust-region Newton method maximises the correlation, a
    trigonometric polynomial of the shift whose derivatives come from autograd. (scikit-image's phase_cross_correlation
    takes the largest modulus, so a negative image would match too, and finds 1e-3 pixels by brute force.)
    """
    image, reference = image.detach().clone(), reference.detach().clone()  # of inference mode, they know no gradients
    norm = float(image.norm() * reference.norm())
    rows, columns = image.shape
    correlation = torch.fft.irfft2(torch.fft.rfft2(reference) * torch.fft.rfft2(image).conj(), s=image.shape)
    dy, dx = divmod(int(correlation.argmax()), columns)
    start = np.array([dy if dy < rows / 2 else dy - rows, dx if dx < columns / 2 else dx - columns], float)

    def loss(offset: Tensor) -> Tensor:
        return -(shift(image, offset) * reference).sum() / norm

    def value_and_gradient(offset: np.ndarray) -> tuple[float, np.ndarray]:
        leaf = torch.from_numpy(offset.copy()).requires_grad_()
        value = loss(leaf)
        (gradient,) = torch.autograd.grad(value, leaf)
        return float(value.detach()), gradient.numpy()

    def hessian(offset: np.ndarray) -> np.ndarray:
        return torch.autograd.functional.hessian(loss, torch.from_numpy(offset.copy())).numpy()  # type: ignore[union-attr]

    options = {"initial_trust_radius": 0.25, "max_trust_radius": 0.5, "gtol": 1e-9}
    result = minimize(value_and_gradient, start, jac=True, hess=hessian, method="trust-exact", options=options)
    return torch.from_numpy(result.x)
