"""Verdicts on the starts of one restoration, and the choice of the better of two."""

from __future__ import annotations

import math
from functools import cached_property
from typing import NamedTuple

from torchmask.metrics import relative_error
from torchmask.restoration.calibration import fit_of_frames
from torchmask.restoration.checkpoint import Ending, Progress, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.model_error import NO_MODEL_ERROR, LeftOut, ModelError, expected_error, fitted_parameters
from torchmask.restoration.motion import Setting
from torchmask.restoration.noise import FrameNoise
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State
from torchmask.restoration.traits import End, Traits
from torchmask.restoration.verdict import Finding, FrameFits, Tolerance, Verdict, judge

_ENOUGH = 0.5  # of `Change.shown`: up to 0.95 no later start was kept, at 1.04 one was
_LACKS = 3  # times the last decrease: by 2 to 4 times that two starts fell when they went on


class Comparison(NamedTuple):
    """The better of two endings.

    best : that ending
    verdict : the verdict on it
    now : the verdict on the later one
    advances : whether the later one is so much better that others are worth looking for
    alike : whether both leave the same residual
    """

    best: Ending
    verdict: Verdict
    now: Verdict
    advances: bool
    alike: bool


class Judge:
    """Judges the endings of a stack's starts, each with the mask geometry and motion that it found."""

    def __init__(
        self, setting: Setting, stack: FrameStack, traits: Traits, schedule: Schedule, end: End = End.NONE
    ) -> None:
        least = schedule.missed * stack.change.each if traits.many_minima else 0.0  # allows for its usual minima
        self.setting: Setting = setting
        self.traits: Traits = traits
        self.schedule: Schedule = schedule
        self.end: End = end
        # common pistons of three holes are a tilt
        self.has_twins: bool = not traits.many_minima and setting.still.n_subapertures > 3
        self.one_is_enough: bool = stack.change.is_scarce and stack.change.shown < _ENOUGH
        self.contrast: float = stack.contrast
        self.is_still: bool = stack.is_still
        self.noise: FrameNoise = stack.noise_of_frames
        self.tolerance: Tolerance = Tolerance(schedule.model_errors, schedule.chance, least)
        self._given: dict[tuple[int, bool], tuple[State, Verdict]] = {}  # with the state, which keeps its id

    def verdict(self, objective: MyopicObjective, ending: Ending) -> Verdict:
        """Return the verdict on whether the ending of one start, or of all, explains the frames."""
        key = id(ending.state), ending.status is not Status.ITERATION_LIMIT
        if key not in self._given:  # the best start is judged beside each later one
            self._given[key] = ending.state, self._verdict(objective, ending.state, at_rest=key[1])
        return self._given[key][1]

    def _verdict(self, objective: MyopicObjective, state: State, *, at_rest: bool) -> Verdict:
        objective = self.setting.objective_at(objective, state)
        pixels = (objective.precision.expand_as(objective.frames) > 0).sum((1, 2))
        chi_square = fit_of_frames(objective, state)[1]
        # For a full pupil poor minima, not modes left out, dominate the residual; `tolerance` allows for them.
        error = NO_MODEL_ERROR
        if not self.traits.many_minima:
            error = self._expected_error(objective, state)
        frames = FrameFits(
            chi_square, pixels, state.calibration.transmission, self.noise, _parameters(objective, state)
        )
        blind = Free.OBJECT in objective.free and Free.ABERRATIONS in objective.free and not self.traits.estimated
        return judge(frames, self.contrast, error, self.tolerance, at_rest=at_rest, blind=blind, is_still=self.is_still)

    def compare(self, objective: MyopicObjective, now: Ending, rival: Ending | None) -> Comparison:
        """Compare the present ending with the best of the earlier ones, if there is one.

        The better one has the smaller residual. Where the earlier one explains a mask's frames, or these are faint, it
        is the only one that explains them, or the cheaper one if both do or none; in faint frames the later one has to
        cost clearly less.
        """
        after = self.verdict(objective, now)
        if rival is None:
            return Comparison(now, after, after, advances=True, alike=False)
        before = self.verdict(objective, rival)
        if now.status is Status.GIVEN_UP:
            return Comparison(rival, before, after, advances=False, alike=False)
        stays = before.excess < after.excess
        advances = not stays
        if self.end is End.INTEGRATION or self._twins_may_improve(before):
            saves = self._saves(objective, now, rival)
            # in faint frames the residual is more than noise, and costs differ more by chance
            least = self.schedule.likelier if self.end is End.INTEGRATION else 0.0
            only_one = before.explained is not after.explained
            stays = before.explained if only_one else saves <= least
            advances = not stays and saves > self._part(objective, rival, self.schedule.better)
        best, verdict = (rival, before) if stays else (now, after)
        near = self.schedule.alike * max(verdict.excess, verdict.limit - 1)
        # Starts of a mask end alike at a wrong twin too, which is no reason to stop.
        alike = self.traits.many_minima and abs(before.excess - after.excess) < near
        return Comparison(best, verdict, after, advances, alike)

    def most_starts(self, verdict: Verdict) -> int:
        """Return the maximum number of starts if this is the verdict on the best.

        In the faintest frames one that explains them is enough: later ones do not differ enough to be kept.
        """
        if verdict.finding is Finding.NOT_EXPLAINED:
            return self.schedule.starts
        if verdict.explained and self.end is End.INTEGRATION:
            return 1 if self.one_is_enough else self.schedule.faint_starts
        return self.schedule.starts if self._twins_may_improve(verdict) else 1

    def wants_another(self, verdict: Verdict, progress: Progress) -> bool:
        """Return whether to start again if this is the verdict on the best start, and iterations are left for it."""
        left = self._left(progress)
        if progress.explained:
            return len(progress.explained) < self.schedule.averaged and left >= self.schedule.start_iterations
        if progress.alike or progress.starts >= self.most_starts(verdict):
            return False
        is_sure = self._twins_may_improve(verdict) and not self.is_doubted(verdict)
        if is_sure and progress.in_vain >= self.schedule.in_vain:
            return False
        # one that could be spared is not begun to be cut short before most are given up
        return left > (self.schedule.glance if verdict.explained else 0)

    def may_temper(self, verdict: Verdict, progress: Progress) -> bool:
        """Return whether the best start, on which this is the verdict, may be heated, which is done once."""
        is_asked = self.schedule.cooling > 0 and self.schedule.in_vain > 0 and not progress.tempered
        may_start = progress.starts < self.schedule.starts and self.has_room(progress)
        return is_asked and may_start and self._twins_may_improve(verdict)

    def has_room(self, progress: Progress) -> bool:
        """Return whether enough iterations are left for another start to show whether it is worth it."""
        return self._left(progress) > self.schedule.glance

    def has_room_for_all(self, progress: Progress) -> bool:
        """Return whether enough iterations are left for all that another start may take."""
        return self._left(progress) >= self.schedule.start_iterations

    def _left(self, progress: Progress) -> int:
        """Return how many iterations are left for all further starts."""
        return self.traits.max_iterations - len(progress.costs)

    def _twins_may_improve(self, verdict: Verdict) -> bool:
        """Return whether a start that explains a mask's frames may have a better twin, unless the frames are faint."""
        return verdict.explained and self.has_twins and self.end is not End.INTEGRATION

    def is_doubted(self, verdict: Verdict) -> bool:
        """Return whether a fit that explains the frames leaves more than is expected."""
        noise = verdict.limit - 1 - self.schedule.model_errors * verdict.model_error
        return verdict.excess - noise > self.schedule.doubtful * verdict.model_error

    def is_at_rest(self, objective: MyopicObjective, progress: Progress, decrease: float) -> bool:
        """Return whether the present start is at rest, its last segment having lowered the cost by the part `decrease`.

        If it explains a mask's frames beyond doubt and a last descent goes on from it, it need not quite be.
        """
        if decrease <= self.traits.tolerance:
            return True
        may_be_rough = self.end in (End.LAST_DESCENT, End.BOTH)
        if not may_be_rough or decrease > self.schedule.nearly_at_rest:
            return False
        verdict = self.verdict(objective, progress.ending)
        return verdict.explained and not self.is_doubted(verdict)

    def is_twin(self, start: int, verdict: Verdict) -> bool:
        """Return whether the start of this number is from a twin, if this is the verdict on the best so far.

        All further starts of a mask are, but where frames are faint or not explained some are from random aberrations.
        """
        in_turn = (start - 1) % (self.schedule.twins + 1) > 0
        return not self.traits.many_minima and (in_turn or self._twins_may_improve(verdict))

    def gives_up(self, objective: MyopicObjective, progress: Progress) -> bool:
        """Return whether it is time to give up the present start, if it is not from random aberrations.

        After `glance` iterations it is, unless it is near the best start, if that explains the frames, or else well
        ahead of it. In faint frames, whose residual does not tell, any start is given up then that costs much more than
        the best. From `back_after` iterations on it is, too, if it has come back to the object of a best start that
        explains the frames, and costs no less: it would find the same again.
        """
        best, now, schedule = progress.rival, progress.ending, self.schedule
        if best is None or progress.iterations < min(schedule.glance, schedule.back_after):
            return False
        at_glance = progress.iterations == schedule.glance
        if self.end is End.INTEGRATION:
            return at_glance and self._saves(objective, best, now) > schedule.hopeless * now.state.z.numel()
        verdict = self.verdict(objective, best)
        if not self.is_twin(progress.starts, verdict):
            return False
        if not verdict.explained:
            return at_glance and self.verdict(objective, now).excess >= schedule.promising * verdict.excess
        excess_cost = self._saves(objective, best, now)
        if at_glance and excess_cost > self._part(objective, best, schedule.near):
            return True
        is_late = progress.iterations >= schedule.back_after
        return is_late and excess_cost >= 0 and self._is_back(objective, now, best)

    def _is_back(self, objective: MyopicObjective, now: Ending, best: Ending) -> bool:
        """Return whether an ending has come back to the object of the best, whose fine parts take longer to agree."""
        cutoff = objective.model.cutoff / 2
        return relative_error(now.state.image, best.state.image, cutoff) < self.schedule.back_within

    def _saves(self, objective: MyopicObjective, one: Ending, other: Ending) -> float:
        """Return by how much one ending costs less than the other."""
        return self._cost(objective, other.state) - self._cost(objective, one.state)

    def _part(self, objective: MyopicObjective, ending: Ending, fraction: float) -> float:
        """Return this fraction of what an ending costs beyond noise, but no less than starts may lack when they end.

        A start that is nearly at rest falls by several times the last decrease before it is.
        """
        cost = self._cost(objective, ending.state)
        of_noise = 0.5 * float((objective.precision.expand_as(objective.frames) > 0).sum())
        return max(fraction * (cost - of_noise), _LACKS * self.schedule.nearly_at_rest * cost)

    def _cost(self, objective: MyopicObjective, state: State) -> float:
        """Return the joint cost of object and aberrations, comparable between starts: with the noise as given.

        Each start has estimated the strength of the turbulence for itself, so the norm of their prior counts.
        """
        objective, weight = self.setting.objective_at(objective, state), state.calibration.aberration_weight
        told = state.with_noise_inflation(1.0).calibration
        cost = float(objective.evaluator(told)(state.image, state.z).value)
        n_own = len(state.z) * objective.model.aberrations.n_own
        return cost - 0.5 * n_own * math.log(weight) if weight else cost

    def _expected_error(self, objective: MyopicObjective, state: State) -> ModelError:
        """Return the model error that is allowed for, which is that of the modes of the search.

        The last descent need not bring all its modes to rest, so the fit is not held to what they could explain; the
        degrees of freedom count them nonetheless.
        """
        first = self.setting.in_first_modes(state)
        error = expected_error(self.setting.objective_at(objective, first), first, self._left_out)
        return error if first is state else error._replace(fitted=fitted_parameters(objective, state))

    @cached_property
    def _left_out(self) -> LeftOut:
        n_modes = self.setting.still.n_modes
        return LeftOut.of(self.setting.told, n_modes, self.traits.r0, self.traits.outer_scale)


def _parameters(objective: MyopicObjective, state: State) -> float:
    """Return the number of parameters: the object's frequencies below the cut-off, and those of every frame."""
    of_object = min(1.0, math.pi * objective.model.cutoff**2) * state.image.numel()
    return of_object + state.z.numel() + 2 * len(state.z)  # transmission and background
