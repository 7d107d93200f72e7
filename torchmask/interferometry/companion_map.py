"""A companion looked for in squared visibilities and closure phases: a map, a fit, and how faint one would be found."""

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
from torchmask.record import Brief

_PER_ELEMENT = 8  # points of the raster along the finest fringe
_WIDEST = 25  # finest fringes from the star to the border of the raster, at most
_STEPS = 40  # of Gauss-Newton for contrast and place
_LEAST_CURVATURE = 1e-12  # over the largest: below, a companion's place along some direction is not told
_CHUNK = 1024  # places at a time


@dataclass(frozen=True, eq=False, repr=False)
class CompanionMap(Brief):
    """The best contrast of a companion at each of M places around a star, with its error.

    offsets : (M, 2) east and north [rad]
    contrast, errors : (M,) flux over that of the star, and its rms, which grows with what the best companion leaves
        beyond the errors of the measurements
    chi_square : (M,) with the companion
    least_chi_square : with the best one, whose place need not be one of these
    star_chi_square : without one
    degrees_of_freedom : how many independent numbers were measured, less three
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
        """(M,) root of what a companion takes off chi-square, over what the best one leaves of a degree of freedom.

        Of faint companions that is contrast over error. Negative where the contrast is.
        """
        left = _unexplained(self.least_chi_square, self.degrees_of_freedom)
        return self.contrast.sign() * ((self.star_chi_square - self.chi_square).clamp(min=0) / left).sqrt()

    @property
    def best(self) -> Tensor:
        """(3,) contrast, east and north of the most significant companion of the map."""
        index = int(self.significance.argmax())
        return torch.cat([self.contrast[index, None], self.offsets[index]])

    def limits(self, annulus: float, significance: float = SIGNIFICANCE) -> DetectionLimits:
        """The contrast that is `significance` errors, in rings around the star `annulus` wide [rad].

        The error of a limit is how much the limit differs along the ring, together with what the number of
        measurements leaves of the error's own certainty, if residuals had to tell it.
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
    """A companion and how well the measurements tell it.

    companion : (3,) contrast, east and north [rad]
    covariance : (3, 3), which grows with what the fit leaves beyond the errors of the measurements
    chi_square, star_chi_square : with the companion and without
    degrees_of_freedom : independent numbers that were measured, less three
    """

    companion: Tensor
    covariance: Tensor
    chi_square: float
    star_chi_square: float
    degrees_of_freedom: int

    @property
    def significance(self) -> float:
        """Root of what the companion takes off chi-square, over what it leaves of a degree of freedom."""
        left = _unexplained(self.chi_square, self.degrees_of_freedom)
        return math.sqrt(max(0.0, self.star_chi_square - self.chi_square) / left)


def raster(measured: Measurements, least: float | None = None, most: float | None = None) -> Tensor:
    """Offsets (M, 2), (east, north) [rad], for `map_companions`: eight along the finest fringe.

    Parameters
    ----------
    measured : Measurements
    least, most : float, optional
        Separations that bound it [rad]. None: half the finest fringe, within which contrast and separation can hardly
        be told apart, and half the widest, since what lies beyond looks like something nearer where baselines form a
        lattice; but no more than 25 of the finest.

    Raises
    ------
    ValueError
        Unless 0 <= least < most, and the raster has a place between them.
    """
    least = measured.finest / 2 if least is None else least
    most = min(measured.widest / 2, _WIDEST * measured.finest) if most is None else most
    if not 0 <= least < most:
        raise ValueError(
            f"separations from {least / ARCSEC:.4g} to {most / ARCSEC:.4g} arcsec: the first must not be negative, and "
            "less than the second"
        )
    offsets = search_offsets(measured.finest / _PER_ELEMENT / ARCSEC, least / ARCSEC, most / ARCSEC)
    if not len(offsets):
        raise ValueError(
            f"no place lies between {least / ARCSEC:.4g} and {most / ARCSEC:.4g} arcsec on a raster of "
            f"{measured.finest / _PER_ELEMENT / ARCSEC:.4g} arcsec: look farther apart"
        )
    return offsets


def map_companions(measured: Measurements, offsets: Tensor | None = None) -> CompanionMap:
    """The best contrast of a companion at each of `offsets` (M, 2) [rad], (east, north); None: those of `raster`.

    Squared visibilities and closure phases count by their covariances. Where a model of a star with the best companion
    of the map leaves more than the errors say, errors of the contrast grow with what it leaves.

    Raises
    ------
    ValueError
        If fewer numbers were measured than a companion has, 3.

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
    """The companion (3,) that explains the measurements best, from one within half the finest fringe of it.

    Parameters
    ----------
    measured : Measurements
    start : (3,) tensor
        Contrast, east and north [rad], as `CompanionMap.best`.
    steps : int
        Of Gauss-Newton, at most; a step that makes the fit worse is halved.

    Raises
    ------
    ValueError
        If fewer numbers were measured than a companion has, 3, or all baselines lie along one line.

    Examples
    --------
    Closure phases of three triangles tell where a faint companion is, as a start near it is enough:

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
            "the measurements do not tell where a companion is: they need baselines in more than one direction"
        )
    scale = _unexplained(square(residual), freedom)
    covariance = scale * (vectors / values) @ vectors.T * problem.unit[:, None] * problem.unit
    star = square(problem.residuals(torch.zeros_like(found)))
    return PairFit(found, covariance, square(residual), star, freedom)


def _unexplained(chi_square: float, degrees_of_freedom: int) -> float:
    return max(1.0, chi_square / max(1, degrees_of_freedom))
