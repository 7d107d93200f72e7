"""Search for a companion in squared visibilities and closure phases: the map of all places."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import search_offsets
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_fit import STEPS, separations
from torchmask.interferometry.pair_model import PARAMETERS, PairResiduals, square, unexplained
from torchmask.memory import require_memory
from torchmask.record import Brief

_PER_ELEMENT = 8  # points of the raster along the finest fringe
_CHUNK = 1024  # positions at a time
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
