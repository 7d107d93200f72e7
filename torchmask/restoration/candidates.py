"""A tournament of random initial aberrations for every frame of a full pupil, of which the best are kept.

Phase retrieval over a full pupil has many local minima, most of them poor, and a random start rarely reaches a good one
even with the true object. All candidates of all frames are therefore fitted together with one object, from blurred to
sharp, and the worse half of each frame's candidates is dropped at the end of every stage.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import Calibration, State


@dataclass(frozen=True)
class Candidates:
    """A state with several candidates for each frame: the first of all T frames, then the second, and so on.

    state : state of all candidates, as if each were a frame
    n_each : number of candidates for each frame; 1: the state is that of the frames themselves
    """

    state: State
    n_each: int


Descend = Callable[[MyopicObjective, State], State]


def several(state: State, n_each: int) -> Candidates:
    """Return `n_each` copies of `state` as candidates."""
    now = state.calibration
    repeated = Calibration(now.transmission.repeat(n_each), now.noise_inflation.repeat(n_each), now.aberration_weight)
    return Candidates(replace(state, z=state.z.repeat(n_each, 1), calibration=repeated), n_each)


def with_candidates(objective: MyopicObjective, n_each: int) -> MyopicObjective:
    """Return the objective with every frame `n_each` times, in single precision.

    The object's prior counts as many times, so that its weight relative to the misfit is the same.
    """
    model = objective.model.single()
    single = MyopicObjective(
        model,
        objective.frames.to(model.dtype),
        objective.precision.to(model.dtype),
        objective.prior,
        centre=objective.centre,
        free=objective.free,
        parallel=objective.parallel,
    )
    every = torch.arange(len(objective.frames), device=objective.frames.device).repeat(n_each)
    return single.of_frames(every, prior_copies=n_each)


def play_stage(
    objective: MyopicObjective,
    candidates: Candidates,
    n_kept: int,
    descend: Descend,
    recalibrate: Descend,
) -> Candidates:
    """Play one stage: all candidates descend and are recalibrated, and the best `n_kept` of each frame are kept.

    `objective` is that of the frames themselves.
    """
    crowded = with_candidates(objective, candidates.n_each)
    state = recalibrate(crowded, descend(crowded, candidates.state))
    return select(crowded, replace(candidates, state=state), n_kept)


def select(crowded: MyopicObjective, candidates: Candidates, n_kept: int) -> Candidates:
    """Return the best `n_kept` candidates of each frame, best first; `crowded` is the objective of all candidates."""
    state = candidates.state
    costs = crowded.frame_costs(state.image, state.z, state.calibration).unflatten(0, (candidates.n_each, -1))
    return Candidates(state.of_frames(_rows(costs.argsort(0)[:n_kept])), n_kept)


def _rows(numbers: Tensor) -> Tensor:
    """Return the indices, among all candidates, of the candidates `numbers` (kept, T) of each frame."""
    n_frames = numbers.shape[1]
    return (numbers * n_frames + torch.arange(n_frames, device=numbers.device)).flatten()
