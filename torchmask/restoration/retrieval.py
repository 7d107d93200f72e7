"""The phases of a full pupil's frames in bright light, retrieved once the object is sharp.

In bright light most of a full pupil's residual comes from minima of its many modes, and in strong turbulence a search
leaves nearly all frames in such. Once there is an object to hold the frames against, phase retrieval finds the field of
a frame from random phases (`reflections`), though seldom at once. The modes closest to its phase are the start of a
descent; frames that end lower there than before keep it, and object and aberrations descend together. Every frame that
is found sharpens the object, which helps to find the next ones, so this is done in rounds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, recalibrate, share_noise_inflation
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Listener, Variables, descend
from torchmask.restoration.escapes import centre_on_pixels, settle
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.reflections import STEPS, retrieve_fields
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.starts import random_candidates
from torchmask.restoration.state import State
from torchmask.restoration.traits import Traits

_LOWER = 0.99  # of its cost before: a frame that comes back to where it was is no gain
_FOUND = 0.75  # of a frame's excess chi-square before: with no more left, its phases have been found
_AGAIN = 1.1  # of its chi-square before: with no more left,
_ALIKE = 0.8  # and fields that agree so far (1: all over the pupil), random phases have led back to where a frame was
_POOR = 2.0  # of the median chi-square: a frame with more is tried again, whatever was found
_CORRECTIONS = 3  # of the modes by the phase that is left
_EVALUATIONS = STEPS / 2 + 1  # whose FFTs a reflection makes


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
        trial = _try_frames(objective, state, tried, traits.seed + number, schedule, minimizer)
        spent = trial.evaluations + schedule.reflections * _EVALUATIONS
        ended.n_evaluations += round(spent * len(tried) / len(missing))
        missing[tried] = trial.missing
        in_vain = 0 if trial.n_found else in_vain + len(tried)
        state = _descend_together(objective, trial.state, traits, schedule, minimizer, listen)
        best = min(best, state, key=_excess)
    if _excess(best) < schedule.retrieved_gain * _excess(first):
        ended.state, ended.retrieved = best, True


def _excess(state: State) -> float:
    """Return the mean chi-square of the frames above that of noise."""
    return float(state.calibration.noise_inflation.mean()) - 1


def _is_poor(state: State) -> Tensor:
    """Return which frames (T,) fit much worse than most."""
    inflation = state.calibration.noise_inflation
    return inflation > _POOR * inflation.median()


class _Trial(NamedTuple):
    """The state after a round's retrieval, and what has become of the frames that were tried.

    state : state with the aberrations of the frames that end lower
    n_found : number of frames for which better phases have been found
    missing : (n,) whether neither better phases have been found nor those that a frame had
    evaluations : number of evaluations of these frames
    """

    state: State
    n_found: int
    missing: Tensor
    evaluations: int


def _try_frames(
    objective: MyopicObjective, state: State, tried: Tensor, seed: int, schedule: Schedule, minimizer: Minimizer
) -> _Trial:
    """Retrieve the phases of the frames `tried` (n,) from random ones, for the object of the calibrated `state`.

    Aberrations in common stay as they are, since only some frames may change.
    """
    spent = 0

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent
        spent += evaluations

    part, now = objective.of_frames(tried, free=Free.ABERRATIONS), share_noise_inflation(state).of_frames(tried)
    fresh = random_candidates(part, now, 1, schedule.start_rms, seed).state
    fields = retrieve_fields(part, fresh, schedule.reflections)
    trial = replace(now, z=parameters_of_fields(part, fields, now.z))
    trial = descend(part, trial, schedule.retrieved_iterations, minimizer, count)
    after, before = (part.frame_costs(now.image, z, now.calibration) for z in (trial.z, now.z))
    left, least = (s.calibration.noise_inflation for s in (calibrate(part, trial), state.of_frames(tried)))
    lower = after < _LOWER * before
    found = lower & (left - 1 < _FOUND * (least - 1))
    again = (left < _AGAIN * least) & (_agreement(part, trial.z - now.z) > _ALIKE)
    z = state.z.clone()
    z[tried] = torch.where(lower[:, None], trial.z, now.z)
    return _Trial(replace(state, z=z), int(found.sum()), ~(found | again), spent)


def _agreement(objective: MyopicObjective, z: Tensor) -> Tensor:
    """Return how far fields agree (T,) whose aberrations differ by `z` (T, K): 1 if but for a constant phase."""
    samples = objective.model.pupil.samples()
    fields = samples.field(samples.phase(z))
    return fields.sum(1).abs() / samples.weights.sum()


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


def parameters_of_fields(objective: MyopicObjective, fields: Tensor, z: Tensor) -> Tensor:
    """Return the parameters (T, K) whose phase is closest to that of `fields` (T, P); those in common are as in `z`.

    Differences of the phase between neighbouring samples are fitted first, since they are known where the phase itself
    is so but for whole waves (Hudgin, J. Opt. Soc. Am. 67, 375, 1977). They weigh the steep structure that the modes
    leave out too much; but what they leave is below half a wave nearly everywhere, so the phase itself is fitted then.
    """
    samples, n_own = objective.model.pupil.samples(), objective.model.aberrations.n_own
    modes, amplitude = samples.basis.to(z), samples.weights.to(z)
    own, found = modes[:, :n_own], z.clone()
    found[:, :n_own] = 0

    def turned_back() -> Tensor:
        return fields * torch.exp(-1j * (found @ modes.T))

    first, second = _neighbours(objective.model, samples.index)
    turned = turned_back()
    steps = (turned[:, second] * turned[:, first].conj()).angle()
    found[:, :n_own] = _fit(own[second] - own[first], steps, (amplitude[first] * amplitude[second]).sqrt())
    own = torch.cat([own, torch.ones_like(own[:, :1])], dim=1)  # and a piston, which no frame shows
    for _ in range(_CORRECTIONS):
        turned = turned_back()
        left = (turned * (amplitude * turned).sum(1, keepdim=True).conj()).angle()
        found[:, :n_own] += _fit(own, left, amplitude)[:, :-1]
    return found


def _fit(columns: Tensor, values: Tensor, weights: Tensor) -> Tensor:
    """Return the coefficients (T, K) of `columns` (M, K) that fit `values` (T, M) best, with weights (M,)."""
    matrix, right = (weights[:, None] * columns).cpu(), (weights * values.to(columns)).T.cpu()
    return torch.linalg.lstsq(matrix, right, driver="gelsd").solution.T.to(columns)


def _neighbours(model: ExposureModel, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers (M,), (M,) of samples that lie beside or above each other; `index` (P,) is their raster's."""
    shape = model.window.field.shape
    number = index.new_full((math.prod(shape),), -1)
    number[index] = torch.arange(len(index), device=index.device)
    raster = number.unflatten(0, shape)
    pairs = torch.cat([torch.stack([raster, raster.roll(-1, axis)]).flatten(1) for axis in (0, 1)], dim=1)
    first, second = pairs[:, (pairs >= 0).all(0)]
    return first, second
