"""Many first aberrations for every frame of a full pupil, of which the better ones live on.

Phase retrieval over a full pupil has many minima, most of them poor, and even the true object does not lead a random
start into a good one. So all candidates of all frames evolve together with one object, from blurred to sharp, and
half of each frame's candidates are dropped at the end of every stage.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import torch

from torchmask.restoration.problem import JointProblem, State

N_CANDIDATES = 16
ITERATIONS = {16: 30, 8: 70, 4: 100, 2: 100}  # with so many candidates, before half of them are dropped


def crowd(problem: JointProblem, n_candidates: int) -> JointProblem:
    """The problem with every frame so many times, T candidates after T candidates, in single precision.

    The object's prior is as many times as strong, so that it holds the same balance.
    """
    every = torch.arange(len(problem.frames), device=problem.frames.device).repeat(n_candidates)
    model = copy.deepcopy(problem.model).float()
    single = replace(
        problem, model=model, frames=problem.frames.to(model.basis), precision=problem.precision.to(model.basis)
    )
    return single.of_frames(every, tv_weight=n_candidates * problem.tv_weight)


def select(problem: JointProblem, state: State, n_candidates: int, n_kept: int) -> State:
    """The best candidates of each frame, the very best first; `problem` and `state` hold `n_candidates` each."""
    costs = problem.frame_costs(state).unflatten(0, (n_candidates, -1))  # (candidates, T)
    kept = costs.argsort(0)[:n_kept]
    rows = (kept * costs.shape[1] + torch.arange(costs.shape[1], device=kept.device)).flatten()
    return replace(state, z=state.z[rows], gains=state.gains[rows], excess=state.excess[rows])
