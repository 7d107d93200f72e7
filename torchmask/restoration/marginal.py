"""Marginal estimation of the object: the aberrations, which faint frames leave uncertain, are integrated out.

A joint estimate of the object and the aberrations of all frames is biased: every frame brings as many new unknowns,
which are fitted to its noise (Neyman & Scott, Econometrica 16, 1, 1948; for blind deconvolution Levin et al., IEEE
Trans. Pattern Anal. 33, 2354, 2011). The aberrations are therefore integrated out by stochastic expectation
maximisation (Celeux & Diebolt, Comput. Stat. Q. 2, 73, 1985): the object is fitted to a sample of the aberrations,
which are then moved on for the new object, and the result is its mean over the later rounds.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchmask.record import Callback, Record
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.sampler import sample_rounds
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_HEAT = 3.0  # factor of the noise in which samples begin if a descent has gone astray
_HEATED = 0.4  # share of the rounds in which it falls to 1


@torch.no_grad()
def integrate_aberrations(
    objective: MyopicObjective,
    state: State,
    rounds: int,
    schedule: Schedule,
    minimizer: Minimizer,
    callback: Callback | None = None,
    *,
    seed: int,
    follow_r0: bool,
    astray: bool = False,
) -> tuple[State, int]:
    """Return the marginal estimate of the object with its best-fitting aberrations, and the number of evaluations.

    `state` is the end of a descent, with a positive weight of the aberrations' prior; with `follow_r0` this weight is
    estimated from the samples. If the descent has gone `astray` after noise, samples first wander in three times the
    noise, which falls until 0.4 of the rounds. The callback is called with a `Record` after every round.
    """
    generator, spent = torch.Generator().manual_seed(seed), 0
    total, first = torch.zeros_like(state.image), rounds // 2
    heats = (_HEAT ** max(0.0, 1 - number / (_HEATED * rounds)) if astray else 1.0 for number in range(rounds))
    sampled = sample_rounds(objective, state, heats, schedule, generator, follow_r0=follow_r0, alone=astray)
    for number, (state, accepted) in enumerate(sampled):
        if number >= first:
            total += state.image / (rounds - first)
        spent += schedule.moves + 2
        if callback is not None:
            callback(Record("integration", number + 1, rounds, {"accepted": accepted}, {}))

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent
        spent += evaluations

    known_object = objective.with_changes(free=objective.free & ~Free.OBJECT)
    return descend(known_object, replace(state, image=total), schedule.segment, minimizer, count), spent
