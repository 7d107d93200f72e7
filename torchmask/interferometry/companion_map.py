"""Search for a companion in squared visibilities and closure phases: the map of all places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import search_offsets
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_fit import RIVAL, STEPS, PairFit, separations
from torchmask.interferometry.pair_model import PARAMETERS, PairResiduals, square, unexplained
from torchmask.memory import require_memory
from torchmask.record import Brief

_PER_ELEMENT = 8  # points of the raster along the finest fringe
_CHUNK = 1024  # positions at a time
_APART = 0.5  # of the finest fringe, from which on two places are different
_PLACES = 4  # number of other places that are fitted
_BYTES = 80  # of memory for each position: itself, its separation, and what is found there


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
        left = unexplained(self.least_chi_square, self.degrees_of_freedom)
        return self.contrast.sign() * ((self.star_chi_square - self.chi_square).clamp(min=0) / left).sqrt()

    @property
    def best(self) -> Tensor:
        """Contrast, east and north [rad] (3,) of the most significant companion of the map."""
        index = int(self.significance.argmax())
        return torch.cat([self.contrast[index, None], self.offsets[index]])


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
    least, most = separations(measured, least, most)
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
    >>> from torchmask.interferometry.pair_fit import fit_pair
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
    _, residual = problem.descend(torch.cat([contrast[nearest, None], offsets[nearest]]), STEPS)
    least, freedom = min(float(chi_square.min()), square(residual)), problem.size - PARAMETERS
    star = square(problem.residuals(contrast.new_zeros(PARAMETERS)))
    error = error * math.sqrt(unexplained(least, freedom))
    return CompanionMap(offsets, contrast, error, chi_square, least, star, freedom)


def rival_place(measured: Measurements, found: CompanionMap, fit: PairFit) -> tuple[Tensor, float] | None:
    """Return the companion (3,) that fits best elsewhere, and its chi-square; None if none is as good as that of `fit`.

    As good is what leaves a chi-square that is larger by less than `RIVAL`, scaled as errors are. Elsewhere is half a
    period of the finest fringe away from it and, without closure phases, from its opposite.

    Examples
    --------
    Baselines of whole metres at 2 micrometres see the same every 2 microradians:

    >>> from torchmask.interferometry.pair_fit import fit_pair
    >>> from torchmask.interferometry.pair_model import pair_visibilities
    >>> baselines = torch.tensor([[1, 0], [0, 1], [3, 1], [1, 2], [2, 3]], dtype=torch.float64)
    >>> ones, none = torch.ones(5, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    >>> truth = torch.tensor([0.1, 6e-7, 3e-7], dtype=torch.float64)
    >>> vis2 = pair_visibilities(baselines / 2e-6, truth).abs() ** 2
    >>> seen = Measurements(
    ...     baselines, 2e-6 * ones, vis2, 0.01 * ones, None, none.view(0, 2, 2), none, none, none, None)
    >>> found = map_companions(seen, raster(seen, most=2e-6))
    >>> place, chi_square = rival_place(seen, found, fit_pair(seen, truth, most=2e-6))
    >>> turns = (place[1:] - truth[1:]) / 2e-6, (place[1:] + truth[1:]) / 2e-6
    >>> any(bool((each - each.round()).abs().max() < 1e-3) for each in turns), chi_square < 1e-3
    (True, True)
    >>> rival_place(seen, map_companions(seen), fit_pair(seen, truth)) is None
    True
    """
    problem = PairResiduals(measured)
    apart, (least, most) = _APART * measured.finest, fit.separations
    same = [fit.companion[1:]] + [-fit.companion[1:]] * (len(measured.closure_phases) == 0)
    tried, best = list(same), None
    for _ in range(_PLACES):
        free = (_distance(found.offsets, tried) > apart) & (found.contrast > 0)
        if not bool(free.any()):
            break
        index = int(torch.where(free, found.chi_square, torch.inf).argmin())
        place, residual = problem.descend(torch.cat([found.contrast[index, None], found.offsets[index]]), STEPS)
        tried.append(found.offsets[index])
        inside = least <= float(torch.linalg.vector_norm(place[1:])) <= most
        if inside and place[0] > 0 and float(_distance(place[None, 1:], same)) > apart:
            best = min(best or (place, math.inf), (place, square(residual)), key=lambda each: each[1])
    left = unexplained(fit.chi_square, fit.degrees_of_freedom)
    return best if best is not None and best[1] - fit.chi_square < RIVAL * left else None


def _distance(offsets: Tensor, places: Sequence[Tensor]) -> Tensor:
    """Return the distances (M,) of offsets (M, 2) from the nearest of some places (2,)."""
    return torch.linalg.vector_norm(offsets[:, None] - torch.stack(list(places)), dim=-1).amin(1)
