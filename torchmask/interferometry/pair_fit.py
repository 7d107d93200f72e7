"""Fit of a star and its companion to squared visibilities and closure phases, and what it says.

The rivals of a companion are the star alone and a uniform disc: a resolved star loses contrast on its long baselines
as a close pair does.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

import torch
from torch import Tensor

from torchmask.interferometry.companion_limits import SIGNIFICANCE
from torchmask.interferometry.disc_model import DiscFit, fit_disc
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_model import PARAMETERS, PairResiduals, square, unexplained
from torchmask.record import Brief

STEPS = 40  # maximum number of Gauss-Newton steps for contrast and position
RIVAL = 9.0  # chi-square by which a companion must be better than what it is told from: three standard errors
_WIDEST = 25  # maximum radius of a search, in periods of the finest fringe
_LEAST_CURVATURE = 1e-12  # of the largest: below, the companion's position along some direction is unconstrained
_EQUAL = 0.999  # brightest contrast at which its slopes are taken
_ERRORS_WITHIN = 1.5  # factor by which errors may be too small: 20 frames give them to 16 %, three times which is 1.5
_CHANCE = 5.0  # standard deviations of the chi-square that are put down to chance


class PairVerdict(Enum):
    """What measurements of a star show, see `PairFit.verdict`."""

    COMPANION = "companion"
    OUTSIDE = "outside"
    RESOLVED = "resolved"
    NONE = "none"
    NOT_EXPLAINED = "not explained"


@dataclass(frozen=True, eq=False, repr=False)
class PairFit(Brief):
    """Best-fitting companion with its covariance.

    companion : (3,) contrast, east and north [rad]
    covariance : (3, 3) covariance, scaled up if the fit leaves more than the measurement errors
    chi_square : chi-square with the companion
    star_chi_square : chi-square of the star alone
    disc : the uniform disc that fits best
    degrees_of_freedom : number of independent measurements less three
    separations : smallest and largest separation of the search [rad]
    """

    companion: Tensor
    covariance: Tensor
    chi_square: float
    star_chi_square: float
    disc: DiscFit
    degrees_of_freedom: int
    separations: tuple[float, float]

    @property
    def significance(self) -> float:
        """Root of the decrease of chi-square over the reduced chi-square, if that is above 1."""
        left = unexplained(self.chi_square, self.degrees_of_freedom)
        return math.sqrt(max(0.0, self.star_chi_square - self.chi_square) / left)

    @property
    def separation(self) -> float:
        """Separation of the companion [rad]."""
        return float(torch.linalg.vector_norm(self.companion[1:]))

    @property
    def limit(self) -> float:
        """Chi-square up to which a star and a companion explain the measurements.

        It allows for chance, and for errors that are too small by up to half of what is given.
        """
        freedom = max(1, self.degrees_of_freedom)
        return _ERRORS_WITHIN**2 * (freedom + _CHANCE * math.sqrt(2 * freedom))

    @property
    def verdict(self) -> PairVerdict:
        """What the measurements show.

        A `COMPANION` is worth `SIGNIFICANCE` standard errors and gives light, no uniform disc does as well, and it is
        in the searched annulus, or closer with a contrast that is known to as many of its errors. One `OUTSIDE` is all
        this, but elsewhere: beyond the search, or so close that contrast and separation are not told apart, as of a
        resolved star that is no uniform disc. `RESOLVED` is where a uniform disc does as well, within a chi-square of
        `RIVAL`, as of a resolved star or a closer pair, and `NONE` where the star alone does. `NOT_EXPLAINED` is what
        no star explains, with a companion or as a disc.
        """
        best = min(self.chi_square, self.disc.chi_square)
        if best > self.limit:
            return PairVerdict.NOT_EXPLAINED
        left = unexplained(best, self.degrees_of_freedom)
        if self.star_chi_square - best < SIGNIFICANCE**2 * left:
            return PairVerdict.NONE
        if self.disc.chi_square - self.chi_square < RIVAL * left:
            return PairVerdict.RESOLVED
        if not float(self.companion[0]) > 0:
            return PairVerdict.NONE
        return PairVerdict.COMPANION if self._located() else PairVerdict.OUTSIDE

    @property
    def explained(self) -> bool:
        """Whether a star explains the measurements, alone, with a companion or as a disc."""
        return self.verdict is not PairVerdict.NOT_EXPLAINED

    @property
    def detected(self) -> bool:
        """Whether there is a companion."""
        return self.verdict is PairVerdict.COMPANION

    @property
    def shows_pair(self) -> bool:
        """Whether a companion, in the searched annulus or elsewhere, is what fits best."""
        return self.verdict in (PairVerdict.COMPANION, PairVerdict.OUTSIDE)

    def _located(self) -> bool:
        least, most = self.separations
        sure = float(self.companion[0]) >= SIGNIFICANCE * float(self.covariance[0, 0].sqrt())
        return self.separation <= most and (self.separation >= least or sure)


def separations(measured: Measurements, least: float | None = None, most: float | None = None) -> tuple[float, float]:
    """Return the smallest and largest separation of a search [rad], as given or, for None, those of `raster`."""
    least = measured.finest / 2 if least is None else least
    most = min(measured.widest / 2, _WIDEST * measured.finest) if most is None else most
    return least, most


def fit_pair(
    measured: Measurements, start: Tensor, least: float | None = None, most: float | None = None, steps: int = STEPS
) -> PairFit:
    """Fit a companion to the measurements, from a start within half the finest fringe of it.

    Parameters
    ----------
    measured : Measurements
        Squared visibilities and closure phases.
    start : (3,) tensor
        Initial contrast, east and north [rad], such as `CompanionMap.best`.
    least, most : float, optional
        Smallest and largest separation of the search that the start is of [rad], as `raster` takes them. The fit may
        leave them, and its verdict says so.
    steps : int
        Maximum number of Gauss-Newton steps; a step that makes the fit worse is halved.

    Raises
    ------
    ValueError
        If there are fewer than 3 independent measurements, or all baselines have the same direction.

    Examples
    --------
    Closure phases of three triangles are enough to locate a faint companion, if the start is near it:

    >>> from torchmask.interferometry.measurements import Measurements
    >>> from torchmask.interferometry.pair_model import pair_visibilities
    >>> sides = 5 * torch.randn(3, 2, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> ones, none = torch.ones(3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    >>> truth = torch.tensor([0.1, 6e-8, 3e-8], dtype=torch.float64)
    >>> three = torch.cat([sides, -sides.sum(1, keepdim=True)], 1) / 2e-6
    >>> phases = pair_visibilities(three.flatten(0, 1), truth).view(3, 3).prod(1).angle()
    >>> seen = Measurements(none.view(0, 2), none, none, none, None, sides, 2e-6 * ones, phases, 0.01 * ones, None)
    >>> torch.allclose(fit_pair(seen, truth * torch.tensor([0.9, 1.05, 0.95]).double()).companion, truth, rtol=1e-4)
    True
    """
    problem = PairResiduals(measured)
    found, residual = problem.descend(start.double(), steps)
    freedom = problem.size - PARAMETERS
    covariance = _covariance(problem, found) * unexplained(square(residual), freedom)
    star = square(problem.residuals(torch.zeros_like(found)))
    bounds = separations(measured, least, most)
    return PairFit(found, covariance, square(residual), star, fit_disc(problem), freedom, bounds)


def _covariance(problem: PairResiduals, companion: Tensor) -> Tensor:
    """Return the covariance (3, 3) of a companion for errors of the measurements as told.

    At a contrast of 1 |V|^2 do not change with it to first order, so it is taken one error of the contrast below.
    """
    away = companion.clone()
    away[0] = min(float(away[0]), _EQUAL)
    found = _inverse(problem, away)
    error, room = float(found[0, 0].sqrt()), 1 - float(away[0])
    if error <= room:
        return found
    away[0] = max(0.0, 1 - math.sqrt(error * room))
    return _inverse(problem, away)


def _inverse(problem: PairResiduals, companion: Tensor) -> Tensor:
    """Return the inverse (3, 3) of the curvature. Raises ValueError if the position is unconstrained."""
    slopes = problem.slopes(companion) * problem.unit
    values, vectors = torch.linalg.eigh(slopes.T @ slopes)
    if not values[0] > _LEAST_CURVATURE * values[-1]:
        raise ValueError(
            "the measurements do not constrain a companion's position: baselines in more than one direction are needed"
        )
    return (vectors / values) @ vectors.T * problem.unit[:, None] * problem.unit
