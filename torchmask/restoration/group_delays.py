"""A new start of a mask in a band: the pistons at which the contrast of its fringes is highest.

A piston common to all frames shifts the fringes of its hole, which the phases of the object can take over, so that
frames of one wavelength hardly tell the two apart (`twins`). In a band it also moves the place at which the fringes of
all wavelengths are in step. In optical interferometry the two are the phase delay and the group delay of a baseline.
A descent cannot change one without the other: it stays at pistons that are a part of a wave off, where the object has
wrong phases and some frames are at one fringe and some at the next.

Phases of the holes that are the same at every wavelength (`AberrationBasis.with_offsets`) make the two independent:
with these free in each frame the pistons go to the group delays, for the object at hand, without a barrier in between.
A new start begins from those pistons without the phases, and from the blurred object that suits them.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import settle
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.state import State

_FITTING = 100  # iterations that find the group delays
_SETTLING = 60  # iterations that fit an object to them, before the aberrations move too


def start_from_delays(
    objective: MyopicObjective, state: State, inflation: float, minimizer: Minimizer
) -> tuple[State, int]:
    """Return the state with pistons at the group delays and the blurred object that suits them, and the evaluations.

    `inflation` is the noise inflation with which the new descent begins.
    """
    basis = objective.model.aberrations
    wider = basis.with_offsets()
    kept = torch.ones(wider.n_parameters, dtype=torch.bool, device=state.z.device)
    kept[basis.n_own : wider.n_own] = False
    spent = 0

    def widened(values: Tensor) -> Tensor:
        wide = values.new_zeros(len(values), len(kept))
        wide[:, kept] = values
        return wide

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent
        spent += evaluations

    model, centre = objective.model.through(objective.model.pupil.aperture, wider), widened(objective.centre)
    freed = objective.with_changes(model=model, centre=centre, free=Free.ABERRATIONS)
    found = descend(freed, replace(state, z=widened(state.z)), _FITTING, minimizer, count)
    delayed = replace(state, z=found.z[:, kept]).with_noise_inflation(inflation)
    return settle(objective, delayed, _SETTLING), spent
