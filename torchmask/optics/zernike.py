"""Zernike modes of a sub-aperture and the phase they make.

Modes are numbered as by Noll (J. Opt. Soc. Am. 66, 207, 1976), from 1 (piston), and have unit mean square over the
open area. On a clear disc they are Noll's polynomials; on a hexagon or an obstructed disc the same polynomials made
orthonormal over that area, in Noll order (Mahajan & Dai, J. Opt. Soc. Am. A 24, 2994, 2007).
"""

from __future__ import annotations

import math
from numbers import Integral

import torch
from torch import Tensor, nn

from torchmask.grid import Grid
from torchmask.optics.pupil import Aperture, PupilSamples, can_be_read

_INDEPENDENT = 1e-9  # rms of a mode, of unit rms over the disc, that the modes before it do not explain


def noll(j: int) -> tuple[int, int]:
    """Radial order n and signed azimuthal order m of Noll mode `j` >= 1: cosine for m > 0, sine for m < 0.

    >>> noll(1), noll(2), noll(3), noll(11)
    ((0, 0), (1, 1), (1, -1), (4, 0))
    """
    _require_modes(j)
    n = (math.isqrt(8 * j - 7) - 1) // 2
    place = j - n * (n + 1) // 2  # 1 to n + 1 within the row
    m = 2 * (place // 2) if n % 2 == 0 else 2 * ((place - 1) // 2) + 1
    return n, m if j % 2 == 0 else -m


def zernike(points: Tensor, n_modes: int) -> Tensor:
    """Noll modes 1 to `n_modes` at `points` (..., 2), (x, y) in units of the radius: (..., J), unit rms over the disc.

    Polynomials in x and y: smooth everywhere, the centre included, and continued as they are beyond the disc. The
    radial part is r^m P_k^(0, m)(2 r^2 - 1) by the three-term recurrence of Jacobi polynomials, which keeps its
    accuracy at high orders, in float32 too.

    Raises ValueError if `n_modes` is not a whole number of at least 1.

    >>> zernike(torch.tensor([0.5, 0.0]), 3)
    tensor([1., 1., 0.])
    """
    _require_modes(n_modes)
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
    """Jacobi polynomials P_k^(0, m)(q), k = 0 to `degree`."""
    p = [torch.ones_like(q), ((m + 2) * q - m) / 2]
    for k in range(2, degree + 1):
        a = 2 * k + m
        linear = (a - 1) * (a * (a - 2) * q - m**2) * p[-1]
        p.append((linear - 2 * (k - 1) * (k + m - 1) * a * p[-2]) / (2 * k * (k + m) * (a - 2)))
    return p


def aperture_modes(aperture: Aperture, points: Tensor, n_modes: int) -> Tensor:
    """Modes of one sub-aperture at `points` (..., 2) [m] from its centre: (..., J), unit rms over its open area.

    Raises ValueError if `n_modes` is not a whole number of at least 1, or a ring is too thin to tell so many apart.
    """
    shape, radius = aperture.shape, aperture.outer_diameter / 2
    modes = zernike(points / radius, n_modes)
    if shape.has_noll_modes:
        return modes
    nodes, weights = shape.quadrature(2 * noll(n_modes)[0], aperture.subaperture_diameter)
    triangle = torch.linalg.qr(weights.sqrt()[:, None] * zernike(nodes / radius, n_modes)).R
    diagonal = triangle.diagonal()
    if float(diagonal.abs().min()) < _INDEPENDENT:
        raise ValueError(f"{n_modes} modes are not independent on so thin a shape, {shape!r}: fewer modes are needed")
    combine = torch.linalg.inv(triangle * diagonal.sign()[:, None])
    return modes @ combine.to(modes)


def zernike_basis(samples: PupilSamples, aperture: Aperture, n_modes: int) -> Tensor:
    """Modes of every sub-aperture on its pupil samples: (..., N, P, J).

    Differentiable in the centres through `samples.offsets`. Samples on the rim may lie a little outside, where the
    polynomials go on smoothly.

    Raises ValueError if `n_modes` is not a whole number of at least 1.
    """
    return aperture_modes(aperture, samples.offsets, n_modes)


class ZernikePhase(nn.Module):
    """Phase of Zernike modes on the pupil samples that `PSF` takes.

    Parameters
    ----------
    aperture : Aperture
    grid : Grid
    n_modes : int
        Modes per sub-aperture, Noll 1 (piston) to `n_modes`.
    oversampling : int
        As for `PSF`.

    Raises
    ------
    ValueError
        If `n_modes` is not a whole number of at least 1, or the aperture cannot be sampled on the grid.

    Notes
    -----
    `forward(coefficients)` takes (..., [frame,] N, J) in rad rms and returns the phase (..., [frame,] N, P) [rad]:
    where there are more axes than the centres (..., N, 2) have, the last one before N is the frame. The basis is kept
    while the centres stay where they were, and evaluated anew, differentiably, when they train or have moved.

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
        _require_modes(n_modes)
        self.aperture: Aperture = aperture
        self.grid: Grid = grid
        self.n_modes: int = n_modes
        self.oversampling: int = oversampling
        with torch.no_grad():
            self.register_buffer("basis", self._evaluate(), persistent=False)
        self.register_buffer("basis_centers", aperture.centers.detach().clone(), persistent=False)

    def _evaluate(self) -> Tensor:
        return zernike_basis(self.aperture.samples(self.grid, self.oversampling), self.aperture, self.n_modes)

    def forward(self, coefficients: Tensor) -> Tensor:
        expected = (self.aperture.n_subapertures, self.n_modes)
        if coefficients.shape[-2:] != expected:
            raise ValueError(
                f"coefficients has shape {tuple(coefficients.shape)}: the last two axes must be (sub-apertures, "
                f"modes) = {expected}"
            )
        centers = self.aperture.centers
        moved = centers.requires_grad or not can_be_read(centers) or not torch.equal(centers, self.basis_centers)
        basis = self._evaluate() if moved else self.basis
        if coefficients.ndim >= basis.ndim:
            basis = basis.unsqueeze(-4)
        return torch.einsum("...npj,...nj->...np", basis, coefficients)


def _require_modes(n_modes: int) -> None:
    if not isinstance(n_modes, Integral) or n_modes < 1:
        raise ValueError(f"mode number or count is {n_modes}: it must be a whole number of at least 1 (1 is piston)")
