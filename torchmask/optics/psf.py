"""Point-spread functions of sampled pupils."""

from __future__ import annotations

import math
from functools import partial

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.fourier import transform_images
from torchmask.optics.inputs import require_masks, require_real
from torchmask.optics.phasor import phasor
from torchmask.optics.pupil import Aperture, PupilSamples


def fold(images: Tensor, shape: tuple[int, int]) -> Tensor:
    """Fold images (..., a H, b W) into a field (..., H, W): light beyond a border re-enters on the opposite side.

    Raises ValueError unless a and b are whole numbers.
    """
    rows, columns = images.shape[-2:]
    if rows % shape[0] or columns % shape[1]:
        raise ValueError(
            f"images of {rows} x {columns} pixels do not fold into {shape[0]} x {shape[1]}: whole multiples are needed"
        )
    tiles = images.unflatten(-1, (-1, shape[1])).unflatten(-3, (-1, shape[0]))
    return tiles.sum(dim=(-4, -2))


def psf_from_samples(samples: PupilSamples, phase: Tensor | None = None) -> Tensor:
    """Return the PSF of a sampled pupil on its whole raster, with unit sum and its origin at [0, 0].

    PSF = |FFT(P exp(i phase))|^2 with `phase` (..., [frame,] N, P) [rad] on the samples (..., N, P); if it has an axis
    more than they have, the one before N is the frame. The result is (..., [frame,] rows, columns).
    """
    psf = focal_intensity(samples, phase)
    return psf / psf.sum(dim=(-2, -1), keepdim=True)


def focal_intensity(samples: PupilSamples, phase: Tensor | None = None) -> Tensor:
    """Return |FFT(P exp(i phase))|^2, of which `psf_from_samples` makes a PSF of unit sum.

    Light that the phase scatters beyond the raster is missing, so the remaining image keeps its brightness when the
    phase changes. If all light lies within the raster, the sum is that of the squared open fractions.
    """
    weights, index = samples.weights, samples.index
    if phase is not None:
        _check(phase, weights)
    if phase is not None and phase.ndim > weights.ndim:
        weights, index = weights.unsqueeze(-3), index.unsqueeze(-3)
    if phase is None:
        field = weights.to(torch.complex64 if weights.dtype == torch.float32 else torch.complex128)
    else:
        field = weights * phasor(phase)
    field, index = field.flatten(-2), index.expand(field.shape).flatten(-2)
    pupil = torch.zeros(*field.shape[:-1], math.prod(samples.raster), dtype=field.dtype, device=field.device)
    pupil = pupil.scatter_add(-1, index, field).unflatten(-1, samples.raster)
    amplitude = transform_images(partial(torch.fft.fft2, norm="ortho"), pupil)
    return (amplitude.real**2 + amplitude.imag**2) / _cell_transfer(samples)


def _check(phase: Tensor, weights: Tensor) -> None:
    """Raise TypeError or ValueError unless a phase (..., [frame,] N, P) suits samples of `weights` (..., N, P)."""
    require_real("phase", phase)
    needed = tuple(weights.shape[-2:])
    if any(n not in (1, m) for n, m in zip(phase.shape[-2:], needed, strict=False)):
        raise ValueError(
            f"phase has shape {tuple(phase.shape)}: its last two axes must be (sub-apertures, samples) = {needed}, on "
            "samples of the same aperture, grid and oversampling"
        )
    require_masks("phase", phase, weights.shape[:-2])


def _cell_transfer(samples: PupilSamples) -> Tensor:
    """Return the attenuation (rows, columns) of the image by the cells of the pupil samples.

    Open fractions are averages of the pupil over a cell, so the amplitude of the image is multiplied by the transform
    of that cell, a sinc that falls to 2/pi at the border. Dividing it out halves the error of the OTF of a smooth
    wavefront. In turn, scattered light is amplified near the border if the raster undersamples the turbulence. This
    lowers the OTF of a full pupil at D/r0 = 7 by 2.7 % on a raster of 128 and by 0.3 % on one of 512, which is why a
    simulation oversamples.
    """
    dtype, device = samples.weights.dtype, samples.weights.device
    rows, columns = (torch.sinc(torch.fft.fftfreq(n, dtype=dtype, device=device)) ** 2 for n in samples.raster)
    return rows[:, None] * columns


class PSF(nn.Module):
    """Point-spread functions of an aperture on a grid, with unit sum and their origin at pixel [0, 0] (FFT order).

    Parameters
    ----------
    aperture : Aperture
        Mask or full pupil.
    grid : Grid
        Pixels and wavelength of the image.
    oversampling : int
        Factor by which the pupil is sampled more finely. The PSF is computed for a field wider by this factor and
        folded into the grid, so no light is lost. The error of the OTF falls as 1 / (oversampling * grid size).

    Raises
    ------
    ValueError
        If the grid aliases the image or a sub-aperture is narrower than two pupil samples; in a call, if the phase lies
        on other samples or its leading axes are not those of a population of masks.
    TypeError
        In a call, if the phase is no tensor of float32 or float64.

    Notes
    -----
    `forward(phase)` takes the phase [rad] on `samples()`, (..., [frame,] N, P), as `ZernikePhase` and `TurbulencePhase`
    return it, or None for a perfect wavefront, and returns (..., [frame,] H, W). A phase of
    2 pi s x pixel_scale / wavelength moves the image by +s pixels.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)
    >>> psf = PSF(mask, Grid.nyquist(1.0, 550e-9, 64))
    >>> piston = torch.rand(5, 3, 1, dtype=torch.float64)  # [rad], for five frames
    >>> images = psf(piston.expand(-1, -1, psf.samples().weights.shape[-1]))
    >>> images.shape, bool(torch.isclose(images.sum(), torch.tensor(5.0, dtype=torch.float64)))
    (torch.Size([5, 64, 64]), True)
    """

    def __init__(self, aperture: Aperture, grid: Grid, oversampling: int = 1) -> None:
        super().__init__()
        self.aperture: Aperture = aperture
        self.grid: Grid = grid
        self.oversampling: int = oversampling
        self.samples()  # raises errors of the grid here rather than at the first forward

    def samples(self) -> PupilSamples:
        """Return the pupil samples on which `forward` expects a phase."""
        return self.aperture.samples(self.grid, self.oversampling)

    def forward(self, phase: Tensor | None = None) -> Tensor:
        return fold(psf_from_samples(self.samples(), phase), self.grid.shape)
