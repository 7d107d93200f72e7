"""The uniform disc that fits measurements best: the rival of a companion."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from torchmask.interferometry.disc_visibility import FIRST_NULL, disc_slopes, disc_visibilities
from torchmask.interferometry.pair_model import PairResiduals, square, unexplained

_PER_ELEMENT = 16  # diameters tried per period of the finest fringe
_WIDEST = 25  # largest diameter tried, in periods of the finest fringe
_EXACT = 1e-9  # of the finest fringe, to which the diameter is fitted


@dataclass(frozen=True)
class DiscFit:
    """Uniform disc that fits measurements best.

    diameter : angular diameter [rad], 0 for a point
    error : its rms error [rad], scaled up if the disc leaves more than the measurement errors; infinite for a point
    chi_square : what the disc leaves
    """

    diameter: float
    error: float
    chi_square: float


def fit_disc(problem: PairResiduals) -> DiscFit:
    """Fit a uniform disc to the measurements of a problem, from points up to 25 periods of the finest fringe.

    Examples
    --------
    >>> from torchmask.interferometry.measurements import Measurements
    >>> baselines = 5 * torch.randn(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> ones, none = torch.ones(30, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    >>> vis2 = disc_visibilities(baselines / 2e-6, 1e-7) ** 2
    >>> star = PairResiduals(Measurements(
    ...     baselines, 2e-6 * ones, vis2, 0.01 * ones, None, none.view(0, 2, 2), none, none, none, None))
    >>> round(fit_disc(star).diameter, 12)
    1e-07
    """
    finest = float(problem.unit[1])
    lengths = torch.linalg.vector_norm(torch.cat([problem.frequencies, problem.sides]), dim=1)
    largest = min(FIRST_NULL / float(lengths.min()), _WIDEST * finest)
    step = finest / _PER_ELEMENT
    tried = torch.arange(0, largest + step, step, dtype=torch.float64)
    nearest = float(tried[disc_residuals(problem, tried).square().sum(-1).argmin()])

    def cost(diameter: float) -> float:
        return square(disc_residuals(problem, torch.tensor(diameter, dtype=torch.float64)))

    ends = (max(0.0, nearest - step), nearest + step)
    refined: Any = minimize_scalar(cost, bounds=ends, method="bounded", options={"xatol": _EXACT * finest})
    found = min((0.0, nearest, float(refined.x)), key=cost)
    curvature, left = square(disc_slope(problem, found)), cost(found)
    error = math.sqrt(unexplained(left, problem.size - 1) / curvature) if curvature > 0 else math.inf
    return DiscFit(found, error, left)


def disc_residuals(problem: PairResiduals, diameters: Tensor) -> Tensor:
    """Return whitened differences (..., K) of measurements and uniform discs of `diameters` (...) [rad]."""
    return problem.left_by(*(disc_visibilities(each, diameters) + 0j for each in (problem.frequencies, problem.sides)))


def disc_slope(problem: PairResiduals, diameter: float) -> Tensor:
    """Return the derivative (K,) of the whitened model in the diameter; closure phases do not change with it."""
    frequencies = problem.frequencies
    by_diameter = 2 * disc_visibilities(frequencies, diameter) * disc_slopes(frequencies, diameter)
    return problem.whiten(by_diameter, by_diameter.new_zeros(len(problem.sides) // 3))
