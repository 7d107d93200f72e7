"""The end of a restoration: through a mask a finer model, and in noisy light its aberrations are integrated out.

A descent from far away takes few modes per sub-aperture. Close to the solution, more of them take away much of what the
model leaves unexplained. So once the search has ended, the aberrations gain modes, and the object a smoother prior
(`ObjectPrior.smoother`), and that descent goes on while it gains. Where noise leaves the aberrations uncertain, they
are integrated out after it, or in its place if frames are faint. For a full pupil phases are retrieved.
"""

from __future__ import annotations

from collections.abc import Callable

from torchmask.record import Callback
from torchmask.restoration.calibration import recalibrate
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import settle
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.retrieval import retrieve_phases
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.traits import End, Traits


def finish(
    objective: MyopicObjective,
    setting: Setting,
    ended: Progress,
    end: End,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None,
    traits: Traits,
    save: Callable[[Progress], None],
) -> MyopicObjective:
    """Finish a restoration whose search has ended: update `ended`, and return the objective of its state.

    `save` is called after every segment of the last descent, which goes on where an interrupted one was.
    """
    if end is End.RETRIEVAL:
        retrieve_phases(objective, ended, schedule, minimizer, callback, follow_r0=traits.r0_is_open)
        return objective
    if end.descends:
        objective = descend_in_finer_modes(objective, setting, ended, schedule, minimizer, callback, traits, save)
    if end is not End.LAST_DESCENT:
        rounds = schedule.fine_rounds if end.descends else schedule.rounds
        how = {"seed": traits.seed, "follow_r0": traits.r0_is_open}
        ended.state, spent = integrate_aberrations(objective, ended.state, rounds, schedule, minimizer, callback, **how)
        ended.n_evaluations += spent
        ended.integrated = True
    return objective


def descend_in_finer_modes(
    objective: MyopicObjective,
    setting: Setting,
    ended: Progress,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None,
    traits: Traits,
    save: Callable[[Progress], None],
) -> MyopicObjective:
    """Run the last descent: update `ended`, and return the objective of its state."""
    state = setting.in_finer_modes(ended.state) if ended.finer is None else ended.finer
    objective = setting.objective_at(objective, state).with_changes(prior=objective.prior.smoother())
    most, done = (number * schedule.segment for number in (schedule.last_segments, ended.last_segments))
    report, costs = ended.reporter("last descent", most, callback, done), []

    def listen(cost: float, evaluations: int, variables: Variables) -> None:
        costs.append(cost)
        report(cost, evaluations, variables)

    while ended.last_segments < schedule.last_segments:
        costs.clear()
        if schedule.recalibrates:
            state = recalibrate(objective, state, power=1, follow_r0=traits.r0_is_open)
        state = descend(objective, state, schedule.segment, minimizer, listen)
        gains = bool(costs) and costs[len(costs) // 2] - costs[-1] > schedule.last_gain * abs(costs[-1])
        ended.finer, ended.last_segments = state, ended.last_segments + 1 if gains else schedule.last_segments
        save(ended)
    ended.state = settle(objective, state, schedule.last_settling)  # a descent moves flat parts of the object slowly
    return objective
