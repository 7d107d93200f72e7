"""Fourier transforms of the Zernike modes of a sub-aperture, which the covariance of turbulence is made of."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import numpy as np
import torch
from torch import Tensor

from torchmask.optics.phasor import phasor
from torchmask.optics.pupil import Aperture
from torchmask.optics.telescope_pupil import TelescopePupil
from torchmask.optics.vanes import Spider, edges
from torchmask.optics.zernike import aperture_modes, noll

Transforms = Callable[[Tensor, int], Tensor]
_SPARE = 16  # nodes, or degrees, beyond those of the fastest wave, after which errors are rounding


def mode_transforms(aperture: Aperture, n_modes: int, highest: float) -> Transforms:
    """Return a function for the Fourier transforms of the first modes of one sub-aperture.

    It takes ascending frequencies |f| (R,) [cycles/m], with pi |f| outer_diameter at most `highest`, and a number A of
    uniform angles on half a turn, and returns the transforms (R, A, J). They are trigonometric polynomials in angle, of
    which A has to be larger than the degree.
    """
    order, diameter = noll(n_modes)[0], aperture.outer_diameter
    degree = partial(_degree, order, diameter)
    if isinstance(aperture.shape, TelescopePupil):
        circles = _circles(aperture, aperture.shape.spider, n_modes, highest)
        return lambda frequency, n_angles: _of_circles(*circles, frequency, degree(frequency), n_angles)
    points, weights = aperture.shape.quadrature(math.ceil(highest) + order + _SPARE, aperture.subaperture_diameter)
    modes = weights[:, None] * aperture_modes(aperture, points, n_modes)  # (Q, J)
    if aperture.shape.is_round:  # the azimuthal order of the modes is enough
        return lambda frequency, n_angles: _of_points(points, modes, frequency, order + 2, n_angles)
    return lambda frequency, n_angles: _of_points(points, modes, frequency, degree(frequency), n_angles)


def directions(n_angles: int) -> Tensor:
    """Return unit vectors (A, 2) at uniform angles on half a turn."""
    angle = math.pi / n_angles * torch.arange(n_angles, dtype=torch.float64, device="cpu")
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def _degree(order: int, diameter: float, frequency: Tensor) -> int:
    """Return the number of terms that transforms at frequencies up to the last have in angle, on either side."""
    return math.ceil(math.pi * float(frequency[-1]) * diameter) + order + _SPARE + 4


def _of_points(points: Tensor, modes: Tensor, frequency: Tensor, n_known: int, n_angles: int) -> Tensor:
    """Return the transforms (R, A, J) of weighted `modes` (Q, J) at `points` (Q, 2), by summation.

    They are evaluated at only `n_known` angles and interpolated to the many that a long baseline needs.
    """
    phase = 2 * math.pi * frequency[:, None, None] * (directions(n_known) @ points.T)  # (R, known, Q)
    half = torch.complex(phase.cos() @ modes, phase.sin() @ modes)  # half the work of complex modes
    series = torch.fft.fft(torch.cat([half, half.conj()], dim=1), dim=1, norm="forward")
    return _summed(series[:, :n_known], series[:, n_known:], n_angles)


def _of_circles(radius: Tensor, content: Tensor, frequency: Tensor, n_known: int, n_angles: int) -> Tensor:
    """Return the transforms (R, A, J) of what `_circles` returns.

    By the series of Jacobi and Anger, exp(i x cos(t - u)) is the sum over m of i^m J_m(x) exp(i m (t - u)).
    """
    turn = math.pi / n_known * torch.arange(2 * n_known, dtype=torch.float64, device="cpu")
    waves = phasor(2 * math.pi * (frequency[:, None] * radius)[..., None] * turn.sin())  # (R, C, 2 known)
    bessel = torch.fft.fft(waves, norm="forward").real[..., :n_known].permute(2, 0, 1)  # J_m, (known, R, C)
    parts = bessel @ torch.view_as_real(content[:n_known]).flatten(2)  # half the work of complex Bessel functions
    negative = torch.view_as_complex(parts.unflatten(2, (-1, 2))).transpose(0, 1)  # of exp(-i m u), (R, known, J)
    sign = 1.0 - 2.0 * (torch.arange(n_known, device="cpu") % 2)
    return _summed(negative.conj() * sign[:, None], negative[:, 1:].flip(1), n_angles)


def _summed(first: Tensor, last: Tensor, n_angles: int) -> Tensor:
    """Return trigonometric polynomials at uniform angles of half a turn (R, A, J).

    Coefficients are `first` (R, K, J) from degree 0 up, and `last` (R, K', J) up to degree -1.
    """
    padded = first.new_zeros(len(first), 2 * n_angles, first.shape[-1])
    padded[:, : first.shape[1]] = first
    padded[:, -last.shape[1] :] = last
    return torch.fft.ifft(padded, dim=1, norm="forward")[:, :n_angles]


def _circles(aperture: Aperture, spider: Spider, n_modes: int, highest: float) -> tuple[Tensor, Tensor]:
    """Return radii [m] (C,) of circles, and the content (M, C, J) of the open arcs of each.

    The content of order m is i^m times the weighted integral of each mode times exp(i m t) over angle t. The open arcs
    between two vanes end where these do, so that this integral is a sum of sines over angles for each of the few
    azimuthal orders of the modes; only radii need a quadrature.
    """
    order, radius = noll(n_modes)[0], aperture.outer_diameter / 2
    n_orders = math.ceil(highest) + order + _SPARE + 5
    along, weights, arcs = _arcs(spider, highest, order)
    r = torch.hypot(along, along.new_tensor(spider.half_width))  # (C,), in units of the pupil's radius
    turn = math.pi / (order + 1) * torch.arange(2 * order + 2, dtype=torch.float64, device="cpu")
    points = radius * r[:, None, None] * torch.stack([turn.cos(), turn.sin()], -1)  # (C, 2 order + 2, 2)
    modes = torch.fft.fft(aperture_modes(aperture, points, n_modes).double(), dim=1, norm="forward")
    modes = torch.cat([modes[:, -order:], modes[:, : order + 1]] if order else [modes[:, :1]], 1)  # (C, 2 order + 1, J)
    k = torch.arange(-order, n_orders + order, dtype=torch.float64, device="cpu")
    middle = torch.from_numpy(np.add(spider.angles, np.divide(spider.gaps(), 2)))
    wave = phasor(k[:, None] * middle)  # (K, V)
    sines = torch.sinc(arcs[:, None] * k[:, None] / (2 * math.pi)) * arcs[:, None]  # (C, K, V)
    opened = (wave * sines).sum(-1).unfold(1, 2 * order + 1, 1)  # (C, M, 2 order + 1)
    content = (opened * (weights / edges(spider).area)[:, None, None]) @ modes  # (C, M, J)
    quarter = phasor(math.pi / 2 * torch.arange(n_orders, dtype=torch.float64, device="cpu"))
    return radius * r, (quarter[:, None] * content).transpose(0, 1).contiguous()


def _arcs(spider: Spider, highest: float, order: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return nodes (C,) along the edge of a vane, their weights as circles, and the open angles (C, V) after each vane.

    Everything is smooth in the distance along a vane's edge, between the places where neighbouring vanes meet or leave
    the obstruction, with a branch point half a vane's width off its origin: panels widen with the distance from there.
    """
    half, end = spider.half_width, math.sqrt(1 - spider.half_width**2)
    leaves = math.sqrt(max(spider.obstruction**2 - half**2, 0.0))
    starts = [max(leaves, corner) for corner in spider.corners()]
    nodes, weights = [], []
    breaks = [*sorted(set(starts)), end]
    low = breaks[0]
    for high in breaks[1:]:
        while low < high:
            top = min(low + math.hypot(low, half), high)
            n = math.ceil(highest * (top - low) + order / 2) + _SPARE
            x, w = np.polynomial.legendre.leggauss(n)
            nodes.append(low + (top - low) * (x + 1) / 2)
            weights.append((top - low) / 2 * w * nodes[-1])  # r dr, as r^2 is the sum of the squares
            low = top
    along = torch.from_numpy(np.concatenate(nodes))
    hidden = torch.atan2(along.new_tensor(half), along)[:, None]
    arcs = along.new_tensor(spider.gaps()) - 2 * hidden
    arcs = torch.where(along[:, None] > along.new_tensor(starts), arcs, 0.0)
    return along, torch.from_numpy(np.concatenate(weights)), arcs
