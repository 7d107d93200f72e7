"""All numbers that control the course of a restoration."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, fields
from itertools import pairwise
from numbers import Integral

from torchmask.numbers import whole_number

_NO_LIMIT = 10**9  # iterations

# Ranges of the numbers that are not simply at least 0, with both ends.
_COUNTS = (
    "segment",
    "start_iterations",
    "starts",
    "faint_starts",
    "averaged",
    "rounds",
    "fine_rounds",
    "renewal",
    "comparing",
)
_RANGES = {
    **dict.fromkeys(_COUNTS, (1, math.inf)),
    **dict.fromkeys(("nearly_at_rest", "chance", "alike"), (-math.inf, math.inf)),  # negative ones never apply
    **dict.fromkeys(("start_rms", "start_rms_unwhitened", "move_size"), (0, sys.float_info.max)),
    "farthest": (0, 1),
    "heat": (1, sys.float_info.max),
    "first_inflation": (sys.float_info.min, math.inf),  # as it divides
}


@dataclass(frozen=True)
class Schedule:
    """Numbers that control the course of a restoration. How the defaults were chosen is told in docs/tried.md.

    Raises ValueError, which names the number, if one is out of its range.

    segment : number of iterations between two recalibrations of scales, transmissions, noise and turbulence
    recalibrates : whether to recalibrate transmissions, noise and turbulence; the scales of the variables always are
    start_iterations : maximum number of iterations of one start
    nearly_at_rest : a start of a mask that explains the frames, unless they are faint, ends as soon as a segment lowers
        the cost by less than this fraction, as the last descent goes on from there
    sharp_after : number of iterations after which the object is sharp enough to escape from local minima, and in faint
        light to choose the prior of the rest of the search
    escapes : maximum number of escapes in one start, each of which restarts outlying frames, shifts the
        object and, in a band where no start from group delays may follow, changes fringes
    first_inflation : the initial noise variance is the residual variance of the mean frame divided by this
    start_rms : rms of random initial whitened aberrations
    start_rms_unwhitened : the same in rad, for aberrations without a prior
    candidates : stages of a full pupil's tournament, as (candidates for each frame, iterations); each stage keeps
        the better half of the candidates, the last stage the best one
    model_errors : the object counts as missed if the excess chi-square is larger than this number times that expected
        of modes beyond the aberration basis
    chance : allowance for chance that is added to this limit, in standard deviations of the stack's chi-square
    missed : for a full pupil, minimum of the allowed excess, as a fraction of the change from frame to frame
    starts : maximum number of starts, but for `averaged` and `faint_starts`
    in_vain : a mask whose frames are explained beyond doubt, and not faint, starts from twins of the best object until
        so many starts in succession have brought nothing clearly better; 0: it starts once. Where a band tells group
        delays, a start from these follows each that is clearly better, and no twin if the frames are explained then
    doubtful : an explained fit of a mask is doubted if the excess is larger than this number times that expected, and
        others are started as if it were not explained
    better : where the best start so far explains the frames of a mask, a later one that costs less is clearly better if
        it costs less by this fraction of what the best costs beyond noise
    near : there a twin is given up if it costs more than the best by more than this fraction of the same
    twins : where a mask's frames are faint or not explained, number of further starts from twins of its object, or from
        group delays, before one from random aberrations
    cooling : a mask whose frames are explained and show gentle slopes, and are not faint, starts once from the best
        object heated, after so many rounds in which the noise falls; 0: it does not
    heat : factor of the variance of the noise from which it falls then
    faint_starts : maximum number of starts of a mask whose faint frames are explained, of which the likeliest is kept;
        below a chi-square of 1024 beyond noise in a frame one is enough
    likelier : cost by which a later start in faint frames has to be lower to replace an earlier one
    glance : number of iterations after which a start from a twin, or any later start in faint frames, may be given up
    back_after : number of iterations from which on a start from a twin, group delays or heat is given up if it has come
        back to the object of the best, where that explains the frames, and costs no less
    back_within : relative difference of the two objects up to half the cut-off frequency, but for shift and brightness,
        below which it has come back; 0: it never has
    promising : where the best start so far does not explain the frames, a twin is given up unless its excess chi-square
        is below this fraction of that of the best
    hopeless : a start in faint frames is, if its cost exceeds that of the best so far by more than this for each
        aberration of all frames
    averaged : for a full pupil, number of starts that explain the frames, from the mean of whose objects the end
        begins; no other start is made once phases have been retrieved
    alike : relative difference of the excess chi-square of two starts of a full pupil below which they are the same
    outlying : a frame is outlying if its residual variance is larger than this number times that of well-fitted frames
    restarts : number of random starts of the aberrations of an outlying frame
    restart_rounds : number of rounds of such a start, over which the assumed noise falls
    restart_iterations : number of iterations of such a round
    pixel_steps : steps [pixels] along each axis by which the object is shifted to find its best sub-pixel position
    pixel_iterations : maximum number of iterations that fit the object at such a position
    misplaced_gain : the mask's geometry is refined if its first-order step lowers the cost by more than this
    misplaced : and if that step moves holes by more than this fraction of their distance from the centre
    farthest : a mask found displaced by more than this fraction is reset to the given geometry
    still : the geometry has converged when a segment moves holes by less than this fraction
    faint : change from frame to frame, in noise variances, below which frames are faint: the aberrations are integrated
        out in place of a last descent, and priors are not adapted to the object
    noisy : the same below which they are integrated out after the last descent
    faint_segments : number of segments under the given prior between a search under a lighter one and the integration
    rounds : number of rounds of the integration of faint frames; the object is the mean of the second half of them
    fine_rounds : the same after a last descent
    moves : number of moves of the aberrations' samples in a round
    move_size : size of the first moves, in standard deviations of Laplace's approximation
    renewal : number of rounds after which that approximation is recomputed
    settling : maximum number of iterations that fit the object in a round
    last_settling : the same after the last descent and after phases of a mask's lost frames have been found, and for a
        full pupil before each of its segments and of those between rounds of phase retrieval; also of the object to
        which a prior is adapted, and as `comparing`, where aberrations are known
    last_modes : number of modes of each sub-aperture of a mask in the last descent of frames that are not faint
    last_modes_full : the same of a full pupil, however faint
    comparing : number of iterations that fit the object to half of the frames, to compare priors for that descent
    last_segments : maximum number of segments of that descent; 0: there is none
    last_gain : for a mask, it ends when the second half of a segment lowers the cost by less than this fraction, unless
        phases of lost frames have been found
    last_gain_full : the same for a full pupil
    lost : after each segment of the last descent, phases are retrieved of a mask's frames whose chi-square is above
        that of noise by more than this and three standard deviations of noise; infinite: of none
    reflections : number of reflections by which they are
    retrievals : for a full pupil, maximum number of rounds of phase retrieval after a start; 0: there is none
    retrieved_starts : number of starts after which phases are retrieved, until they are found
    retrieved_from : a round is made while the mean chi-square is above that of noise by more than this
    reflections_full : number of reflections of a round, at most: those of a frame end once its phases are found
    retrieved_iterations : maximum number of iterations that fit the modes of the phases retrieved
    retrieved_segments : number of segments in which object and aberrations then descend
    retrieved_gain : what the rounds have found is kept if the excess chi-square falls below this fraction
    """

    segment: int = 100
    recalibrates: bool = True
    start_iterations: int = 1000
    nearly_at_rest: float = 0.001
    sharp_after: int = 300
    escapes: int = 7
    first_inflation: float = 30.0
    start_rms: float = 0.7
    start_rms_unwhitened: float = 0.1
    candidates: tuple[tuple[int, int], ...] = ((4, 50), (2, 100))
    model_errors: float = 2.0
    chance: float = 2.0
    missed: float = 0.0013
    starts: int = 9
    in_vain: int = 2
    doubtful: float = 1.0
    better: float = 0.04
    near: float = 0.1
    twins: int = 3
    cooling: int = 30
    heat: float = 10.0
    faint_starts: int = 6
    likelier: float = 50.0
    glance: int = 300
    back_after: int = 200
    back_within: float = 0.07
    promising: float = 0.7
    hopeless: float = 0.3
    averaged: int = 3
    alike: float = 0.03
    outlying: float = 1.25
    restarts: int = 6
    restart_rounds: int = 3
    restart_iterations: int = 40
    pixel_steps: tuple[float, ...] = (0.4, 0.2)
    pixel_iterations: int = 60
    misplaced_gain: float = 5.0
    misplaced: float = 6e-4
    farthest: float = 0.05
    still: float = 1e-4
    faint: float = 5.0
    noisy: float = 30.0
    faint_segments: int = 2
    rounds: int = 100
    fine_rounds: int = 50
    moves: int = 10
    move_size: float = 0.3
    renewal: int = 20
    settling: int = 30
    last_settling: int = 80
    last_modes: int = 28
    last_modes_full: int = 351
    comparing: int = 20
    last_segments: int = 20
    last_gain: float = 0.001
    last_gain_full: float = 0.003
    lost: float = 0.05
    reflections: int = 100
    retrievals: int = 8
    retrieved_starts: int = 2
    retrieved_from: float = 0.5
    reflections_full: int = 600
    retrieved_iterations: int = 60
    retrieved_segments: int = 2
    retrieved_gain: float = 0.7

    def __post_init__(self) -> None:
        stages = [number for number, _ in self.candidates] + [1]
        if any(later * 2 != earlier for earlier, later in pairwise(stages)):
            raise ValueError(f"candidates is {self.candidates}: each stage must have half as many as the one before it")
        if not all(isinstance(count, Integral) and count >= 1 for _, count in self.candidates):
            raise ValueError(f"candidates is {self.candidates}: each stage needs at least 1 iteration, a whole number")
        if not all(0 < step < math.inf for step in self.pixel_steps):
            raise ValueError(f"pixel_steps is {self.pixel_steps}: they must be finite and positive, in pixels")
        for item in fields(self):
            if item.type in ("int", "float"):
                self._check(item.name, whole=item.type == "int")

    def _check(self, name: str, whole: bool) -> None:
        """Raise ValueError unless the number of this name is in its range, and whole if it has to be."""
        value, (least, most) = getattr(self, name), _RANGES.get(name, (0, math.inf))
        if whole:
            object.__setattr__(self, name, whole_number(name, value, int(least), most))
        elif not least <= value <= most:
            raise ValueError(f"{name} is {value}: it must be a number from {least:.3g} to {most:.3g}")

    @classmethod
    def plain(cls) -> Schedule:
        """Return the schedule of one bounded L-BFGS descent on a fixed cost, without recalibration or escapes.

        The noise variance is the given one from the first iteration, transmissions are the mean light of the frames,
        and there is one start: from zero aberrations for a mask, from small random ones for a full pupil, for which
        zero is a saddle point. The descent restarts every 1000 iterations as long as those lower the cost. The mask
        lies as told, unless a restoration is asked to refine its geometry.
        """
        return cls(
            segment=1000,
            recalibrates=False,
            start_iterations=_NO_LIMIT,
            escapes=0,
            first_inflation=math.inf,
            candidates=(),
            starts=1,
            faint_starts=1,
            averaged=1,
            faint=0.0,
            last_modes=0,
            last_modes_full=0,
            last_segments=0,
            retrievals=0,
            misplaced_gain=math.inf,
        )

    @property
    def n_candidates(self) -> int:
        """Number of candidates at the beginning of a tournament; 1 without a tournament."""
        return self.candidates[0][0] if self.candidates else 1

    def most_modes(self, of_full_pupil: bool) -> int:
        """Return the number of modes of each sub-aperture in the last descent."""
        return self.last_modes_full if of_full_pupil else self.last_modes

    def stage_iterations(self, n_candidates: int) -> int:
        """Return the number of iterations of the stage with this number of candidates."""
        return dict(self.candidates)[n_candidates]
