"""The end of a restoration through a mask: faint frames are integrated over, others get a finer model.

A descent from far away takes few modes per sub-aperture. Close to the solution, more of them take away much of what the
model leaves unexplained. So once all has come to rest, the aberrations gain modes, and the object a smoother prior
(`ObjectPrior.smoother`), and that descent goes on while it gains.
"""

from __future__ import annotations

from torchmask.record import Callback
from torchmask.restoration.calibration import recalibrate
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import settle
from torchmask.restoration.marginal import integrate_aberrations
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.traits import Traits


def finish(
    objective: MyopicObjective,
    setting: Setting,
    ended: Progress,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None,
    traits: Traits,
    *,
    is_faint: bool,
) -> MyopicObjective:
    """Finish a restoration that has come to rest: update `ended`, and return the objective of its state."""
    if is_faint:
        how = {"seed": traits.seed, "follow_r0": traits.r0_is_open}
        ended.state, spent = integrate_aberrations(objective, ended.state, schedule, minimizer, callback, **how)
        ended.n_evaluations += spent
        ended.integrated = True
        return objective
    if not schedule.last_segments:
        return objective
    state = setting.in_finer_modes(ended.state)
    objective = setting.objective_at(objective, state).with_changes(prior=objective.prior.smoother())
    report, costs = ended.reporter("last descent", schedule.last_segments * schedule.segment, callback), []

    def listen(cost: float, evaluations: int, variables: Variables) -> None:
        costs.append(cost)
        report(cost, evaluations, variables)

    for _ in range(schedule.last_segments):
        costs.clear()
        if schedule.recalibrates:
            state = recalibrate(objective, state, power=1, follow_r0=traits.r0_is_open)
        state = descend(objective, state, schedule.segment, minimizer, listen)
        if not costs or costs[len(costs) // 2] - costs[-1] <= schedule.last_gain * abs(costs[-1]):
            break
    ended.state = settle(objective, state, schedule.last_settling)  # a descent moves flat parts of the object slowly
    return objective
