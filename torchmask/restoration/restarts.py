"""What follows a start of a restoration when it has ended: another one, or the end of the search."""

from __future__ import annotations

from dataclasses import dataclass, replace

from torchmask.record import Callback
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Ending, Progress, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.group_delays import start_from_delays, tells_delays
from torchmask.restoration.judge import Judge
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.spectrum import shows_gentle_slopes
from torchmask.restoration.starts import expected_parameters, first_candidates, first_state
from torchmask.restoration.state import Modes, State
from torchmask.restoration.tempering import temper
from torchmask.restoration.traits import Traits
from torchmask.restoration.twins import twin_of
from torchmask.restoration.verdict import Finding


@dataclass(frozen=True)
class Restarts:
    """Starts a restoration again as long as that may find a better object than the best so far.

    `averages` is whether the mean of the starts that explain the frames is wanted, as for a full pupil.
    `first_inflation` is the noise inflation with which a start begins. `callback` is told of rounds
    that prepare one.
    """

    setting: Setting
    stack: FrameStack
    judge: Judge
    traits: Traits
    schedule: Schedule
    first_inflation: float
    averages: bool
    minimizer: Minimizer
    callback: Callback | None

    def judge_start(self, objective: MyopicObjective, progress: Progress) -> None:
        """At the end of a start, keep the best so far, and begin another one if that may have missed the object.

        For a full pupil others begin until enough explain the frames, unless two agree.
        """
        may_be_blurred = progress.rival is None or progress.status is Status.ITERATION_LIMIT
        if may_be_blurred and progress.iterations <= self.schedule.sharp_after:
            return  # its object is not sharp enough to be judged
        found = self.judge.compare(objective, progress.ending, progress.rival)
        best, progress.alike = found.best, found.alike
        if self.averages and found.now.explained:
            progress.explained += (progress.ending,)
        progress.in_vain = 0 if found.advances else progress.in_vain + 1
        has_delays = self._tells_delays(objective, best.state)
        # where the pistons are at the group delays, no twin is left to look for
        is_sure = found.verdict.explained and not self.judge.is_doubted(found.verdict)
        is_settled = has_delays and is_sure and progress.in_vain > 0
        if not is_settled and self.judge.wants_another(found.verdict, progress):
            if has_delays and progress.in_vain == 0 and self.judge.has_room(progress):
                self._start_from_delays(objective, progress, best)
            else:
                self._start_again(objective, progress, best)
        elif self.judge.may_temper(found.verdict, progress) and self._is_gentle(objective, best.state):
            self._temper(objective, progress, best)
        else:
            progress.state, progress.status, progress.decrease = best.state, best.status, best.decrease

    def may_end_early(self, objective: MyopicObjective, progress: Progress) -> bool:
        """Return whether the first start need not go on, as one from its group delays is better than waiting.

        That is from one segment after its object is sharp, unless it explains the frames, or the schedule wants one
        start, or too few iterations are left for a whole one.
        """
        is_sharp = progress.iterations >= self.schedule.sharp_after + self.schedule.segment
        if not (progress.starts == 1 and is_sharp and self.judge.has_room_for_all(progress)):
            return False
        if not self.follows_delays(objective, progress):  # told in less time than a verdict
            return False
        return self.judge.verdict(objective, progress.ending).finding is Finding.NOT_EXPLAINED

    def follows_delays(self, objective: MyopicObjective, progress: Progress) -> bool:
        """Return whether a start from group delays may follow the present one.

        The schedule has to want another, iterations have to be left for it, and the frames have to tell group delays.
        """
        schedule = self.schedule
        may_follow = schedule.in_vain > 0 and progress.starts < schedule.starts and self.judge.has_room(progress)
        return may_follow and self._tells_delays(objective, progress.state)

    def _tells_delays(self, objective: MyopicObjective, state: State) -> bool:
        """Return whether the frames of a mask that has twins are of a band that tells group delays."""
        if not self.judge.has_twins or len(objective.model.band.wavelengths) == 1:
            return False
        return tells_delays(self.setting.objective_at(objective, state), state)

    def _start_from_delays(self, objective: MyopicObjective, progress: Progress, best: Ending) -> None:
        """Begin from the group delays of the best object."""
        self._begin(progress, best)
        placed = self.setting.objective_at(objective, best.state)
        how = (self.first_inflation, self.minimizer, self.callback)
        state, evaluations = start_from_delays(placed, best.state, *how)
        progress.candidates = Candidates(state, 1)
        progress.n_evaluations += evaluations

    def _start_again(self, objective: MyopicObjective, progress: Progress, best: Ending) -> None:
        """Begin from a twin of the best object, or from random aberrations."""
        is_twin = self.judge.is_twin(progress.starts + 1, self.judge.verdict(objective, best))
        seed, state = self._begin(progress, best), best.state
        if is_twin:
            placed = self.setting.objective_at(objective, state)
            progress.candidates = Candidates(twin_of(placed, state, self.first_inflation, seed), 1)
            return
        placed = self.setting.objective_at(objective, replace(state, modes=Modes.STILL))
        first = first_state(placed, expected_parameters(placed, None), None, self.first_inflation, self.traits)
        first = replace(first, geometry=state.geometry)
        progress.candidates = first_candidates(placed, first, self.traits, self.schedule, seed)

    def _temper(self, objective: MyopicObjective, progress: Progress, best: Ending) -> None:
        """Begin from the best object, heated."""
        seed, progress.tempered = self._begin(progress, best), True
        placed = self.setting.objective_at(objective, best.state)
        state, evaluations = temper(placed, best.state, self.schedule, seed, self.callback)
        progress.candidates = Candidates(state, 1)
        progress.n_evaluations += evaluations

    def _begin(self, progress: Progress, best: Ending) -> int:
        """Begin another start, and return its seed."""
        progress.start_again(best)
        return self.traits.seed + progress.starts - 1

    def _is_gentle(self, objective: MyopicObjective, state: State) -> bool:
        change, placed = self.stack.change, self.setting.objective_at(objective, state)
        return shows_gentle_slopes(placed, state, change, faint=change.each < self.schedule.faint)
