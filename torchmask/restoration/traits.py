"""Properties of the problem that decide the course of a restoration, besides its frames and its schedule."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

from torchmask.grid import Grid
from torchmask.numbers import whole_number
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.plain import require_type
from torchmask.restoration.objective import Free
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule


class End(Enum):
    """What follows the search of a restoration."""

    NONE = "the search is the end"
    INTEGRATION = "the aberrations of faint frames are integrated out"
    LAST_DESCENT = "object and aberrations descend once more, with more modes"
    BOTH = "the aberrations of noisy frames are integrated out after a last descent"
    FULL_PUPIL = "object and aberrations of a full pupil descend once more, with more modes and the object settled"
    OBJECT = "the object descends once more, the aberrations being known"

    @classmethod
    def of(cls, change: float, traits: Traits, schedule: Schedule, free: Free) -> End:
        """Return the end for frames that change from one to the next by so many noise variances."""
        descends = schedule.last_segments > 0
        if Free.ABERRATIONS not in free:
            return cls.OBJECT if descends else cls.NONE
        if Free.OBJECT not in free or not traits.prior_on_aberrations:
            return cls.NONE
        if traits.many_minima:
            return cls.FULL_PUPIL if descends and not traits.estimated else cls.NONE
        if change < schedule.faint:
            return cls.INTEGRATION
        if not descends:
            return cls.NONE
        return cls.BOTH if change < schedule.noisy else cls.LAST_DESCENT

    @property
    def descends(self) -> bool:
        """Whether a last descent follows."""
        return self in (End.LAST_DESCENT, End.BOTH, End.FULL_PUPIL, End.OBJECT)

    @property
    def integrates(self) -> bool:
        """Whether the aberrations are integrated out."""
        return self in (End.INTEGRATION, End.BOTH)


class Refinement(Enum):
    """Whether a restoration estimates a rotation and magnification of the mask together with the object."""

    OFF = "the mask lies as told"
    IF_SEEN = "found if the frames say clearly that it lies otherwise"
    ON = "found"

    @classmethod
    def of(cls, refine: bool | None, aperture: Aperture) -> Refinement:
        """Return the member for a caller's True, False or None; always `OFF` for an aperture without baselines.

        Raises ValueError for True with such an aperture, which does not show its geometry, and TypeError for anything
        else than these three.
        """
        if refine is not None and not isinstance(refine, bool):
            raise TypeError(f"refine_geometry is {refine!r}: give True, False, or None for if the frames show an error")
        if isinstance(aperture, SparseAperture) and aperture.n_subapertures > 1:
            return cls.IF_SEEN if refine is None else cls.ON if refine else cls.OFF
        if refine:
            raise ValueError("refine_geometry is True: only a mask has baselines that show its geometry, leave it out")
        return cls.OFF

    def where(self, *, blind: bool) -> Refinement:
        """Return this member, or `OFF` in place of `IF_SEEN` for a restoration that is not `blind`."""
        return self if blind or self is Refinement.ON else Refinement.OFF


@dataclass(frozen=True)
class Traits:
    """Properties of the problem that a solver needs besides its objective.

    many_minima : whether the cost has many minima, as for a full pupil, so that a tournament of candidates is needed
    estimated : whether the aberrations are known with errors, which are their prior in place of turbulence
    prior_on_aberrations : whether the aberrations have a prior
    r0_is_open : whether the strength of the turbulence is estimated from the aberrations
    r0 : initial Fried parameter of the turbulence [m]
    outer_scale : outer scale of the turbulence [m]
    max_iterations : maximum number of iterations over all starts
    tolerance : the restoration has converged when a segment lowers the cost by a smaller fraction
    seed : seed of the random starts
    refinement : whether to refine the mask's geometry
    fills_field : whether the object extends beyond the field
    """

    many_minima: bool
    estimated: bool
    prior_on_aberrations: bool
    r0_is_open: bool
    r0: float
    outer_scale: float
    max_iterations: int
    tolerance: float
    seed: int
    refinement: Refinement
    fills_field: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "seed", whole_number("seed", self.seed, least=0))

    @property
    def aberration_weight(self) -> float:
        """Weight of the aberrations' prior at first: 0 without one."""
        return 1.0 if self.prior_on_aberrations or self.estimated else 0.0

    @property
    def fit_power(self) -> int:
        """Power of their residual variance by which frames are weighted once the object has been found.

        2 for a full pupil, where residuals come from poor minima and are more harmful than white noise of that
        variance; 1 for a mask, where most come from modes left out.
        """
        return 2 if self.many_minima else 1


def check_given(
    aperture: Aperture,
    grid: Grid,
    wavelengths: Sequence[float] | None,
    weights: Sequence[float] | None,
    readout_noise: float | None,
    tolerance: float,
    aberration_prior: bool,
    schedule: Schedule | None,
    minimizer: Minimizer | None,
) -> None:
    """Check what a method is given. `readout_noise` is in electrons rms.

    Raises TypeError for an aperture, a grid, a schedule, a minimiser or a switch of another type, and ValueError for a
    read-out noise or a tolerance out of range, or for weights without wavelengths.
    """
    require_type("aperture", aperture, Aperture)
    require_type("grid", grid, Grid)
    require_type("schedule", schedule or Schedule(), Schedule)
    if wavelengths is None and weights is not None:
        raise ValueError("weights are given without wavelengths: give both")
    if isinstance(minimizer, type) or not (minimizer is None or callable(minimizer)):
        given = minimizer.__name__ if isinstance(minimizer, type) else repr(minimizer)
        raise TypeError(
            f"minimizer is {given}: an instance is needed, such as ProjectedLBFGS(), or, for an optimiser of PyTorch, "
            "TorchMinimizer(partial(torch.optim.Adam, lr=0.1))"
        )
    if not isinstance(aberration_prior, bool):
        raise TypeError(f"aberration_prior is {aberration_prior!r}: it must be True or False")
    if readout_noise is not None and not (math.isfinite(readout_noise) and readout_noise >= 0):
        raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
    if not tolerance >= 0:
        raise ValueError(f"tolerance is {tolerance}: it must be at least 0, a fraction of the cost")


def number_of_iterations(max_iterations: int) -> int:
    """Return a maximum number of iterations. Raises ValueError unless it is a whole number of at least 1."""
    return whole_number("max_iterations", max_iterations)


def number_of_samples(n_samples: int) -> int:
    """Return a number of samples. Raises ValueError for one that does not allow standard deviations."""
    if n_samples == 0:
        return 0
    return whole_number("n_samples", n_samples, least=2, note=", or 0 for no standard deviations")
