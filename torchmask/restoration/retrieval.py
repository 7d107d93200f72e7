"""The frames of a full pupil that the search leaves in poor minima, once the object is sharp.

In bright light most of a full pupil's residual comes from minima of its many modes. Once there is an object to hold the
frames against, phase retrieval finds the field of each frame from anywhere (`reflections`). The modes closest to its
phase are the start of a descent; frames that end lower there than before keep it, and object and aberrations
descend together. Better aberrations sharpen the object, so this is done a few times.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, recalibrate, share_noise_inflation
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Listener, descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.reflections import STEPS, retrieve_fields
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_LOWER = 0.99  # of its cost before: a frame that comes back to where it was is no gain
_PROMISING = 0.9  # of the excess chi-square before all rounds: with more left after one, others bring little
_CORRECTIONS = 3  # of the modes by the phase that is left
_EVALUATIONS = STEPS / 2 + 1  # whose FFTs a reflection makes


def retrieve_phases(
    objective: MyopicObjective,
    ended: Progress,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None,
    *,
    follow_r0: bool,
) -> None:
    """Give `ended` the state to which phase retrieval leads, if that leaves clearly less of the frames unexplained.

    Another round follows while frames gain, less is left than at first, and more than the noise.
    """
    first = state = calibrate(objective, ended.state)
    n_iterations = schedule.retrieved_iterations + schedule.retrieved_segments * schedule.segment
    listen = ended.reporter("phase retrieval", schedule.retrievals * n_iterations, callback)
    for _ in range(schedule.retrievals):
        if _excess(state) <= schedule.retrieved_from:
            break
        state, n_better = _retrieve_once(objective, state, schedule, minimizer, listen, follow_r0=follow_r0)
        ended.n_evaluations += round(schedule.reflections * _EVALUATIONS)
        if not n_better or _excess(state) > _PROMISING * _excess(first):
            break
    if _excess(state) < schedule.retrieved_gain * _excess(first):
        ended.state, ended.retrieved = state, True


def _excess(state: State) -> float:
    """Return the mean chi-square of the frames above that of noise."""
    return float(state.calibration.noise_inflation.mean()) - 1


def _retrieve_once(
    objective: MyopicObjective,
    state: State,
    schedule: Schedule,
    minimizer: Minimizer,
    listen: Listener,
    *,
    follow_r0: bool,
) -> tuple[State, int]:
    """Return the calibrated state after one round, and the number of frames that phase retrieval has brought lower."""
    shared = share_noise_inflation(state)
    fields = retrieve_fields(objective, shared, schedule.reflections)
    known_object = objective.with_changes(free=Free.ABERRATIONS)  # those in common stay, as only some frames may change
    trial = replace(shared, z=parameters_of_fields(objective, fields, shared.z))
    trial = descend(known_object, trial, schedule.retrieved_iterations, minimizer, listen)
    after, before = (objective.frame_costs(shared.image, z, shared.calibration) for z in (trial.z, shared.z))
    better = after < _LOWER * before
    state = replace(state, z=torch.where(better[:, None], trial.z, state.z))
    for _ in range(schedule.retrieved_segments):
        state = recalibrate(objective, state, power=2, follow_r0=follow_r0)
        state = descend(objective, state, schedule.segment, minimizer, listen)
    return calibrate(objective, state), int(better.sum())


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
