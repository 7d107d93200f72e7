"""Optical transfer functions of sampled pupils, and of unaberrated sub-apertures in closed form."""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.fourier import transform_images
from torchmask.optics.phasor import phasor
from torchmask.optics.psf import PSF
from torchmask.optics.pupil import Aperture


class OTF(PSF):
    """Optical transfer functions of an aperture on a grid: the DFT of its `PSF`, 1 at zero frequency.

    Arguments and errors are those of `PSF`. `forward(phase)` returns a complex tensor (..., H, W) in FFT order, at the
    frequencies of `grid.frequencies`.

    Examples
    --------
    >>> from torchmask.optics.aperture import FullAperture
    >>> grid = Grid.nyquist(1.0, 550e-9, 64)
    >>> otf = OTF(FullAperture(1.0), grid, oversampling=4)()
    >>> round(float(otf[0, 0].real), 12), round(float(otf[0, 16].real), 2)  # closed form: 0.391
    (1.0, 0.39)
    """

    def forward(self, phase: Tensor | None = None) -> Tensor:
        return transform_images(torch.fft.fft2, super().forward(phase))


def analytic_otf(aperture: Aperture, grid: Grid, pistons: Tensor | None = None) -> Tensor:
    """Return the closed-form OTF of sub-apertures with one piston each: the sum of the overlaps of all pairs.

    `pistons` (..., [frame,] N) [rad] is None for a perfect wavefront; with as many axes as the centres (..., N, 2), the
    one before N is the frame. The result, complex (..., [frame,] H, W) in FFT order, wraps around the frequency torus
    as that of a sampled PSF does. It follows from the autocorrelation theorem.
    """
    aperture.require_sampling(grid)
    centers = aperture.centers
    if pistons is not None and pistons.ndim >= centers.ndim:
        centers = centers.unsqueeze(-3)
    nu_y, nu_x = grid.frequencies(centers.dtype, centers.device)
    n = aperture.n_subapertures
    total = None
    for m in range(n):
        for k in range(n):
            baseline = (centers[..., m, :] - centers[..., k, :])[..., None, None, :] / grid.period
            dx = nu_x - baseline[..., 0]
            dy = nu_y - baseline[..., 1]
            dx, dy = dx - dx.detach().round(), dy - dy.detach().round()
            shift = torch.stack(torch.broadcast_tensors(dx, dy), dim=-1) * grid.period
            term = aperture.shape.otf(shift, aperture.subaperture_diameter) / n + 0j
            if pistons is not None:
                # An image moves by +s for a phase that grows along +x: exp(-2 pi i nu s) at nu = c_m - c_k.
                delta = pistons[..., k] - pistons[..., m]
                term = term * phasor(delta)[..., None, None]
            total = term if total is None else total + term
    assert total is not None
    return total
