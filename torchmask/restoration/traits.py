"""What decides the course of a restoration beside its frames and its schedule."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from torchmask.optics.aperture import Aperture, SparseAperture


class Refinement(Enum):
    """Whether a restoration finds how the mask lies, a turn and a magnification, together with the object."""

    OFF = "the mask lies as told"
    IF_SEEN = "found if the frames say clearly that it lies otherwise"
    ON = "found"

    @classmethod
    def of(cls, refine: bool | None, aperture: Aperture) -> Refinement:
        """What a caller's True, False or None stand for; an aperture without baselines has nothing to be seen by.

        Raises ValueError for True with such an aperture.
        """
        if isinstance(aperture, SparseAperture) and aperture.n_subapertures > 1:
            return cls.IF_SEEN if refine is None else cls.ON if refine else cls.OFF
        if refine:
            raise ValueError("refine_geometry is True: only a mask has baselines that tell how it lies, leave it out")
        return cls.OFF

    def where(self, *, blind: bool) -> Refinement:
        """This, or `OFF` where it is left to the frames and something else of them is known: not `blind`."""
        return self if blind or self is Refinement.ON else Refinement.OFF


@dataclass(frozen=True)
class Traits:
    """What a solver must know of the problem beside its objective.

    many_minima : of a full pupil, which needs a tournament of candidates
    estimated : the aberrations are known with errors, whose prior takes the place of turbulence
    prior_on_aberrations : whether they have one at all
    r0_is_open : the strength of the turbulence follows the aberrations
    r0, outer_scale : of the turbulence at first [m]
    max_iterations : of all starts together
    tolerance : a segment that lowers the cost by a smaller fraction is the last one
    seed : of random starts
    refinement : whether the mask's place is found too
    exposure_tau0 : how long a frame lasts [tau0]; 0: frames are snapshots
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
    exposure_tau0: float = 0.0


def check_numbers(readout_noise: float | None, max_iterations: int, tolerance: float) -> None:
    """Raise ValueError for a read-out noise [electrons rms], a number of iterations or a tolerance out of range."""
    if readout_noise is not None and not (math.isfinite(readout_noise) and readout_noise >= 0):
        raise ValueError(f"readout_noise is {readout_noise}: it must be finite and at least 0, in electrons rms")
    if max_iterations < 1 or not tolerance >= 0:
        raise ValueError(
            f"max_iterations is {max_iterations} and tolerance {tolerance}: they must be at least 1 and at least 0"
        )


def check_samples(n_samples: int) -> None:
    """Raise ValueError for a number of samples that tell no standard deviations."""
    if n_samples < 0 or n_samples == 1:
        raise ValueError(f"n_samples is {n_samples}: 0 for no standard deviations, or at least 2")
