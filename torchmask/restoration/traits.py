"""What a solver must know of a restoration beside what is minimised."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Traits:
    """What sets one restoration apart from another.

    many_minima : of a full pupil, which needs a tournament of candidates
    estimated : the aberrations are known with errors, whose prior takes the place of turbulence
    prior_on_aberrations : whether they have one at all
    r0_is_open : the strength of the turbulence follows the aberrations
    r0, outer_scale : of the turbulence at first [m]
    max_iterations : of all starts together
    tolerance : a segment that lowers the cost by a smaller fraction is the last one
    seed : of random starts
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
