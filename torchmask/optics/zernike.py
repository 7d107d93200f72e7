"""Zernike modes of a sub-aperture, and the phase that is a sum of them.

Modes have Noll's numbers (J. Opt. Soc. Am. 66, 207, 1976), from 1 (piston), and unit rms over the open area. On a clear
disc they are Noll's polynomials; on other shapes, the same polynomials orthonormalised over the open area in Noll order
(Mahajan & Dai, J. Opt. Soc. Am. A 24, 2994, 2007).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.inputs import require_masks, require_tensor
from torchmask.optics.pupil import Aperture, PupilSamples, can_be_read
from torchmask.optics.unrounded import product, unrounded

_INDEPENDENT = 1e-9  # smallest rms of the part of a mode that is orthogonal to the modes before it


def noll(j: int) -> tuple[int, int]:
    """Return radial order n and azimuthal order m of Noll mode `j` >= 1: cosine for m > 0, sine for m < 0.

    >>> noll(1), noll(2), noll(3), noll(11)
    ((0, 0), (1, 1), (1, -1), (4, 0))
    """
    j = whole_number("Noll's mode number", j, note=" (1 is piston)")
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2  # 1 to n + 1 within the row
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def zernike(points: Tensor, n_modes: int) -> Tensor:
    """Return Noll modes 1 to `n_modes` (..., J), of unit rms over the disc, at `points` (..., 2).

    Points are (x, y) in units of the radius. Modes are polynomials in x and y, so they are smooth everywhere and
    continue beyond the disc. The radial part is r^m P_k^(0, m)(2 r^2 - 1), by the three-term recurrence of Jacobi
    polynomials, which is accurate at high orders, even in float32.

    Raises ValueError if `n_modes` is not a whole number of at least 1.

    >>> zernike(torch.tensor([0.5, 0.0]), 3)
    tensor([1., 1., 0.])
    """
    n_modes = whole_number("n_modes", n_modes)
    x, y = points.unbind(-1)
    argument = 2 * (x**2 + y**2) - 1
    orders = [noll(j) for j in range(1, n_modes + 1)]
    max_order = orders[-1][0]
    cosine, sine = [torch.ones_like(x)], [torch.zeros_like(x)]  # r^m cos(m theta), r^m sin(m theta)
    for _ in range(max_order):
        c, s = cosine[-1], sine[-1]
        cosine.append(x * c - y * s)
        sine.append(x * s + y * c)
    radial = [_jacobi(argument, m, (max_order - m) // 2) for m in range(max_order + 1)]
    modes = []
    for n, m in orders:
        angular = cosine[m] if m >= 0 else sine[-m]
        norm = math.sqrt(n + 1) if m == 0 else math.sqrt(2 * n + 2)
        modes.append(norm * radial[abs(m)][(n - abs(m)) // 2] * angular)
    return torch.stack(modes, dim=-1)


def _jacobi(q: Tensor, m: int, degree: int) -> list[Tensor]:
    """Return the Jacobi polynomials P_k^(0, m)(q), k = 0 to `degree`."""
    p = [torch.ones_like(q), ((m + 2) * q - m) / 2]
    for k in range(2, degree + 1):
        a = 2 * k + m
        linear = (a - 1) * (a * (a - 2) * q - m**2) * p[-1]
        p.append((linear - 2 * (k - 1) * (k + m - 1) * a * p[-2]) / (2 * k * (k + m) * (a - 2)))
    return p


def aperture_modes(aperture: Aperture, points: Tensor, n_modes: int) -> Tensor:
    """Return the modes (..., J) of one sub-aperture, of unit rms over its open area, at `points` (..., 2) [m].

    Points are relative to the centre. Raises ValueError if `n_modes` is not a whole number of at least 1, or if the
    shape, such as a thin ring, is too narrow to tell so many modes apart.
    """
    shape, radius = aperture.shape, aperture.outer_diameter / 2
    modes = zernike(points / radius, n_modes)
    if shape.has_noll_modes:
        return modes
    nodes, weights = shape.quadrature(2 * noll(n_modes)[0], aperture.subaperture_diameter)
    triangle = torch.linalg.qr(weights.sqrt()[:, None] * zernike(nodes / radius, n_modes)).R
    diagonal = triangle.diagonal()
    if float(diagonal.abs().min()) < _INDEPENDENT:
        raise ValueError(f"{n_modes} modes are not independent on {shape!r}, which is too thin: lower n_modes")
    combine = torch.linalg.inv(triangle * diagonal.sign()[:, None])
    return product(modes, combine.to(modes))


def zernike_basis(samples: PupilSamples, aperture: Aperture, n_modes: int) -> Tensor:
    """Return the modes of every sub-aperture on its pupil samples, (..., N, P, J).

    They are differentiable in the centres through `samples.offsets`. Samples on the rim may lie slightly outside, where
    the polynomials continue smoothly. Raises ValueError if `n_modes` is not a whole number of at least 1.
    """
    return aperture_modes(aperture, samples.offsets, n_modes)


class ZernikePhase(nn.Module):
    """Phase that is a sum of Zernike modes, on the pupil samples that `PSF` takes.

    Parameters
    ----------
    aperture : Aperture
        Mask or full pupil.
    grid : Grid
        Pixels and wavelength of the image.
    n_modes : int
        Number of modes per sub-aperture, from Noll mode 1 (piston).
    oversampling : int
        Oversampling of the pupil, the same as that of the `PSF`.

    Raises
    ------
    ValueError
        If `n_modes` is not a whole number of at least 1, or the aperture cannot be sampled on the grid; in a call, if
        coefficients have a wrong shape.
    TypeError
        If coefficients are no tensor, or have another dtype than the aperture.

    Notes
    -----
    `forward(coefficients)` takes (..., [frame,] N, J) [rad rms] and returns the phase (..., [frame,] N, P) [rad]. If
    coefficients have an axis more than the centres (..., N, 2), the one before N is the frame. The basis is cached and
    evaluated again, differentiably, if the centres require a gradient or have moved.

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> mask = SparseAperture([[0.0, 0.3], [0.2, -0.2]], 0.2, 1.0)
    >>> phase = ZernikePhase(mask, Grid.nyquist(1.0, 550e-9, 64), n_modes=3)
    >>> phase(torch.zeros(5, 2, 3, dtype=torch.float64)).shape
    torch.Size([5, 2, 121])
    """

    basis: Tensor
    basis_centers: Tensor

    def __init__(self, aperture: Aperture, grid: Grid, n_modes: int, oversampling: int = 1) -> None:
        super().__init__()
        self.n_modes: int = whole_number("n_modes", n_modes)
        self.aperture: Aperture = aperture
        self.grid: Grid = grid
        self.oversampling: int = oversampling
        with torch.inference_mode(False), torch.no_grad():  # it may train later, whatever mode it is made in
            self.register_buffer("basis", self._evaluate(), persistent=False)
            self.register_buffer("basis_centers", aperture.centers.detach().clone(), persistent=False)

    def _evaluate(self) -> Tensor:
        return zernike_basis(self.aperture.samples(self.grid, self.oversampling), self.aperture, self.n_modes)

    def forward(self, coefficients: Tensor) -> Tensor:
        require_tensor("coefficients", coefficients)
        expected = (self.aperture.n_subapertures, self.n_modes)
        if coefficients.shape[-2:] != expected:
            raise ValueError(
                f"coefficients has shape {tuple(coefficients.shape)}: the last two axes must be (sub-apertures, "
                f"modes) = {expected}"
            )
        centers = self.aperture.centers
        moved = centers.requires_grad or not can_be_read(centers) or not torch.equal(centers, self.basis_centers)
        basis = self._evaluate() if moved else self.basis
        if coefficients.dtype != basis.dtype:
            raise TypeError(
                f"coefficients are {coefficients.dtype} and the aperture is {basis.dtype}: convert one of them, for "
                "example by aperture.to(torch.float32)"
            )
        require_masks("coefficients", coefficients, basis.shape[:-3])
        if coefficients.ndim >= basis.ndim:
            basis = basis.unsqueeze(-4)
        phase = torch.einsum("...npj,...nj->...np", *unrounded(basis, coefficients))
        return phase.to(basis.dtype)
