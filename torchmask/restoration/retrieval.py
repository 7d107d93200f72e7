"""The phases of bright frames, retrieved once the object is sharp.

In bright light most of a full pupil's residual comes from minima of its many modes. In strong turbulence a search
leaves nearly all frames in such, and those of a mask as well. Once there is an object to hold the frames against, phase
retrieval finds them (`frame_retrieval`). For a mask one try is mostly enough, so it is made between the segments of the
last descent. Through a full pupil most tries are in vain, but every frame that is found sharpens the object, which
helps to find the next ones, so object and aberrations descend together after each of several rounds.
"""

from __future__ import annotations

import math
from dataclasses import replace

from torch import Tensor

from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, recalibrate
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Listener, descend
from torchmask.restoration.escapes import centre_on_pixels, settle
from torchmask.restoration.frame_retrieval import retrieve_frames
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State
from torchmask.restoration.traits import Traits

_POOR = 2.0  # of the median chi-square: a frame with more is tried again, whatever was found
_FIRST = 3  # lost frames that are tried before the others, at least: one may hold what no phases explain
_SURE = 3.0  # standard deviations of the chi-square of a frame that do not occur by chance


def retrieve_phases(
    objective: MyopicObjective,
    ended: Progress,
    traits: Traits,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None,
) -> None:
    """Give `ended` the state to which phase retrieval leads, if that leaves clearly less of the frames unexplained.

    A round tries the frames that leave more than the noise and whose phases have not been found. There are rounds while
    more is left of all frames than the noise, until as many tries as there are frames were in vain. The best is kept.
    """
    first = best = state = calibrate(objective, ended.state)
    n_iterations = schedule.retrieved_segments * schedule.segment
    listen = ended.reporter("phase retrieval", schedule.retrievals * n_iterations, callback)
    missing, in_vain = state.calibration.noise_inflation - 1 > schedule.retrieved_from, 0
    for number in range(schedule.retrievals):
        tried = (missing | _is_poor(state)).nonzero().flatten()
        if _excess(state) <= schedule.retrieved_from or in_vain >= len(missing) or not len(tried):
            break
        how = (schedule.reflections_full, traits.seed + number, schedule, minimizer)
        trial = retrieve_frames(objective, state, tried, *how)
        ended.n_evaluations += trial.n_evaluations
        missing[tried] = trial.missing
        in_vain = 0 if trial.n_found else in_vain + len(tried)
        state = _descend_together(objective, trial.state, traits, schedule, minimizer, listen)
        best = min(best, state, key=_excess)
    if _excess(best) < schedule.retrieved_gain * _excess(first):
        ended.state, ended.retrieved = best, True


def retrieve_lost_frames(
    objective: MyopicObjective, state: State, seed: int, schedule: Schedule, minimizer: Minimizer
) -> tuple[State, int]:
    """Return the state with phases retrieved of frames that leave more than noise, and the evaluations it took.

    It is `state` itself if none are found. The worst quarter of the frames is tried first, or the worst three, and the
    others only if some of those are found: where frames hold what the model lacks, none are.
    """
    now, found, evaluations = calibrate(objective, state), state, 0
    excess = now.calibration.noise_inflation - 1
    pixels = (objective.precision.expand_as(objective.frames) > 0).sum((1, 2))
    lost = (excess > (_SURE * (2 / pixels).sqrt()).clamp(min=schedule.lost)).nonzero().flatten()
    worst_first = lost[excess[lost].argsort(descending=True)]
    n_first = max(_FIRST, math.ceil(len(lost) / 4))
    for tried in (worst_first[:n_first], worst_first[n_first:]):
        if not len(tried):
            break
        trial = retrieve_frames(objective, now, tried, schedule.reflections, seed, schedule, minimizer)
        evaluations += trial.n_evaluations
        if not trial.n_found:
            break
        now, found = trial.state, replace(state, z=trial.state.z)
    return found, evaluations


def _excess(state: State) -> float:
    """Return the mean chi-square of the frames above that of noise."""
    return float(state.calibration.noise_inflation.mean()) - 1


def _is_poor(state: State) -> Tensor:
    """Return which frames (T,) fit much worse than most."""
    inflation = state.calibration.noise_inflation
    return inflation > _POOR * inflation.median()


def _descend_together(
    objective: MyopicObjective,
    state: State,
    traits: Traits,
    schedule: Schedule,
    minimizer: Minimizer,
    listen: Listener,
) -> State:
    """Return the calibrated state after a descent of object and aberrations.

    The sharper the object, the more it matters where it lies on the pixels, and random tilts have moved the frames.
    """
    for number in range(schedule.retrieved_segments):
        state = recalibrate(objective, state, traits.fit_power, follow_r0=traits.r0_is_open)
        if number == 0:
            state = centre_on_pixels(objective, state, schedule)
        state = settle(objective, state, schedule.last_settling)
        state = descend(objective, state, schedule.segment, minimizer, listen)
    return calibrate(objective, state)
