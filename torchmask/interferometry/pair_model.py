"""Visibility model of a star and its companion, and residuals of measurements from it.

A star of flux 1 and a companion of flux c at s = (east, north) have the visibility
V = (1 + c exp(-2 pi i f . s)) / (1 + c) at the frequency f = (u, v) / wavelength (Berger & Segransan 2007, New
Astronomy Reviews 51, 576). Contrasts below 0 are allowed, as noise can give them where there is no companion.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.interferometry.closures import closure_combinations
from torchmask.interferometry.measurements import Measurements
from torchmask.optics.phasor import phasor

PARAMETERS = 3  # of a companion: contrast, east and north
_FAINTEST, _BRIGHTEST = -0.5, 0.98  # range of contrasts of a map; at 1 the derivatives in the contrast vanish
_SWAPPED = 2.0  # the brightest on the way of a fit, whose stars then change their roles
_STEPS = 12  # number of Gauss-Newton steps for the contrast at each position
_HALVINGS = 20  # maximum number of halvings of a step that makes a fit worse
_TINY = torch.finfo(torch.float64).tiny  # curvature where fringes repeat exactly, and any contrast fits
_ENOUGH = 1e-6  # decrease of chi-square per measurement at which a fit ends
_LEAST_WIDTH = 1e-6  # of the baselines, over their length: below, they have one direction
_LEAST_EIGENVALUE = 1e-6  # of a correlation matrix, over its largest: below, measurements are redundant


def pair_visibilities(frequencies: Tensor, companion: Tensor) -> Tensor:
    """Return complex visibilities (..., F) of a star and companion (..., 3) at frequencies (F, 2) [cycles per radian].

    Examples
    --------
    A companion as bright as the star, half a fringe away, cancels the fringe:

    >>> place = torch.tensor([1.0, 5e-7, 0.0], dtype=torch.float64)
    >>> found = pair_visibilities(torch.tensor([[1e6, 0.0]], dtype=torch.float64), place)
    >>> bool(found.abs().max() < 1e-12)
    True
    """
    contrast, turns = companion[..., :1], companion[..., 1:] @ frequencies.T
    return (1 + contrast * phasor(-2 * math.pi * turns)) / (1 + contrast)


class PairResiduals:
    """Whitened residuals of measurements, from which redundant combinations of correlated ones are removed."""

    size: int
    unit: Tensor  # (3,) units of a companion's parameters: contrast 1, and the finest fringe
    frequencies: Tensor  # (B, 2) of the squared visibilities [cycles per radian]
    sides: Tensor  # (3 C, 2) of the sides of all triangles [cycles per radian]

    def __init__(self, measured: Measurements) -> None:
        self._seen = measured
        self.frequencies, self.sides = measured.frequencies, measured.triangle_frequencies.flatten(0, 1)
        self.unit = torch.tensor([1.0, measured.finest, measured.finest], dtype=torch.float64)
        every = torch.eye(len(measured.vis2), dtype=torch.float64)
        self._vis2 = _whitening(measured.vis2_errors, measured.vis2_correlation, every)
        closing = closure_combinations(measured)
        self._closures = _whitening(measured.closure_errors, measured.closure_correlation, closing)
        self.size = self._vis2.shape[1] + self._closures.shape[1]
        if self.size < PARAMETERS:
            raise ValueError(
                f"there are {self.size} independent measurements: a companion's contrast and position need {PARAMETERS}"
            )
        long, wide = torch.linalg.svdvals(torch.cat([self.frequencies, self.sides])).tolist()
        if not wide > _LEAST_WIDTH * long:
            raise ValueError("all baselines have one direction: a companion's position needs more than one direction")

    def residuals(self, companion: Tensor) -> Tensor:
        """Return whitened differences (..., K) of measurements and model, for companions (..., 3)."""
        return self.left_by(*(pair_visibilities(each, companion) for each in (self.frequencies, self.sides)))

    def left_by(self, visibilities: Tensor, sides: Tensor) -> Tensor:
        """Return whitened differences (..., K) of measurements and any model.

        The model is its complex visibilities (..., B) at `frequencies`, and (..., 3 C) at `sides`.
        """
        away = self._seen.closure_phases - sides.unflatten(-1, (-1, 3)).prod(-1).angle()
        return self.whiten(self._seen.vis2 - visibilities.abs() ** 2, torch.atan2(away.sin(), away.cos()))

    def whiten(self, vis2: Tensor, phases: Tensor) -> Tensor:
        """Return independent numbers of variance 1 (..., K) for differences of |V|^2 (..., B) and phases (..., C)."""
        return torch.cat([vis2 @ self._vis2, phases @ self._closures], -1)

    def slopes(self, companion: Tensor) -> Tensor:
        """Return derivatives (K, 3) of the whitened model in the companion (3,)."""
        (of_vis2, vis2_turns), (of_phases, phase_turns) = self._slopes(companion)
        sides = phase_turns[:, None] * self.sides
        vis2 = torch.cat([of_vis2[:, None], vis2_turns[:, None] * self.frequencies], 1)
        phases = torch.cat([of_phases[:, None], sides], 1).unflatten(0, (-1, 3)).sum(1)
        return torch.cat([self._vis2.T @ vis2, self._closures.T @ phases])

    def descend(self, start: Tensor, steps: int) -> tuple[Tensor, Tensor]:
        """Fit a companion by Gauss-Newton steps from `start` (3,); return it and its residuals (K,).

        Its contrast is 1 at most: the brighter one is the star.
        """
        found, residual = start, self.residuals(start)
        for _ in range(steps):
            slopes = self.slopes(found) * self.unit
            change = self.unit * torch.linalg.lstsq(slopes, residual[:, None]).solution[:, 0]
            for _ in range(_HALVINGS):
                moved = found + change
                moved[0] = moved[0].clamp(max=_SWAPPED)
                after = self.residuals(moved)
                if moved[0] >= _FAINTEST and square(after) < square(residual):
                    break
                change = change / 2
            else:
                break
            gained = square(residual) - square(after)
            found, residual = moved, after
            if gained < _ENOUGH * self.size:
                break
        if found[0] > 1:
            found = torch.cat([1 / found[:1], -found[1:]])
        return found, residual

    def best_contrasts(self, offsets: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fit the contrast at offsets (M, 2), starting from 0; return contrast, error and chi-square, (M,) each."""
        companion = torch.cat([offsets.new_zeros(len(offsets), 1), offsets], 1)
        for step in range(_STEPS + 1):
            (of_vis2, _), (of_phases, _) = self._slopes(companion)
            slope = self.whiten(of_vis2, of_phases.unflatten(-1, (-1, 3)).sum(-1))
            residual, curvature = self.residuals(companion), slope.square().sum(1)
            if step < _STEPS:
                change = (slope * residual).sum(1) / curvature.clamp(min=_TINY)
                companion[:, 0] = (companion[:, 0] + change).clamp(_FAINTEST, _BRIGHTEST)
        return companion[:, 0], curvature.rsqrt(), residual.square().sum(1)

    def _slopes(self, companion: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """Return derivatives of |V|^2 (..., B), and of the phases of all sides of triangles (..., 3 C).

        They are those in the contrast, and the factor of the frequency in those in the position. Closed forms are used
        because forward differentiation of complex numbers takes far longer.
        """
        c = companion[..., :1]
        turns = 2 * math.pi * (companion[..., 1:] @ self.frequencies.T)
        by_contrast = 2 * (1 - c) * (turns.cos() - 1) / (1 + c) ** 3
        by_turn = -2 * c * turns.sin() / (1 + c) ** 2
        sides = -2 * math.pi * (companion[..., 1:] @ self.sides.T)
        wave = phasor(sides)
        ratio = wave / (1 + c * wave)
        return (by_contrast, 2 * math.pi * by_turn), (ratio.imag, -2 * math.pi * c * ratio.real)


def square(residual: Tensor) -> float:
    """Return the chi-square of residuals (K,)."""
    return float(residual.square().sum())


def unexplained(chi_square: float, degrees_of_freedom: int) -> float:
    """Return the reduced chi-square if it is above 1: the factor by which squared errors grow."""
    return max(1.0, chi_square / max(1, degrees_of_freedom))


def _whitening(errors: Tensor, correlation: Tensor | None, combinations: Tensor) -> Tensor:
    """Return the matrix (M, K) that turns residuals (..., M) into independent ones of unit variance.

    They are those of `combinations` (M, L), K <= L <= M.
    """
    if correlation is None:
        return (1 / errors).diag()
    covariance = combinations.T @ (correlation * errors[:, None] * errors) @ combinations
    scale = covariance.diagonal().rsqrt()
    values, vectors = torch.linalg.eigh(covariance * scale[:, None] * scale)
    kept = values > _LEAST_EIGENVALUE * values[-1]
    return combinations @ (scale[:, None] * vectors[:, kept] * values[kept].rsqrt())
