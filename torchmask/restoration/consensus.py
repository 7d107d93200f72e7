"""The mean of the objects at which several starts end, with the aberrations that fit it.

The cost of a full pupil has many minima that explain the frames almost equally well, and it does not tell which object
is nearest to the truth. Their mean approximates the posterior mean, which has the least expected squared error. Starts
of one restoration differ by where the object lies, which frames do not determine, so they are registered first.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchmask.metrics import registration, shift
from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, share_noise_inflation
from torchmask.restoration.candidates import Candidates, select, with_candidates
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import descend
from torchmask.restoration.escapes import tilt
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import Calibration, State


def average_starts(
    objective: MyopicObjective, ended: Progress, schedule: Schedule, minimizer: Minimizer, callback: Callback | None
) -> None:
    """Give `ended` the mean object of its starts that explain the frames, and the aberrations fitted to that object.

    Each frame begins with those aberrations among the starts' that fit the mean object best.
    """
    states = [ending.state for ending in ended.explained]
    together = registered_mean(objective, states)
    n_each = len(states) if not objective.model.aberrations.n_common else 1  # which all frames share
    together = together.of_frames(slice(n_each * len(objective.frames)))
    crowded = with_candidates(objective, n_each)
    fitted = share_noise_inflation(calibrate(crowded, together))
    best = select(crowded, Candidates(fitted, n_each), 1).state
    listen = ended.reporter("fit to the mean", schedule.segment, callback)
    known_object = objective.with_changes(free=objective.free & ~Free.OBJECT)
    found = descend(known_object, best, schedule.segment, minimizer, listen)
    ended.state, ended.averaged = calibrate(objective, found), len(states)
    ended.n_evaluations += 2 * n_each  # calibration and choice


def registered_mean(objective: MyopicObjective, states: list[State]) -> State:
    """Return the mean object of `states`, registered with the first, and the aberrations of one state after another.

    Aberrations are tilted by as much as their object is shifted, so that the images stay where they are.
    """
    reference, total, z = states[0].image, torch.zeros_like(states[0].image), []
    for state in states:
        offset = registration(state.image.double().cpu(), reference.double().cpu()).tolist()
        total += shift(state.image, (offset[0], offset[1])).clamp(min=0) / len(states)
        z.append(state.z - tilt(objective.model, (offset[0], offset[1])).to(state.z))
    calibrations = [state.calibration for state in states]
    together = Calibration(
        torch.cat([now.transmission for now in calibrations]),
        torch.cat([now.noise_inflation for now in calibrations]),
        sum(now.aberration_weight for now in calibrations) / len(states),
    )
    return replace(states[0], image=total, z=torch.cat(z), calibration=together)
