"""The phases of single bright frames, retrieved for the object at hand.

Phase retrieval finds the field of a frame from random phases (`reflections`), nearly always through a mask. The modes
closest to its phase are the start of a descent of the aberrations; frames that end lower there than before keep it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.restoration.calibration import calibrate, share_noise_inflation, unwrap_pistons
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.pupil import OpenSamples
from torchmask.restoration.reflections import LAST, STEPS, retrieve_fields
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.starts import random_candidates
from torchmask.restoration.state import State

_LOWER = 0.99  # of its cost before: a frame that comes back to where it was is no gain
_FOUND = 0.75  # of a frame's excess chi-square before: with no more left, its phases have been found
_AGAIN = 1.1  # of its chi-square before: with no more left,
_ALIKE = 0.8  # and fields that agree so far (1: all over the pupil), random phases have led back to where a frame was
_ROUNDING = 1e-5  # of the largest singular value: what is smaller is rounding, of columns in float32 at worst
_CORRECTIONS = 3  # of the modes by the phase that is left
_EVALUATIONS = STEPS / 2 + 1  # whose FFTs a reflection makes


class Trial(NamedTuple):
    """The state after phases of some frames have been retrieved, and what has become of these frames.

    state : state with the aberrations of the frames that end lower
    n_found : number of frames for which better phases have been found
    missing : (n,) whether neither better phases have been found nor those that a frame had
    n_evaluations : number of evaluations of all frames whose FFTs it took
    """

    state: State
    n_found: int
    missing: Tensor
    n_evaluations: int


def retrieve_frames(
    objective: MyopicObjective,
    state: State,
    tried: Tensor,
    n_reflections: int,
    seed: int,
    schedule: Schedule,
    minimizer: Minimizer,
) -> Trial:
    """Retrieve the phases of the frames `tried` (n,) from random ones, for the object of the calibrated `state`.

    Aberrations in common stay as they are, since only some frames may change.
    """
    part, now = objective.of_frames(tried, free=Free.ABERRATIONS), share_noise_inflation(state).of_frames(tried)
    fresh = random_candidates(part, now, 1, schedule.start_rms, seed).state
    fields, n_made = retrieve_fields(part, fresh, n_reflections)
    spent = (float(n_made.double().mean()) + LAST) * _EVALUATIONS

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent
        spent += evaluations

    trial = unwrap_pistons(part, replace(now, z=parameters_of_fields(part, fields, now.z)))
    trial = descend(part, trial, schedule.retrieved_iterations, minimizer, count)
    after, before = (part.frame_costs(now.image, z, now.calibration) for z in (trial.z, now.z))
    left, least = (s.calibration.noise_inflation for s in (calibrate(part, trial), state.of_frames(tried)))
    lower = after < _LOWER * before
    found = lower & (left - 1 < _FOUND * (least - 1))
    again = (left < _AGAIN * least) & (_agreement(part, trial.z - now.z) > _ALIKE)
    z = state.z.clone()
    z[tried] = torch.where(lower[:, None], trial.z, now.z)
    share = len(tried) / len(z)
    return Trial(replace(state, z=z), int(found.sum()), ~(found | again), round(spent * share))


def _agreement(objective: MyopicObjective, z: Tensor) -> Tensor:
    """Return how far fields agree (T,) whose aberrations differ by `z` (T, K): 1 if but for a constant phase."""
    samples = objective.model.pupil.samples()
    fields = samples.field(samples.phase(z))
    return fields.sum(1).abs() / samples.weights.sum()


def parameters_of_fields(objective: MyopicObjective, fields: Tensor, z: Tensor) -> Tensor:
    """Return the parameters (T, K) whose phase is closest to that of `fields` (T, P); those in common are as in `z`.

    Differences of the phase between neighbouring samples are fitted first, since they are known where the phase itself
    is so but for whole waves (Hudgin, J. Opt. Soc. Am. 67, 375, 1977), and then the piston of each hole. Differences
    weigh the steep structure that the modes leave out too much; but what they leave is below half a wave nearly
    everywhere, so the phase itself is fitted then.
    """
    samples, basis = objective.model.pupil.samples(), objective.model.aberrations
    modes, amplitude = samples.basis.to(z), samples.weights.to(z)
    own, found = modes[:, : basis.n_own], z.clone()
    found[:, : basis.n_own] = 0

    def turned_back() -> Tensor:
        return fields * torch.exp(-1j * (found @ modes.T))

    first, second = _neighbours(objective.model, samples.index)
    turned = turned_back()
    steps = (turned[:, second] * turned[:, first].conj()).angle()
    found[:, : basis.n_own] = _fit(own[second] - own[first], steps, (amplitude[first] * amplitude[second]).sqrt())
    holes = torch.zeros(len(z), basis.n_subapertures, dtype=turned.dtype, device=z.device)
    light = holes.index_add(1, _hole_of(objective.model, samples), amplitude * turned_back())
    found += basis.parameters_of_pistons(light.angle() / samples.chromaticity[0]).to(found)
    own = torch.cat([own, torch.ones_like(own[:, :1])], dim=1)  # and a piston, which no frame shows
    for _ in range(_CORRECTIONS):
        turned = turned_back()
        left = (turned * (amplitude * turned).sum(1, keepdim=True).conj()).angle()
        found[:, : basis.n_own] += _fit(own, left, amplitude)[:, :-1]
    return found


def _hole_of(model: ExposureModel, samples: OpenSamples) -> Tensor:
    """Return the number of the hole (P,) that each sample belongs to."""
    centers = model.pupil.aperture.centers.detach().to(samples.positions) / model.window.field.period
    return torch.cdist(samples.positions, samples.chromaticity[0] * centers).argmin(1)


def _fit(columns: Tensor, values: Tensor, weights: Tensor) -> Tensor:
    """Return the coefficients (T, K) of `columns` (M, K) that fit `values` (T, M) best, with weights (M,).

    What the columns hold only by rounding, such as pistons in differences, is left at zero.
    """
    matrix, right = (weights[:, None] * columns).cpu(), (weights * values.to(columns)).T.cpu()
    return torch.linalg.lstsq(matrix, right, rcond=_ROUNDING, driver="gelsd").solution.T.to(columns)


def _neighbours(model: ExposureModel, index: Tensor) -> tuple[Tensor, Tensor]:
    """Return the numbers (M,), (M,) of samples that lie beside or above each other; `index` (P,) is their raster's."""
    shape = model.window.field.shape
    number = index.new_full((math.prod(shape),), -1)
    number[index] = torch.arange(len(index), device=index.device)
    raster = number.unflatten(0, shape)
    pairs = torch.cat([torch.stack([raster, raster.roll(-1, axis)]).flatten(1) for axis in (0, 1)], dim=1)
    first, second = pairs[:, (pairs >= 0).all(0)]
    return first, second
