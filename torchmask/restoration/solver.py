"""The algorithm of a restoration: start, tournament, descent with recalibration, escapes, and further starts.

The first start is from zero aberrations for a mask, and a tournament of random candidates for a full pupil. The descent
proceeds in segments. Between two of them, scales, transmissions, the strength of the turbulence and the noise are
updated; the assumed noise falls from the residual of the mean frame to the true noise or, if larger, that of the model.
Once the object is sharp, frames and object escape from local minima, and in faint light the prior suits it; when
nothing changes any more, each frame is weighted by how well it fits. A start ends when a segment gains nothing, or
little if it explains the frames, or its iterations are used up. Then phases of a full pupil's bright frames are
retrieved. Others start from random aberrations or, for a mask, from group delays, from twins of the best object or from
this object heated, as long as they may find a better one (`restarts`); the best is kept, or the mean for a full pupil.
The rest is told in `finish`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Callback, Record
from torchmask.restoration.aberrations import AberrationBasis, MakesBasis
from torchmask.restoration.calibration import recalibrate
from torchmask.restoration.candidates import Candidates, play_stage
from torchmask.restoration.checkpoint import Checkpoint, Progress, Status, save_nothing
from torchmask.restoration.consensus import average_starts
from torchmask.restoration.descent import Variables, Watched, descend
from torchmask.restoration.escapes import escape
from torchmask.restoration.finish import Finisher
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.judge import Judge
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placement import distance, is_misplaced
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.restarts import Restarts
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.retrieval import retrieve_phases
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.spectrum import rate_in_search
from torchmask.restoration.starts import (
    Known,
    expected_parameters,
    first_candidates,
    first_state,
    fit_new_frames,
    has_tournament,
    start_from_result,
    start_rms,
)
from torchmask.restoration.state import Modes, State
from torchmask.restoration.traits import End, Refinement, Traits


class Solver:
    """Restores the object behind a stack of frames.

    Parameters
    ----------
    objective : MyopicObjective
        Cost for the stack, with everything that is known excluded from `free`.
    stack : FrameStack
        Frames to restore.
    traits, schedule : Traits, Schedule
        Properties of the problem, and the numbers that control the course.
    minimizer : Minimizer
        Minimiser of each descent.
    callback : callable, optional
        Called with a `Record` after every iteration.
    moving : AberrationBasis, optional
        Aberrations that change during a frame. None: frames are snapshots.
    finer : callable, optional
        Makes the aberrations with more modes for after the search. None: there are no more.
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
        finer: MakesBasis | None = None,
    ) -> None:
        self.objective: MyopicObjective = objective
        self.setting: Setting = Setting.of(objective, moving, finer)
        self.traits: Traits = traits
        self.schedule: Schedule = schedule
        self.minimizer: Minimizer = minimizer
        self.callback: Callback | None = callback
        self._how: tuple[Traits, Schedule, Minimizer] = (traits, schedule, minimizer)
        self._limits: tuple[int, int] = (traits.max_iterations, schedule.start_iterations)
        self.first_inflation: float = max(1.0, stack.change.each / schedule.first_inflation)
        turbulent = Free.ABERRATIONS in objective.free and traits.prior_on_aberrations and not traits.estimated
        self.prior_r0: float | None = traits.r0 if turbulent else None  # of the aberrations' prior, at first [m]
        many_ends = turbulent and Free.OBJECT in objective.free and traits.many_minima
        averages = many_ends and schedule.averaged > 1
        retrievable = objective.model.pupil.n_rasters == 1 and len(objective.frames) > 1
        self.retrieves: bool = many_ends and schedule.retrievals > 0 and retrievable
        self.stack: FrameStack = stack
        self.end: End = End.of(stack.change.each, traits, schedule, objective.free)
        self.given: ObjectPrior = objective.prior
        self.judge: Judge = Judge(self.setting, stack, traits, schedule, self.end)
        known = (self.setting, stack, self.judge, traits, schedule)
        self.restarts: Restarts = Restarts(*known, self.first_inflation, averages, minimizer, callback)

    def solve(
        self, known: Known, start: RestorationResult | None = None, file: Checkpoint | None = None, n_modes: int = 0
    ) -> Progress:
        """Run a restoration to its end, from scratch, from an earlier result or from a checkpoint.

        Its aberrations have `n_modes` at least, if the search had fewer: those that nothing has found are zero.
        """
        if known.covariance is not None:  # the prior is centred on the estimated aberrations
            centre = expected_parameters(self.objective, known.coefficients)
            self.objective = self.objective.with_changes(centre=centre)
        saved = None if file is None else file.load(self.objective.frames.device)
        begun = saved or self.begin(known, start)
        if begun.status is Status.ITERATION_LIMIT and len(begun.costs) < self.traits.max_iterations:
            begun.status = Status.RUNNING  # the limit has been raised since
        blind = known.nothing and start is None
        # Without a prior on the aberrations a poor fit is to be expected, and more starts would not help.
        may_start_again = blind and self.traits.prior_on_aberrations and len(self.objective.frames) > 1
        ended = self.run(begun, may_start_again, save := save_nothing if file is None else file.save)
        cut_short = ended.status is Status.ITERATION_LIMIT  # it may go on from its file, which the end leaves as it is
        if len(ended.explained) > 1 and ended.finer is None:
            average_starts(self.objective, ended, self.schedule, self.minimizer, self.callback)
        if self.end is not End.NONE and (ended.starts > 1 or not cut_short):
            how = (self.schedule, self.minimizer, self.callback, self.traits, save_nothing if cut_short else save)
            given = self.objective.with_changes(prior=self.given)
            self.objective = Finisher(self.setting, *how, self.stack.change).finish(given, ended, self.end)
        if self.setting.still.n_modes < n_modes and ended.state.modes is not Modes.FINER:
            ended.state = self.setting.in_all_modes(ended.state)
            self._place(ended.state)
        return ended

    def begin(self, known: Known, start: RestorationResult | None) -> Progress:
        """Return the initial progress of a restoration, from scratch or from an earlier result."""
        state = self._first_state(known)
        if start is None:
            first = first_candidates(self.objective, state, self.traits, self.schedule, self.traits.seed)
            narrow = self.objective.model.pupil.n_rasters == 1  # in a band a lighter prior has lost stacks
            rate = math.inf if narrow and known.nothing and self.end is End.INTEGRATION else 1.0
            return Progress(first, refinement=self.traits.refinement, rate=rate)
        warm, n_known = start_from_result(self.objective, state, start, self.stack.unit)
        warm = self.setting.in_motion(warm, self.traits.seed, start.motion)
        self._place(warm)
        progress = Progress(Candidates(warm, 1), escapes=self.schedule.escapes, refinement=self.traits.refinement)
        if n_known < len(warm.z) and Free.ABERRATIONS in self.objective.free:
            rms = start_rms(self.traits, self.schedule) if has_tournament(self.objective, self.traits) else None
            progress.state, progress.n_evaluations = fit_new_frames(
                self.objective, warm, n_known, rms, self.schedule, self.minimizer, self.traits.seed
            )
        return progress

    def run(self, progress: Progress, may_start_again: bool, save: Callable[[Progress], None]) -> Progress:
        """Continue until the restoration ends; `save` is called after every segment."""
        while progress.status is Status.RUNNING:
            self._suit_prior(progress)
            if progress.candidates.n_each > 1:
                self._play(progress)
            else:
                self._advance(progress, may_start_again)
            if progress.status is not Status.RUNNING:
                among_first = progress.starts <= self.schedule.retrieved_starts
                if self.retrieves and among_first and progress.status is not Status.ITERATION_LIMIT:
                    retrieve_phases(self.objective, progress, *self._how, self.callback)
                if may_start_again and not progress.retrieved:
                    self.restarts.judge_start(self.objective, progress)
            save(progress)
        if progress.status is Status.ITERATION_LIMIT and progress.rival is not None:  # the last start was cut short
            progress.state = self.judge.compare(self.objective, progress.ending, progress.rival).best.state
        self._place(progress.state)
        return progress

    def _place(self, state: State) -> MyopicObjective:
        """Update the objective to the mask geometry and motion found in the state, and return it."""
        self.objective = self.setting.objective_at(self.objective, state)
        return self.objective

    def _suit_prior(self, progress: Progress) -> None:
        """Let all starts of a faint search have the prior that suits the object of the first, once it is sharp."""
        is_sharp = progress.starts == 1 and progress.iterations >= max(self.schedule.sharp_after, 1)
        if is_sharp and math.isinf(progress.rate):
            placed = self.setting.objective_at(self.objective, progress.state)
            progress.rate = rate_in_search(placed, progress.state, self.stack.change) or math.inf
        if math.isfinite(progress.rate) and progress.rate != 1:
            self.objective = self.objective.with_changes(prior=self.given.in_search(progress.rate))

    def _look_at_place(self, progress: Progress) -> None:
        """Decide whether to refine the mask's geometry, once the object is sharp enough to show an error in it."""
        if progress.refinement is Refinement.IF_SEEN and progress.iterations >= self.schedule.sharp_after:
            asked = self.end is not End.INTEGRATION and is_misplaced(self.objective, progress.state, self.schedule)
            progress.refinement = Refinement.ON if asked else Refinement.OFF

    def _first_state(self, known: Known) -> State:
        z = expected_parameters(self.objective, known.coefficients)
        return first_state(self.objective, z, known.object, self.first_inflation, self.traits)

    def _play(self, progress: Progress) -> None:
        """Play one stage of the tournament; end the tournament if no iterations are left."""
        n_each = progress.candidates.n_each
        n_iterations = self.schedule.stage_iterations(n_each)
        played = play_stage(
            self.objective,
            progress.candidates,
            n_each // 2,
            lambda objective, state: self._descend(progress, objective, state, n_iterations, self.minimizer),
            lambda objective, state: self._recalibrate(objective, state, sharpen=False),
        )
        progress.status = progress.limit(*self._limits)
        if progress.status is not Status.RUNNING:
            played = Candidates(played.state.of_frames(slice(len(self.objective.frames))), 1)
        progress.candidates = played

    def _advance(self, progress: Progress, may_start_again: bool) -> None:
        """Descend for one segment, then update what changes between two segments."""
        schedule, state, done = self.schedule, progress.state, progress.iterations
        objective = self._place(state)
        before, place = float(objective.evaluator(state.calibration)(state.image, state.z).value), state.geometry
        found = self._descend(progress, objective, state, schedule.segment, watched := Watched(self.minimizer))
        is_lost = distance(found.geometry, MaskGeometry()) > schedule.farthest  # the frames do not constrain it
        progress.refinement = Refinement.OFF if is_lost else progress.refinement
        state = state if is_lost else found
        objective = self._place(state)
        after = float(objective.evaluator(state.calibration)(state.image, state.z).value)
        progress.state, decrease = state, (before - after) / abs(after)
        is_still = distance(place, state.geometry) < schedule.still
        at_rest = is_still and self.judge.is_at_rest(objective, progress, decrease)
        self._look_at_place(progress)
        if self.judge.gives_up(objective, progress):
            progress.status = Status.GIVEN_UP
            return
        if may_start_again and self.restarts.may_end_early(objective, progress):
            progress.status = Status.START_LIMIT
            return
        goes_on = (limit := progress.limit(*self._limits)) is Status.RUNNING
        if goes_on and Free.ABERRATIONS in objective.free and progress.escapes < schedule.escapes:
            moved_nothing = progress.iterations == done
            if moved_nothing or Free.OBJECT not in objective.free or progress.iterations >= schedule.sharp_after:
                self._escape(progress, may_start_again)
        elif at_rest and not self.setting.awaits_motion(progress.state):
            progress.status, progress.decrease = Status.STUCK if watched.is_stuck else Status.CONVERGED, decrease
            return
        progress.status = limit
        if goes_on and schedule.recalibrates:
            sharpen = progress.escapes == schedule.escapes
            progress.state = self._recalibrate(objective, progress.state, sharpen=sharpen)
        if goes_on and (at_rest or progress.iterations >= schedule.sharp_after):
            progress.state = self.setting.in_motion(progress.state, self.traits.seed)

    def _descend(
        self, progress: Progress, objective: MyopicObjective, state: State, n_iterations: int, minimizer: Minimizer
    ) -> State:
        n_each = progress.candidates.n_each

        def listen(cost: float, evaluations: int, variables: Variables) -> None:
            progress.costs.append(cost / n_each)
            progress.n_evaluations += evaluations * n_each
            self._report(progress, variables)

        if progress.refinement is Refinement.ON and progress.iterations:  # the first blurred object does not show it
            objective = objective.with_changes(free=objective.free | Free.PLACE)
        left = progress.last_iteration(*self._limits) - len(progress.costs)
        return descend(objective, state, min(n_iterations, left), minimizer, listen)

    def _recalibrate(self, objective: MyopicObjective, state: State, *, sharpen: bool) -> State:
        power = self.traits.fit_power if sharpen else None
        return recalibrate(objective, state, power, follow_r0=self.traits.r0_is_open)

    def _escape(self, progress: Progress, may_start_again: bool) -> None:
        progress.escapes += 1
        objective, state = self.objective, progress.state
        how = (self.first_inflation, *self._how, progress.escapes)
        # for an object that may be wrong, whole waves would hold what starts from group delays are to change
        follows_delays = may_start_again and self.restarts.follows_delays(objective, progress)
        state, evaluations = escape(objective, state, *how, whole_waves=not follows_delays)
        progress.n_evaluations += evaluations
        if state is progress.state:  # nothing has changed: no further attempt
            progress.escapes = self.schedule.escapes
        progress.state = state

    def _report(self, progress: Progress, variables: Variables) -> None:
        if self.callback is None:
            return
        step, last, arrays = len(progress.costs), progress.last_iteration(*self._limits), {}
        if step == 1 or step % 10 == 0:
            image, z = variables()
            coefficients = self.objective.model.aberrations.coefficients(z[: len(self.objective.frames)])
            arrays = {"object": self.objective.model.window.crop(image) * self.stack.unit, "coefficients": coefficients}
        self.callback(Record("restoration", step, last, {"cost": progress.costs[-1]}, arrays))
