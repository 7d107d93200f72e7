"""When a restoration does what: every number that decides it, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

_NO_LIMIT = 10**9  # iterations


@dataclass(frozen=True)
class Schedule:
    """The course of a restoration, in iterations of its descents. All values were measured: docs/restoration.md.

    segment : iterations between two recalibrations of scales, transmissions, noise and turbulence
    recalibrates : whether transmissions, noise and turbulence are, beside the scales of the variables
    start_iterations : of one start, at most
    sharp_after : iterations after which the object is sharp enough to look for its place and for lost frames
    escapes : how often that is done in one start, at most
    first_inflation : the first noise variance is what the mean frame leaves unexplained over this
    start_rms : of the first whitened aberrations of a full pupil, and of further starts
    start_rms_unwhitened : the same in rad, where the aberrations have no prior
    candidates : stages of a full pupil's tournament, as (candidates for each frame, iterations); each stage keeps
        half of them, the last one the best
    model_errors : a fit may leave so many times what modes beyond the aberration basis are expected to leave: with
        more, the object is another one
    chance : standard deviations of the stack's chi-square that it may leave besides
    missed : share of the change from frame to frame that may be left through a full pupil, if that is more
    starts : how many there are, at most, for objects that were missed
    alike : relative difference of what two starts leave unexplained, below which they have found the same
    outlying : a frame is lost if its residual variance is so many times that of the frames that fit well
    restarts, restart_rounds, restart_iterations : random aberrations that a lost frame is started from, rounds of
        falling noise, iterations of a round
    pixel_steps : by which the object is moved along each axis to find its place between the pixels
    pixel_iterations : that settle the object at such a place, at most
    misplaced_gain, misplaced : the mask's place is looked for if moving it promises to lower the cost by more than the
        first, and it has to move by more than the second, over the holes' distance from the centre
    farthest : a mask that is found farther away than this is taken as told again
    still : it has come to rest where a segment moves it by less than this
    faint : change from frame to frame, in noise variances, below which the aberrations are integrated out at the end
    rounds, moves : of that integration, and moves of the aberrations' samples in a round; the object is the mean of
        the later half of the rounds
    move_size : of the first moves, in standard deviations of Laplace's approximation
    renewal : rounds after which that approximation is made anew
    memory : share of the averages so far that a round keeps
    settling : iterations that settle the object in a round, at most
    last_settling : those that settle it in the end, under a prior of its own scale
    """

    segment: int = 100
    recalibrates: bool = True
    start_iterations: int = 1000
    sharp_after: int = 300
    escapes: int = 7
    first_inflation: float = 30.0
    start_rms: float = 0.7
    start_rms_unwhitened: float = 0.1
    candidates: tuple[tuple[int, int], ...] = ((16, 30), (8, 70), (4, 100), (2, 100))
    model_errors: float = 2.0
    chance: float = 2.0
    missed: float = 0.0013
    starts: int = 4
    alike: float = 0.03
    outlying: float = 1.25
    restarts: int = 6
    restart_rounds: int = 3
    restart_iterations: int = 30
    pixel_steps: tuple[float, ...] = (0.4, 0.2)
    pixel_iterations: int = 60
    misplaced_gain: float = 5.0
    misplaced: float = 6e-4
    farthest: float = 0.05
    still: float = 1e-4
    faint: float = 5.0
    rounds: int = 80
    moves: int = 10
    move_size: float = 0.3
    renewal: int = 20
    memory: float = 0.7
    settling: int = 30
    last_settling: int = 80

    def __post_init__(self) -> None:
        stages = [number for number, _ in self.candidates] + [1]
        if any(later * 2 != earlier for earlier, later in pairwise(stages)):
            raise ValueError(f"candidates is {self.candidates}: each stage must have half as many as the one before it")
        for name in ("segment", "start_iterations", "starts"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be at least 1")

    @classmethod
    def plain(cls) -> Schedule:
        """One bounded L-BFGS on one cost: nothing is repaired, moved, weighed anew or drawn at random on its way.

        The noise is what it is said to be from the first iteration on, frames are divided by their mean light, and
        there is one start: from zero aberrations through a mask, from small random ones through a full pupil, for which
        zero is a saddle point. The descent begins anew every 1000 iterations as long as those lower the cost.
        """
        return cls(
            segment=1000,
            recalibrates=False,
            start_iterations=_NO_LIMIT,
            escapes=0,
            first_inflation=math.inf,
            candidates=(),
            starts=1,
            faint=0.0,
        )

    @property
    def n_candidates(self) -> int:
        """How many candidates a tournament begins with; 1 without one."""
        return self.candidates[0][0] if self.candidates else 1

    def stage_iterations(self, n_candidates: int) -> int:
        """The iterations of the stage with so many candidates."""
        return dict(self.candidates)[n_candidates]
