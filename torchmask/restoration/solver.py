"""The course of a restoration: start, tournament, descend and recalibrate, escape, start again.

A mask's first start is from zero aberrations, that of a full pupil a tournament of random candidates. Segments of
descent follow each other. Between two, what the frames tell of themselves is brought up to date: scales, transmissions,
the strength of the turbulence, and the noise, which falls from what the mean frame leaves unexplained to what it is, or
to what the model cannot explain, if that is more. Once the object is sharp, frames and object escape from local minima;
when nothing moves any more, each frame counts as it fits. A start ends when a segment brings nothing more or its
iterations are spent; if it has missed the object, which its verdict tells, another one begins from random aberrations,
and the best is kept. Of faint frames, the aberrations are integrated out of what has been found.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Callback, Record
from torchmask.restoration import escapes
from torchmask.restoration.aberrations import AberrationBasis
from torchmask.restoration.calibration import recalibrate
from torchmask.restoration.candidates import Candidates, play_stage
from torchmask.restoration.checkpoint import Checkpoint, Ending, Progress, Status
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.judge import Judge
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placement import distance, is_misplaced
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.starts import (
    Known,
    expected_parameters,
    first_state,
    fit_new_frames,
    random_candidates,
    start_from_result,
)
from torchmask.restoration.state import State
from torchmask.restoration.traits import Refinement, Traits
from torchmask.restoration.verdict import Finding, Verdict


class Solver:
    """Restores the object behind a stack of frames.

    Parameters
    ----------
    objective : MyopicObjective
        Of the stack, with what is known taken from `free`.
    stack : FrameStack
    traits : Traits
    schedule : Schedule
    minimizer : Minimizer
    callback : callable, optional
        Gets a `Record` after every iteration.
    moving : AberrationBasis, optional
        Aberrations that change while a frame lasts. None: frames are snapshots.
    """

    def __init__(
        self,
        objective: MyopicObjective,
        stack: FrameStack,
        traits: Traits,
        schedule: Schedule,
        minimizer: Minimizer,
        callback: Callback | None = None,
        moving: AberrationBasis | None = None,
    ) -> None:
        self.objective: MyopicObjective = objective
        self.setting: Setting = Setting.of(objective, moving)
        self.unit: float = stack.unit
        self.traits: Traits = traits
        self.schedule: Schedule = schedule
        self.minimizer: Minimizer = minimizer
        self.callback: Callback | None = callback
        change = stack.change
        self.first_inflation: float = max(1.0, change / schedule.first_inflation)
        held = traits.prior_on_aberrations and not traits.many_minima  # through a full pupil it was not tried
        self.is_faint: bool = held and Free.OBJECT | Free.ABERRATIONS in objective.free and change < schedule.faint
        self.judge: Judge = Judge(self.setting, stack, traits, schedule)

    def solve(self, known: Known, start: RestorationResult | None = None, file: Checkpoint | None = None) -> Progress:
        """The restoration from its beginning, an earlier result or a checkpoint to its end."""
        begun = self.begin(known, start)
        if file is not None and (saved := file.load(self.objective.frames.device)) is not None:
            begun = saved
            if begun.status is Status.ITERATION_LIMIT and len(begun.costs) < self.traits.max_iterations:
                begun.status = Status.RUNNING  # there are more iterations than before: go on
        blind = known.nothing and start is None
        # Without a prior a poor fit is the method's own.
        may_start_again = blind and self.traits.prior_on_aberrations and len(self.objective.frames) > 1
        ended = self.run(begun, may_start_again, file.save if file is not None else lambda progress: None)
        if self.is_faint and ended.status is not Status.ITERATION_LIMIT:
            how = {"seed": self.traits.seed, "follow_r0": self.traits.r0_is_open}
            ended.state, evaluations = integrate_aberrations(
                self.objective, ended.state, self.schedule, self.minimizer, self.callback, **how
            )
            ended.n_evaluations += evaluations
            ended.integrated = True
        return ended

    def begin(self, known: Known, start: RestorationResult | None) -> Progress:
        """The progress of a restoration that has not begun, or goes on from an earlier result."""
        state = self._first_state(known)
        if known.covariance is not None:  # the errors are those of what is expected
            self.objective = self.objective.with_changes(centre=state.z)
        if start is None:
            return Progress(self._first_candidates(state, self.traits.seed), refinement=self.traits.refinement)
        warm, n_known = start_from_result(self.objective, state, start, self.unit)
        warm = self.setting.in_motion(warm, self.traits.seed, start.motion)
        self._place(warm)
        progress = Progress(Candidates(warm, 1), escapes=self.schedule.escapes, refinement=self.traits.refinement)
        if n_known < len(warm.z) and Free.ABERRATIONS in self.objective.free:
            rms = self._start_rms() if self._has_tournament() else None
            progress.state, progress.n_evaluations = fit_new_frames(
                self.objective, warm, n_known, rms, self.schedule, self.minimizer, self.traits.seed
            )
        return progress

    def run(self, progress: Progress, may_start_again: bool, save: Callable[[Progress], None]) -> Progress:
        """Go on until the restoration ends; `save` is called after every segment."""
        while progress.status is Status.RUNNING:
            if progress.candidates.n_each > 1:
                self._play(progress)
            else:
                self._advance(progress)
            ended = progress.status is not Status.RUNNING
            if ended and may_start_again and progress.iterations > self.schedule.sharp_after:
                self._judge_start(progress)
            save(progress)
        self._place(progress.state)
        return progress

    def _place(self, state: State) -> MyopicObjective:
        """The objective, with mask and motion as the state has found them."""
        self.objective = self.setting.objective_at(self.objective, state)
        return self.objective

    def _look_at_place(self, progress: Progress) -> None:
        """Decide whether the mask's place is found too, once the object is sharp enough to tell it."""
        if progress.refinement is Refinement.IF_SEEN and progress.iterations >= self.schedule.sharp_after:
            asked = not self.is_faint and is_misplaced(self.objective, progress.state, self.schedule)
            progress.refinement = Refinement.ON if asked else Refinement.OFF

    def _first_state(self, known: Known) -> State:
        z = expected_parameters(self.objective, known.coefficients)
        weight = 1.0 if self.traits.prior_on_aberrations or self.traits.estimated else 0.0
        return first_state(self.objective, z, known.object, self.first_inflation, weight)

    def _has_tournament(self) -> bool:
        """Zero is a saddle point of a full pupil: the sign of the even modes of a symmetric pupil cannot be seen."""
        return self.traits.many_minima and not self.traits.estimated and Free.ABERRATIONS in self.objective.free

    def _start_rms(self) -> float:
        schedule = self.schedule
        return schedule.start_rms if self.traits.prior_on_aberrations else schedule.start_rms_unwhitened

    def _first_candidates(self, state: State, seed: int) -> Candidates:
        """The first start of a mask is from zero aberrations, every other one from random ones."""
        if self._has_tournament():
            return random_candidates(self.objective, state, self.schedule.n_candidates, self._start_rms(), seed)
        if seed == self.traits.seed:
            return Candidates(state, 1)
        return random_candidates(self.objective, state, 1, self._start_rms(), seed)

    def _play(self, progress: Progress) -> None:
        """One stage of the tournament, which ends it if no iterations are left."""
        n_each = progress.candidates.n_each
        n_iterations = self.schedule.stage_iterations(n_each)
        played = play_stage(
            self.objective,
            progress.candidates,
            n_each // 2,
            lambda objective, state: self._descend(progress, objective, state, n_iterations),
            lambda objective, state: self._recalibrate(objective, state, sharpen=False),
        )
        progress.status = self._limit(progress)
        if progress.status is not Status.RUNNING:
            played = Candidates(played.state.of_frames(slice(len(self.objective.frames))), 1)
        progress.candidates = played

    def _advance(self, progress: Progress) -> None:
        """One segment, then what is brought up to date between two."""
        schedule, state, done = self.schedule, progress.state, progress.iterations
        objective = self._place(state)
        before, place = float(objective.evaluator(state.calibration)(state.image, state.z).value), state.geometry
        found = self._descend(progress, objective, state, schedule.segment)
        is_lost = distance(found.geometry, MaskGeometry()) > schedule.farthest  # nothing tells where the mask lies
        progress.refinement = Refinement.OFF if is_lost else progress.refinement
        state = state if is_lost else found
        objective = self._place(state)
        after = float(objective.evaluator(state.calibration)(state.image, state.z).value)
        progress.state, decrease = state, (before - after) / abs(after)
        at_rest = decrease <= self.traits.tolerance and distance(place, state.geometry) < schedule.still
        self._look_at_place(progress)
        limit = self._limit(progress)
        goes_on = limit is Status.RUNNING
        if goes_on and Free.ABERRATIONS in objective.free and progress.escapes < schedule.escapes:
            moved_nothing = progress.iterations == done
            if moved_nothing or Free.OBJECT not in objective.free or progress.iterations >= schedule.sharp_after:
                self._escape(progress)
        elif at_rest and not self.setting.awaits_motion(progress.state):
            progress.status, progress.decrease = Status.CONVERGED, decrease
            return
        progress.status = limit
        if goes_on and schedule.recalibrates:
            sharpen = progress.escapes == schedule.escapes
            progress.state = self._recalibrate(objective, progress.state, sharpen=sharpen)
        if goes_on and (at_rest or progress.iterations >= schedule.sharp_after):
            progress.state = self.setting.in_motion(progress.state, self.traits.seed)

    def _limit(self, progress: Progress) -> Status:
        """Which iterations are spent, if any are."""
        if len(progress.costs) >= self.traits.max_iterations:
            return Status.ITERATION_LIMIT
        return Status.RUNNING if progress.iterations < self.schedule.start_iterations else Status.START_LIMIT

    def _last_iteration(self, progress: Progress) -> int:
        """Of the present start, counted over all."""
        return min(progress.began + self.schedule.start_iterations, self.traits.max_iterations)

    def _descend(self, progress: Progress, objective: MyopicObjective, state: State, n_iterations: int) -> State:
        n_each = progress.candidates.n_each

        def listen(cost: float, evaluations: int, variables: Variables) -> None:
            progress.costs.append(cost / n_each)
            progress.n_evaluations += evaluations * n_each
            self._report(progress, variables)

        if progress.refinement is Refinement.ON and progress.iterations:  # blind, nothing tells where the mask lies
            objective = objective.with_changes(free=objective.free | Free.PLACE)
        left = self._last_iteration(progress) - len(progress.costs)
        return descend(objective, state, min(n_iterations, left), self.minimizer, listen)

    def _recalibrate(self, objective: MyopicObjective, state: State, *, sharpen: bool) -> State:
        power = 2 if self.traits.many_minima else 1
        return recalibrate(objective, state, power if sharpen else None, follow_r0=self.traits.r0_is_open)

    def _escape(self, progress: Progress) -> None:
        """Lost frames start anew, and the object moves between the pixels; if nothing moves, there is no next time.

        Frames of a full pupil have had their starts, unless they began where a sensor saw them.
        """
        progress.escapes += 1
        state = progress.state
        if self.traits.estimated or not self.traits.many_minima:
            seed = self.traits.seed + progress.escapes
            state, evaluations = escapes.restart_outlier_frames(
                self.objective, state, self.first_inflation, self.schedule, self.minimizer, seed
            )
            progress.n_evaluations += evaluations
        if Free.OBJECT in self.objective.free:
            state = escapes.centre_on_pixels(self.objective, state, self.schedule)
        if state is progress.state:  # all is where it belongs
            progress.escapes = self.schedule.escapes
        progress.state = state

    def _judge_start(self, progress: Progress) -> None:
        """At the end of a start: the best so far is kept, and another one begins if that has missed the object.

        Two that end alike have found what there is to be found.
        """
        best, verdict, progress.alike = self.judge.compare(self.objective, progress.ending, progress.rival)
        missed = verdict.finding is Finding.NOT_EXPLAINED
        spent = len(progress.costs) >= self.traits.max_iterations
        if missed and not progress.alike and progress.starts < self.schedule.starts and not spent:
            seed, found = self.traits.seed + progress.starts, progress.state.geometry
            progress.rival, progress.began, progress.starts = best, len(progress.costs), progress.starts + 1
            progress.escapes, progress.status, progress.decrease = 0, Status.RUNNING, None
            progress.candidates = self._first_candidates(replace(self._first_state(Known()), geometry=found), seed)
        else:
            progress.state, progress.status, progress.decrease = best.state, best.status, best.decrease

    @property
    def prior_r0(self) -> float | None:
        """r0 of the prior on the aberrations at first [m]; None if that is not of turbulence, or they are known."""
        known = self.traits.estimated or Free.ABERRATIONS not in self.objective.free
        return self.traits.r0 if self.traits.prior_on_aberrations and not known else None

    def verdict(self, ending: Ending) -> Verdict:
        """Whether the frames are explained by what a start, or all of them, ended at."""
        return self.judge.verdict(self.objective, ending)

    def _report(self, progress: Progress, variables: Variables) -> None:
        if self.callback is None:
            return
        step, arrays = len(progress.costs), {}
        if step == 1 or step % 10 == 0:
            image, z = variables()
            coefficients = self.objective.model.aberrations.coefficients(z[: len(self.objective.frames)])
            arrays = {"object": self.objective.model.window.crop(image) * self.unit, "coefficients": coefficients}
        scalars = {"cost": progress.costs[-1]}
        self.callback(Record("restoration", step, self._last_iteration(progress), scalars, arrays))
