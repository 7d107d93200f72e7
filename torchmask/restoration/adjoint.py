"""The misfit of the exposure model to the frames, with its gradients and curvature by a hand-written adjoint.

They cost six FFTs per frame, two more for every further wavelength, and memory independent of the number of frames.
"""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.optics.unrounded import product, unrounded
from torchmask.restoration.background import Background
from torchmask.restoration.forward import ExposureModel, intensity
from torchmask.restoration.parallel import Map
from torchmask.restoration.pupil import OpenSamples

_PROBES = 4  # noise realisations per frame for the curvature


class DataFidelity(NamedTuple):
    """Half the weighted squared residuals (T,), and the gradients of their sum; None for those not requested.

    `weight_gradient` (P,) and `basis_gradient` (P, K) are those with respect to the pupil's samples.
    """

    value: Tensor
    object_gradient: Tensor | None
    aberration_gradient: Tensor | None
    weight_gradient: Tensor | None = None
    basis_gradient: Tensor | None = None


@torch.no_grad()
def data_fidelity(
    model: ExposureModel,
    image: Tensor,
    z: Tensor,
    frames: Tensor,
    precision: Tensor,
    *,
    want_object: bool = True,
    want_aberrations: bool = True,
    unit: Tensor | float = 1.0,
    samples: OpenSamples | None = None,
    want_samples: bool = False,
    parallel: Map = map,
) -> DataFidelity:
    """Return 1/2 sum precision (model + background - frames)^2 of every frame, and its gradients.

    Parameters
    ----------
    model : ExposureModel
        Model of the exposures.
    image : (H', W') tensor
        Object on the model's field.
    z : (T, K) tensor
        Parameters of the aberrations.
    frames : (T, H, W) tensor
        Exposures, in the unit of the object.
    precision : tensor that broadcasts to the frames' shape, with its first axis of length T or 1
        Inverse noise variance of each pixel, 0 where a pixel is not valid.
    want_object, want_aberrations : bool
        Which gradients to compute.
    unit : (T, 1, 1) tensor or float
        What a background of 1, if it is common to all frames, amounts to in each of them.
    samples : OpenSamples, optional
        Samples of the pupil, such as those of a moved one. None: those of the model.
    want_samples : bool
        Whether to compute the gradients with respect to the samples too.
    parallel : callable
        Function like `map`, which is applied to a few frames at a time.
    """
    shape = model.window.field.shape
    samples = model.pupil.samples() if samples is None else samples
    spectrum = model.spectrum(image)
    conjugate = spectrum.conj().resolve_conj()
    fields = samples.field(samples.phase(z))  # of all frames at once: few large operations instead of many small ones

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def make(part: slice) -> Tensor:
        transfer = torch.fft.rfft2(intensity(model.amplitude(samples, fields[part])))
        return model.window.crop(torch.fft.irfft2(transfer * spectrum, s=shape))

    background = model.background
    if background is Background.COMMON:  # it depends on all frames, so they are made once more below
        made = torch.cat(list(parallel(make, model.chunks(len(z)))))
        frames, background = frames - background.level(frames - made, precision, unit), Background.NONE

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def compare(part: slice) -> tuple[Tensor | None, ...]:
        field = fields[part]
        amplitude = model.amplitude(samples, field)
        transfer = torch.fft.rfft2(intensity(amplitude))
        weight = precision[part] if len(precision) > 1 else precision
        made = model.window.crop(torch.fft.irfft2(transfer * spectrum, s=shape))
        error = background.residual(frames[part] - made, weight)
        residual = error * -weight
        value = -0.5 * torch.linalg.vecdot(*unrounded(residual.flatten(1), error.flatten(1))).double()
        if not (want_object or want_aberrations):
            return value, None, None, None
        back = torch.fft.rfft2(residual, s=shape)
        by_object = torch.linalg.vecdot(transfer, back, dim=0) if want_object else None
        if not want_aberrations:
            return value, by_object, None, None
        by_psf = torch.fft.irfft2(back.mul_(conjugate), s=shape)
        back = pull_back_field(samples, amplitude.mul_(by_psf[:, None]))
        weights = _by_weights(samples, field, back) if want_samples else None
        return value, by_object, across(field, back), weights

    values, by_object, slopes, weights = zip(*parallel(compare, model.chunks(len(z))), strict=True)
    slope = torch.cat(slopes) if want_aberrations else None
    return DataFidelity(
        torch.cat(values),
        model.spectrum_adjoint(reduce(torch.add, by_object)).to(image.dtype) if want_object else None,
        None if slope is None else product(slope, samples.basis).to(z.dtype),
        reduce(torch.add, weights) if want_samples else None,
        product(slope.T, z.to(slope.dtype)) if want_samples and slope is not None else None,
    )


def pull_back(samples: OpenSamples, field: Tensor, amplitude: Tensor, psf_gradient: Tensor) -> Tensor:
    """Return the gradient (T, P) with respect to the phase from that with respect to the PSF (T, H', W')."""
    return across(field, pull_back_field(samples, amplitude * psf_gradient[:, None]))


def pull_back_field(samples: OpenSamples, by_amplitude: Tensor) -> Tensor:
    """Return half the gradient with respect to the pupil field (T, P), real and imaginary part as a complex number.

    `by_amplitude` (T, wavelength, H', W') is the focal amplitude times the gradient with respect to the PSF.
    """
    return torch.fft.ifft2(by_amplitude, norm="forward").flatten(1).index_select(1, samples.index)


def across(field: Tensor, back: Tensor) -> Tensor:
    """Return the gradient (T, P) with respect to the field's phase, from half of that with respect to the field."""
    return 2 * (back.imag * field.real - back.real * field.imag)


def along(field: Tensor, back: Tensor) -> Tensor:
    """Return the gradient (T, P) with respect to the logarithm of the field's modulus."""
    return 2 * (back.real * field.real + back.imag * field.imag)


def _by_weights(samples: OpenSamples, field: Tensor, back: Tensor) -> Tensor:
    """Return the gradient (P,) with respect to the weights, summed over the frames; 0 where a cell is closed."""
    slope = along(field, back).sum(0) / samples.weights
    return slope.where(samples.weights > 0, 0.0)


@torch.no_grad()
def curvature(
    model: ExposureModel, image: Tensor, z: Tensor, precision: Tensor, generator: torch.Generator
) -> tuple[Tensor, float]:
    """Return the diagonal of the Gauss-Newton Hessian of `data_fidelity`.

    It is given for each parameter (K,), averaged over frames, and for a pixel of the object, one number. J^T W J is the
    covariance of J^T W^(1/2) n with white noise n, so a few noise realisations per frame suffice for a diagonal that is
    averaged over frames (Bekas, Kokiopoulou & Saad, Appl. Numer. Math. 57, 1214, 2007).
    """
    shape, samples = model.window.field.shape, model.pupil.samples()
    conjugate = model.spectrum(image).conj().resolve_conj()
    total, pixel = torch.zeros_like(z[0]), 0.0
    for part in model.chunks(len(z)):
        field = samples.field(samples.phase(z[part]))
        amplitude = model.amplitude(samples, field)
        weight = (precision[part] if len(precision) > 1 else precision).expand(len(field), *model.window.grid.shape)
        for _ in range(_PROBES):
            noise = torch.randn(weight.shape, dtype=weight.dtype, device="cpu", generator=generator).to(weight)
            back = torch.fft.irfft2(torch.fft.rfft2(noise * weight.sqrt(), s=shape) * conjugate, s=shape)
            gradient = product(pull_back(samples, field, amplitude, back), samples.basis)
            total += (gradient**2).sum(0).to(z.dtype) / _PROBES
        energy = (intensity(amplitude) ** 2).sum((1, 2))
        pixel += float((energy * weight.mean((1, 2))).sum())
    return total / len(z), pixel
