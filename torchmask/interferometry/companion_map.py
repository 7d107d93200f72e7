"""Search for a companion in squared visibilities and closure phases: map, fit and detection limits."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import SIGNIFICANCE, DetectionLimits, search_offsets
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_model import PARAMETERS, PairResiduals, square
from torchmask.memory import require_memory
from torchmask.record import Brief

_PER_ELEMENT = 8  # points of the raster along the finest fringe
_WIDEST = 25  # maximum radius of the raster, in periods of the finest fringe
_STEPS = 40  # maximum number of Gauss-Newton steps for contrast and position
_LEAST_CURVATURE = 1e-12  # of the largest: below, the companion's position along some direction is unconstrained
_CHUNK = 1024  # positions at a time
_BYTES = 80  # of memory for each position: itself, its separation, and what is found there
_ERRORS_WITHIN = 1.5  # factor by which errors may be too small: 20 frames give them to 16 %, three times which is 1.5
_CHANCE = 5.0  # standard deviations of the chi-square that are put down to chance


@dataclass(frozen=True, eq=False, repr=False)
class CompanionMap(Brief):
    """Best-fitting contrast of a companion at each of M positions around a star, with its error.

    offsets : (M, 2) east and north [rad]
    contrast : (M,) flux over that of the star
    errors : (M,) rms error of the contrast, scaled up if the best companion leaves more than the measurement errors
    chi_square : (M,) chi-square with the companion
    least_chi_square : chi-square with the best companion, whose position need not be one of these
    star_chi_square : chi-square of the star alone
    degrees_of_freedom : number of independent measurements less three
    """

    offsets: Tensor
    contrast: Tensor
    errors: Tensor
    chi_square: Tensor
    least_chi_square: float
    star_chi_square: float
    degrees_of_freedom: int

    @property
    def significance(self) -> Tensor:
        """Significance (M,): root of the decrease of chi-square over the best reduced chi-square, if that is above 1.

        For faint companions it is contrast over error. It is negative where the contrast is.
        """
        left = _unexplained(self.least_chi_square, self.degrees_of_freedom)
        return self.contrast.sign() * ((self.star_chi_square - self.chi_square).clamp(min=0) / left).sqrt()

    @property
    def best(self) -> Tensor:
        """Contrast, east and north [rad] (3,) of the most significant companion of the map."""
        index = int(self.significance.argmax())
        return torch.cat([self.contrast[index, None], self.offsets[index]])

    def limits(self, annulus: float, significance: float = SIGNIFICANCE) -> DetectionLimits:
        """Return the contrast that equals `significance` errors, in annuli of width `annulus` [rad] around the star.

        The error of a limit combines its scatter within the annulus with the uncertainty of the errors themselves, if
        they were scaled by the residuals.
        """
        away = torch.linalg.vector_norm(self.offsets, dim=1)
        ring = (away / annulus).floor().long()
        places, limits, errors = [], [], []
        for number in ring.unique().tolist():
            here = significance * self.errors[ring == number]
            limit = float(here.square().mean().sqrt())
            own = limit / math.sqrt(2 * max(1, self.degrees_of_freedom))
            places.append(float(away[ring == number].mean()) / ARCSEC)
            limits.append(limit)
            errors.append(math.hypot(float(here.std(unbiased=False)), own))
        return DetectionLimits(np.array(places), np.array(limits), np.array(errors))


@dataclass(frozen=True, eq=False, repr=False)
class PairFit(Brief):
    """Best-fitting companion with its covariance.

    companion : (3,) contrast, east and north [rad]
    covariance : (3, 3) covariance, scaled up if the fit leaves more than the measurement errors
    chi_square : chi-square with the companion
    star_chi_square : chi-square of the star alone
    degrees_of_freedom : number of independent measurements less three
    """

    companion: Tensor
    covariance: Tensor
    chi_square: float
    star_chi_square: float
    degrees_of_freedom: int

    @property
    def significance(self) -> float:
        """Root of the decrease of chi-square over the reduced chi-square, if that is above 1."""
        left = _unexplained(self.chi_square, self.degrees_of_freedom)
        return math.sqrt(max(0.0, self.star_chi_square - self.chi_square) / left)

    @property
    def limit(self) -> float:
        """Chi-square up to which a star and a companion explain the measurements.

        It allows for chance, and for errors that are too small by up to half of what is given.
        """
        freedom = max(1, self.degrees_of_freedom)
        return _ERRORS_WITHIN**2 * (freedom + _CHANCE * math.sqrt(2 * freedom))

    @property
    def explained(self) -> bool:
        """Whether a star and a companion explain the measurements; if not, the companion means nothing."""
        return self.chi_square <= self.limit

    @property
    def detected(self) -> bool:
        """Whether the companion explains the measurements, gives light, and is worth `SIGNIFICANCE` standard errors."""
        return self.explained and self.significance >= SIGNIFICANCE and float(self.companion[0]) > 0


def raster(measured: Measurements, least: float | None = None, most: float | None = None) -> Tensor:
    """Return offsets (M, 2), (east, north) [rad], for `map_companions`: eight per period of the finest fringe.

    Parameters
    ----------
    measured : Measurements
        Measurements whose baselines set the step.
    least : float, optional
        Smallest separation [rad]. None: half the period of the finest fringe, below which contrast and separation are
        degenerate.
    most : float, optional
        Largest separation [rad]. None: half the period of the widest fringe, beyond which companions are aliased if the
        baselines form a lattice, but at most 25 periods of the finest.

    Raises
    ------
    ValueError
        Unless 0 <= least < most, and the raster has a point between them, and no more than memory holds.
    """
    least = measured.finest / 2 if least is None else least
    most = min(measured.widest / 2, _WIDEST * measured.finest) if most is None else most
    if not 0 <= least < most < math.inf:
        raise ValueError(
            f"separations from {least / ARCSEC:.4g} to {most / ARCSEC:.4g} arcsec: the first must be at least 0 and "
            "less than the second"
        )
    step = measured.finest / _PER_ELEMENT
    require_memory("the largest separation [arcsec]", most / ARCSEC, _BYTES * (2 * most / step + 1) ** 2, power=2)
    offsets = search_offsets(step / ARCSEC, least / ARCSEC, most / ARCSEC)
    if not len(offsets):
        raise ValueError(
            f"no point lies between {least / ARCSEC:.4g} and {most / ARCSEC:.4g} arcsec on a raster of "
            f"{step / ARCSEC:.4g} arcsec: give separations farther apart"
        )
    return offsets


def map_companions(measured: Measurements, offsets: Tensor | None = None) -> CompanionMap:
    """Fit the contrast of a companion at each of `offsets` (M, 2) [rad], (east, north); None: those of `raster`.

    Squared visibilities and closure phases are weighted by their covariances. If the residuals with the best companion
    exceed the measurement errors, the errors of the contrast are scaled up accordingly.

    Raises
    ------
    ValueError
        If there are fewer than 3 independent measurements, as a companion has 3 parameters, or all baselines have the
        same direction.

    Examples
    --------
    >>> from torchmask.interferometry.pair_model import pair_visibilities
    >>> baselines = 5 * torch.randn(30, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    >>> ones, none = torch.ones(30, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    >>> truth = torch.tensor([0.1, 2e-7, 1e-7], dtype=torch.float64)
    >>> vis2 = pair_visibilities(baselines / 2e-6, truth).abs() ** 2
    >>> seen = Measurements(
    ...     baselines, 2e-6 * ones, vis2, 0.01 * ones, None, none.view(0, 2, 2), none, none, none, None)
    >>> found = fit_pair(seen, map_companions(seen).best)
    >>> torch.allclose(found.companion.abs(), truth, rtol=1e-6)  # |V|^2 does not know the side
    True
    """
    problem = PairResiduals(measured)
    offsets = raster(measured) if offsets is None else offsets.double()
    parts = [problem.best_contrasts(places) for places in offsets.split(_CHUNK)]
    contrast, error, chi_square = (torch.cat(values) for values in zip(*parts, strict=True))
    nearest = int(chi_square.argmin())
    _, residual = problem.descend(torch.cat([contrast[nearest, None], offsets[nearest]]), _STEPS)
    least, freedom = min(float(chi_square.min()), square(residual)), problem.size - PARAMETERS
    star = square(problem.residuals(contrast.new_zeros(PARAMETERS)))
    error = error * math.sqrt(_unexplained(least, freedom))
    return CompanionMap(offsets, contrast, error, chi_square, least, star, freedom)


def fit_pair(measured: Measurements, start: Tensor, steps: int = _STEPS) -> PairFit:
    """Fit a companion to the measurements, from a start within half the finest fringe of it.

    Parameters
    ----------
    measured : Measurements
        Squared visibilities and closure phases.
    start : (3,) tensor
        Initial contrast, east and north [rad], such as `CompanionMap.best`.
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
    slopes, freedom = problem.slopes(found) * problem.unit, problem.size - PARAMETERS
    values, vectors = torch.linalg.eigh(slopes.T @ slopes)
    if not values[0] > _LEAST_CURVATURE * values[-1]:
        raise ValueError(
            "the measurements do not constrain a companion's position: baselines in more than one direction are needed"
        )
    scale = _unexplained(square(residual), freedom)
    covariance = scale * (vectors / values) @ vectors.T * problem.unit[:, None] * problem.unit
    star = square(problem.residuals(torch.zeros_like(found)))
    return PairFit(found, covariance, square(residual), star, freedom)


def _unexplained(chi_square: float, degrees_of_freedom: int) -> float:
    return max(1.0, chi_square / max(1, degrees_of_freedom))
