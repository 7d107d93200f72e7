"""Frames that have fallen into a local minimum, started anew against the object that the others agree on.

With the object known, the aberrations of a frame are a small problem of their own, so several random starts are cheap.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torchmask.restoration.problem import JointProblem, State

_OUTLYING = 1.25  # times the residual variance of the frames that fit well, the lower quartile
_STARTS = 6
_ROUNDS, _ITERATIONS = 3, 30  # of falling noise, without which most random starts fall into poor minima


def repair(problem: JointProblem, state: State, excess: Tensor, first_excess: float, seed: int) -> tuple[State, int]:
    """Aberrations of outlying frames from the best of several random starts, and the evaluations that it took.

    `excess` (T,) tells which frames fit badly. A frame keeps its aberrations unless others lower its cost;
    it is `state` itself that comes back if all do.
    """
    bad = (excess > _OUTLYING * excess.quantile(0.25)).nonzero().flatten()
    if not len(bad):
        return state, 0
    part = problem.of_frames(bad, free=("aberrations",), static=False)
    generator = torch.Generator().manual_seed(seed)
    n_evaluations = 0

    def count(cost: float, evaluations: int, variables: Any) -> None:
        nonlocal n_evaluations
        n_evaluations += evaluations

    now = replace(state, z=state.z[bad], gains=state.gains[bad], excess=state.excess[bad])
    best, least = now.z, part.frame_costs(now)
    spread = float((state.z - problem.centre).square().mean(1).sqrt().median())  # whatever lost frames have come to
    own = problem.model.n_parameters - problem.model.n_static
    for _ in range(_STARTS):
        noise = torch.randn(now.z.shape, dtype=now.z.dtype, device="cpu", generator=generator).to(now.z)
        fresh = part.centre + spread * noise
        fresh[:, own:] = now.z[:, own:]  # what is common to all frames stays
        trial = replace(now, z=fresh, excess=torch.full_like(now.excess, first_excess))
        for _ in range(_ROUNDS):
            trial = part.descend(trial, _ITERATIONS, count)
            trial = replace(trial, excess=part.calibrate(trial).excess)
        trial = replace(trial, excess=now.excess)
        costs = part.frame_costs(trial)
        best = torch.where((costs < least)[:, None], trial.z, best)
        least = torch.minimum(costs, least)
    spent = n_evaluations * len(bad) // len(state.z)
    if torch.equal(best, now.z):
        return state, spent
    z = state.z.clone()
    z[bad] = best
    return replace(state, z=z), spent
