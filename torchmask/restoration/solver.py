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
from functools import cached_property

from torch import Tensor

from torchmask.record import Callback, Record
from torchmask.restoration import escapes
from torchmask.restoration.calibration import fit_of_frames, recalibrate
from torchmask.restoration.candidates import Candidates, play_stage
from torchmask.restoration.checkpoint import Checkpoint, Ending, Progress, Status
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.model_error import NO_MODEL_ERROR, LeftOut, expected_error
from torchmask.restoration.objective import Free, MyopicObjective
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
from torchmask.restoration.traits import Traits
from torchmask.restoration.verdict import Finding, Tolerance, Verdict, judge


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
    """

    def __init__(
        self,
        objective: MyopicObjective,
        stack: FrameStack,
        traits: Traits,
        schedule: Schedule,
        minimizer: Minimizer,
        callback: Callback | None = None,
    ) -> None:
        self.objective: MyopicObjective = objective
        self.unit: float = stack.unit
        self.traits: Traits = traits
        self.schedule: Schedule = schedule
        self.minimizer: Minimizer = minimizer
        self.callback: Callback | None = callback
        change = stack.change
        self.first_inflation: float = max(1.0, change / schedule.first_inflation)
        held = traits.prior_on_aberrations and not traits.many_minima  # through a full pupil it was not tried
        self.is_faint: bool = held and Free.OBJECT | Free.ABERRATIONS in objective.free and change < schedule.faint
        self.contrast: float = stack.contrast
        least = schedule.missed * change if traits.many_minima else 0.0  # its poor minima are no worse than that
        self.tolerance: Tolerance = Tolerance(schedule.model_errors, schedule.chance, least)

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
            return Progress(self._first_candidates(state, self.traits.seed))
        warm, n_known = start_from_result(self.objective, state, start, self.unit)
        progress = Progress(Candidates(warm, 1), escapes=self.schedule.escapes)
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
        return progress

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
        objective, schedule = self.objective, self.schedule
        state, done = progress.state, progress.iterations
        evaluate = objective.evaluator(state.calibration)
        before = float(evaluate(state.image, state.z).value)
        state = self._descend(progress, objective, state, schedule.segment)
        after = float(evaluate(state.image, state.z).value)
        progress.state, decrease = state, (before - after) / abs(after)
        limit = self._limit(progress)
        goes_on = limit is Status.RUNNING
        if goes_on and Free.ABERRATIONS in objective.free and progress.escapes < schedule.escapes:
            at_rest = progress.iterations == done
            if at_rest or Free.OBJECT not in objective.free or progress.iterations >= schedule.sharp_after:
                self._escape(progress)
        elif decrease <= self.traits.tolerance:
            progress.status, progress.decrease = Status.CONVERGED, decrease
            return
        progress.status = limit
        if goes_on and schedule.recalibrates:
            sharpen = progress.escapes == schedule.escapes
            progress.state = self._recalibrate(objective, progress.state, sharpen=sharpen)

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
        now = progress.ending
        best, verdict, progress.alike = now, self.verdict(now), False
        if (rival := progress.rival) is not None:
            before, after = self.verdict(rival), verdict
            best, verdict = (rival, before) if before.excess < after.excess else (now, after)
            scale = max(verdict.excess, verdict.limit - 1)
            progress.alike = abs(before.excess - after.excess) < self.schedule.alike * scale
        missed = verdict.finding is Finding.NOT_EXPLAINED
        spent = len(progress.costs) >= self.traits.max_iterations
        if missed and not progress.alike and progress.starts < self.schedule.starts and not spent:
            seed = self.traits.seed + progress.starts
            progress.rival, progress.began, progress.starts = best, len(progress.costs), progress.starts + 1
            progress.escapes, progress.status, progress.decrease = 0, Status.RUNNING, None
            progress.candidates = self._first_candidates(self._first_state(Known()), seed)
        else:
            progress.state, progress.status, progress.decrease = best.state, best.status, best.decrease

    @property
    def prior_r0(self) -> float | None:
        """r0 of the prior on the aberrations at first [m]; None if that is not of turbulence, or they are known."""
        known = self.traits.estimated or Free.ABERRATIONS not in self.objective.free
        return self.traits.r0 if self.traits.prior_on_aberrations and not known else None

    def verdict(self, ending: Ending) -> Verdict:
        """Whether the frames are explained by what a start, or all of them, ended at."""
        objective, state = self.objective, ending.state
        pixels = (objective.precision.expand_as(objective.frames) > 0).sum((1, 2))
        # A full pupil has so many modes that its poor minima, and not what is left out, decide: `tolerance` knows.
        error = NO_MODEL_ERROR if self.traits.many_minima else expected_error(objective, state, self._left_out)
        chi_square = fit_of_frames(objective, state)[1]
        at_rest = ending.status is not Status.ITERATION_LIMIT
        return judge(chi_square, pixels, self.contrast, error, self.tolerance, at_rest=at_rest)

    @cached_property
    def _left_out(self) -> LeftOut:
        model, traits = self.objective.model, self.traits
        return LeftOut.of(model.pupil.aperture, model.aberrations.n_modes, traits.r0, traits.outer_scale)

    def _report(self, progress: Progress, variables: Variables) -> None:
        if self.callback is None:
            return
        step, arrays = len(progress.costs), {}
        if step == 1 or step % 10 == 0:
            image, z = variables()
            arrays = self.arrays(image, z[: len(self.objective.frames)])
        scalars = {"cost": progress.costs[-1]}
        self.callback(Record("restoration", step, self._last_iteration(progress), scalars, arrays))

    def arrays(self, image: Tensor, z: Tensor) -> dict[str, Tensor]:
        """Object (H, W) [electrons] and coefficients (T, N, J) [rad rms]."""
        model = self.objective.model
        return {
            "object": model.window.crop(image) * self.unit,
            "coefficients": model.aberrations.coefficients(z),
        }
