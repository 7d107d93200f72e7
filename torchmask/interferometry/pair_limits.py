"""How faint a further companion may be, in squared visibilities and closure phases, beside what they show."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import SIGNIFICANCE, DetectionLimits
from torchmask.interferometry.disc_model import disc_slope
from torchmask.interferometry.disc_visibility import disc_visibilities
from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_fit import PairFit, PairVerdict
from torchmask.interferometry.pair_model import PARAMETERS, PairResiduals, pair_visibilities, unexplained
from torchmask.optics.phasor import phasor

_CHUNK = 1024  # positions at a time
_BLIND = 1e-6  # of the slope, that is left beside the known parameters: below, it is rounding


def pair_limits(
    measured: Measurements, fit: PairFit, offsets: Tensor, annulus: float, significance: float = SIGNIFICANCE
) -> DetectionLimits:
    """Return the contrast that equals `significance` errors, in annuli of width `annulus` [rad] around the star.

    It is that of a further companion beside what the fit shows: a companion, a resolved star, or else the star alone,
    whose parameters are fitted together with the contrast. One as bright as a limit is found about half of the time, as
    chance makes it brighter or fainter by one error. Places within half the finest fringe of a known companion or,
    without closure phases, of its opposite do not count, as the two are not told apart there.

    The error of a limit combines its scatter within the annulus with the uncertainty of the errors themselves, if they
    were scaled by the residuals.

    Parameters
    ----------
    measured : Measurements
        The measurements of the fit.
    fit : PairFit
        Result of `fit_pair`.
    offsets : (M, 2) tensor
        Places (east, north) of the further companion [rad], such as `CompanionMap.offsets`.
    annulus : float
        Width of an annulus [rad].
    significance : float
        Number of errors.
    """
    offsets = _apart(measured, fit, offsets.double())
    errors = contrast_errors(measured, fit, offsets)
    away = torch.linalg.vector_norm(offsets, dim=1)
    ring = (away / annulus).floor().long()
    places, limits, scatter = [], [], []
    for number in ring.unique().tolist():
        here = significance * errors[ring == number]
        limit = float(here.square().mean().sqrt())
        own = limit / math.sqrt(2 * max(1, fit.degrees_of_freedom))
        places.append(float(away[ring == number].mean()) / ARCSEC)
        limits.append(limit)
        scatter.append(math.hypot(float(here.std(unbiased=False)), own))
    return DetectionLimits(np.array(places), np.array(limits), np.array(scatter))


def _apart(measured: Measurements, fit: PairFit, offsets: Tensor) -> Tensor:
    """Return the offsets that are apart from the companion, if there is one."""
    if not fit.shows_pair:
        return offsets
    known = torch.stack([fit.companion[1:]] + [-fit.companion[1:]] * (len(measured.closure_phases) == 0))
    return offsets[torch.cdist(offsets, known).amin(1) > measured.finest / 2]


def contrast_errors(measured: Measurements, fit: PairFit, offsets: Tensor) -> Tensor:
    """Return rms errors (M,) of the contrast of a faint further companion at `offsets` (M, 2) [rad]."""
    problem = PairResiduals(measured)
    shown = _shown(problem, fit)
    directions = torch.linalg.qr(shown.slopes).Q
    parts = []
    for places in offsets.split(_CHUNK):
        slope = _slopes(problem, shown, places)
        free = slope - (slope @ directions) @ directions.T
        own, whole = (torch.linalg.vector_norm(each, dim=1) for each in (free, slope))
        parts.append(torch.where(own > _BLIND * whole, own, 0.0).reciprocal())
    return torch.cat(parts) * shown.error / shown.star


@dataclass(frozen=True)
class _Shown:
    """What a fit shows.

    visibilities : (B,) complex, at the frequencies of |V|^2
    sides : (3 C,) complex, at those of the sides of triangles
    slopes : (K, P) derivatives of the whitened model in its parameters
    error : factor by which the errors of the measurements grow with what it leaves
    star : share of the light that is the star's
    """

    visibilities: Tensor
    sides: Tensor
    slopes: Tensor
    error: float
    star: float


def _shown(problem: PairResiduals, fit: PairFit) -> _Shown:
    places = (problem.frequencies, problem.sides)
    if fit.verdict is PairVerdict.RESOLVED:
        seen, sides = (disc_visibilities(each, fit.disc.diameter) + 0j for each in places)
        error = math.sqrt(unexplained(fit.disc.chi_square, problem.size - 1))
        return _Shown(seen, sides, disc_slope(problem, fit.disc.diameter)[:, None], error, 1.0)
    error = math.sqrt(unexplained(fit.chi_square, fit.degrees_of_freedom))
    companion = fit.companion if fit.shows_pair else torch.zeros_like(fit.companion)
    seen, sides = (pair_visibilities(each, companion) for each in places)
    slopes = (problem.slopes(companion) * problem.unit)[:, : PARAMETERS * fit.shows_pair]
    return _Shown(seen, sides, slopes, error, 1 / (1 + float(companion[0])))


def _slopes(problem: PairResiduals, shown: _Shown, offsets: Tensor) -> Tensor:
    """Return derivatives (M, K) of the whitened model in the share of a further companion, at no share."""
    of_vis2, of_sides = (
        phasor(-2 * math.pi * offsets @ frequencies.T) for frequencies in (problem.frequencies, problem.sides)
    )
    by_vis2 = 2 * ((of_vis2 - shown.visibilities) * shown.visibilities.conj()).real
    return problem.whiten(by_vis2, (of_sides / shown.sides).imag.unflatten(-1, (-1, 3)).sum(-1))
