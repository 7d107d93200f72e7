"""The frames of a full pupil that the search leaves in poor minima, once the object is sharp.

In bright light most of a full pupil's residual comes from minima of its many modes. Once there is an object to hold the
frames against, phase retrieval finds the field of each frame from anywhere (`reflections`). Its phase is unwrapped and
becomes the start of a descent in the modes; frames that end lower there than before keep it, and object and aberrations
descend together. Better aberrations sharpen the object, so this is done a few times.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from skimage.restoration import unwrap_phase
from torch import Tensor

from torchmask.record import Callback
from torchmask.restoration.calibration import calibrate, recalibrate, share_noise_inflation
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import Listener, descend
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.reflections import STEPS, retrieve_fields
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_LOWER = 0.99  # of its cost before: a frame that comes back to where it was is no gain
_PROMISING = 0.9  # of the excess chi-square before all rounds: with more left after one, others bring little
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

    Phases are unwrapped by the method of Herraez et al., Appl. Opt. 41, 7437 (2002).
    """
    samples, basis = objective.model.pupil.samples(), objective.model.aberrations
    shape, index = objective.model.window.field.shape, samples.index.cpu().numpy()
    closed = np.ones(shape, bool)
    closed.flat[index] = False
    closed = np.fft.fftshift(closed)
    phases = []
    for wrapped in fields.angle().cpu().numpy():
        raster = np.zeros(shape)
        raster.flat[index] = wrapped
        smooth = unwrap_phase(np.ma.array(np.fft.fftshift(raster), mask=closed), rng=0)
        phases.append(np.fft.ifftshift(np.asarray(smooth)).flat[index])
    modes = samples.basis.to(z)
    known = modes[:, basis.n_own :] @ z[:1, basis.n_own :].T
    columns = torch.cat([modes[:, : basis.n_own], torch.ones_like(known)], dim=1)  # a piston, which no frame shows
    phase = torch.as_tensor(np.stack(phases, axis=1)).to(z) - known
    weights = samples.weights.to(z)[:, None]
    found = torch.linalg.lstsq((weights * columns).cpu(), (weights * phase).cpu(), driver="gelsd").solution
    return basis.with_common_of(torch.cat([found[:-1].T.to(z), z[:, basis.n_own :]], dim=1), z)
