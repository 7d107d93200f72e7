"""Optical transfer functions: of sampled pupils, and in closed form of clear sub-apertures."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import Aperture
from torchmask.optics.psf import PSF


class _DiscOTF(torch.autograd.Function):
    """OTF of a disc with its own derivatives: those of the textbook form are NaN at 0 and at the edge."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        x = x.clamp(max=1)
        return (2 / math.pi) * (torch.arccos(x) - x * torch.sqrt((1 - x) * (1 + x)))

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        inside = x.clamp(max=1)
        return grad[0] * (-4 / math.pi) * torch.sqrt((1 - inside) * (1 + inside))


def disc_otf(x: Tensor) -> Tensor:
    """OTF of a clear disc at `x` >= 0 times its cut-off: (2/pi)(acos x - x sqrt(1 - x^2)), 0 beyond 1.

    Any shape; same shape, dtype and device out. The derivative is -(4/pi) sqrt(1 - x^2) (Goodman, Introduction to
    Fourier Optics, section 6.3).
    """
    return _DiscOTF.apply(x)  # type: ignore[no-any-return]


def hexagon_otf(shift: Tensor, orientation: float = 0.0) -> Tensor:
    """OTF of a regular hexagon at `shift` (..., 2), in flat-to-flat widths: the normalised overlap area.

    Two shifted copies of a hexagon meet in a hexagon with the same three edge directions and half-widths
    (1 - |n_k . shift|) / 2. In the coordinates u = n_0 . x, v = n_2 . x its area is a rectangle less the corners
    that |u + v| <= w_1 cuts off, which is exact.
    """
    angles = orientation + torch.arange(3, dtype=shift.dtype, device=shift.device) * math.pi / 3
    normals = torch.stack([angles.cos(), angles.sin()], dim=-1)
    w0, w1, w2 = ((1 - (shift[..., None, :] * normals).sum(-1).abs()) / 2).clamp(min=0).unbind(-1)

    def square(t: Tensor) -> Tensor:
        return t.clamp(min=0) ** 2

    cut = w0 + w2 - w1
    corners = square(cut) - square(cut - 2 * w0) - square(cut - 2 * w2) + square(cut - 2 * w0 - 2 * w2)
    return (4 * w0 * w2 - corners) / 0.75


def subaperture_otf(displacement: Tensor, aperture: Aperture) -> Tensor:
    """Overlap of one sub-aperture with itself displaced by `displacement` (..., 2) [m], 1 at zero.

    Discs and hexagons, without central obstruction. The gradient at zero displacement is 0.
    """
    if aperture.central_obstruction > 0:
        raise ValueError("the closed-form OTF knows clear sub-apertures only: central_obstruction must be 0")
    if aperture.shape == "hexagon":
        return hexagon_otf(displacement / aperture.subaperture_diameter, aperture.orientation)
    squared = (displacement**2).sum(-1)
    distance = torch.where(squared > 0, squared, 1).sqrt() * (squared > 0)
    return disc_otf(distance / aperture.subaperture_diameter)


class OTF(PSF):
    """Optical transfer functions, complex, in FFT order with value 1 at zero frequency: the DFT of `PSF`.

    Same arguments and errors as `PSF`; `forward(phase)` returns (..., H, W), frequencies in cycles/pixel as in
    `grid.frequencies`.

    Examples
    --------
    >>> from torchmask.optics.aperture import FullAperture
    >>> grid = Grid.nyquist(1.0, 550e-9, 64)
    >>> otf = OTF(FullAperture(1.0), grid, oversampling=4)()
    >>> float(otf[0, 0].real), round(float(otf[0, 16].real), 2)  # at half the cut-off the closed form is 0.391
    (1.0, 0.39)
    """

    def forward(self, phase: Tensor | None = None) -> Tensor:
        return torch.fft.fft2(super().forward(phase))


def analytic_otf(aperture: Aperture, grid: Grid, pistons: Tensor | None = None) -> Tensor:
    """OTF of clear sub-apertures with a piston each, in closed form: the sum of the overlaps of all pairs.

    `pistons` (..., [frame,] N) [rad], or None for a perfect wavefront: where there are more axes than the centres
    (..., N, 2) have, the last one before N is the frame. Returns complex (..., [frame,] H, W) in FFT order, wrapped on
    the frequency torus as a sampled PSF is. Source: DESIGN, section 2; the autocorrelation theorem.
    """
    grid.require_sampling(aperture.extent)
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
            overlap = subaperture_otf(torch.stack(torch.broadcast_tensors(dx, dy), dim=-1) * grid.period, aperture)
            term = overlap / n + 0j
            if pistons is not None:
                # An image moves by +s for a phase that grows along +x: exp(-2 pi i nu s) at nu = c_m - c_k.
                delta = pistons[..., k] - pistons[..., m]
                term = term * torch.polar(torch.ones_like(delta), delta)[..., None, None]
            total = term if total is None else total + term
    assert total is not None
    return total
