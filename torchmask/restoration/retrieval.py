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
_EVALUATIONS = STEPS / 2  # whose FFTs a reflection makes


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
    known_object = objective.with_changes(free=Free.ABERRATIONS)
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

    Differences of the phase between neighbouring samples are fitted, in the least-squares sense, since they are known
    where the phase itself is so but for whole waves (Hudgin, J. Opt. Soc. Am. 67, 375, 1977).
    """
    samples, basis = objective.model.pupil.samples(), objective.model.aberrations
    first, second = _neighbours(objective.model, samples.index)
    differences = (fields[:, second] * fields[:, first].conj()).angle().T.to(z)
    weights = (samples.weights[first] * samples.weights[second]).sqrt().to(z)[:, None]
    slopes = (samples.basis[second] - samples.basis[first]).to(z)
    differences = differences - slopes[:, basis.n_own :] @ z[:1, basis.n_own :].T
    matrix, pulls = (weights * slopes[:, : basis.n_own]).cpu(), (weights * differences).cpu()
    own = torch.linalg.lstsq(matrix, pulls, driver="gelsd").solution.T
    found = torch.cat([own.to(z), z[:, basis.n_own :]], dim=1)
    modes, weights = samples.basis.to(z), samples.weights.to(z)[:, None]
    matrix = (weights * torch.cat([modes[:, : basis.n_own], torch.ones_like(weights)], dim=1)).cpu()
    for _ in range(_CORRECTIONS):  # what is left is below half a wave nearly everywhere, and errs less than differences
        left = fields.T.to(torch.complex128) * torch.polar(torch.ones_like(weights), -(modes @ found.T))
        left = (left * (weights * left).sum(0).sgn().conj()).angle()
        change = torch.linalg.lstsq(matrix, (weights * left).cpu(), driver="gelsd").solution[:-1].T
        found[:, : basis.n_own] += change.to(z)
    return found


def _neighbours(model: ExposureModel, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers (M,), (M,) of samples that lie beside or above each other; `index` (P,) is their raster's."""
    shape = model.window.field.shape
    number = index.new_full((math.prod(shape),), -1)
    number[index] = torch.arange(len(index), device=index.device)
    raster = number.unflatten(0, shape)
    pairs = torch.cat([torch.stack([raster, raster.roll(-1, axis)]).flatten(1) for axis in (0, 1)], dim=1)
    first, second = pairs[:, (pairs >= 0).all(0)]
    return first, second
