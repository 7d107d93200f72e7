"""A new start of a mask in a band: the pistons at which the contrast of its fringes is highest.

A piston common to all frames shifts the fringes of its hole, which the phases of the object can take over, so that
frames of one wavelength hardly tell the two apart (`twins`). In a band it also moves the place at which the fringes of
all wavelengths are in step. In optical interferometry the two are the phase delay and the group delay of a baseline.
A descent cannot change one without the other: it stays at pistons that are a part of a wave off, where the object has
wrong phases and some frames are at one fringe and some at the next.

Phases of the holes that are the same at every wavelength (`AberrationBasis.with_offsets`) make the two independent:
with these free in each frame, hardly held by their prior, the pistons go to the group delays that suit the object at
hand, without a barrier in between. A new start begins from those pistons without the phases, and from the blurred
object that suits them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.record import Callback, Record
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import settle
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.state import State

_LARGEST = 0.25  # standard error [waves] at which two of them are half a wave, which mistakes one fringe for the next
_STEP = 0.05  # of the finite differences [waves]
_FITTING = 100  # iterations that find the group delays
_SETTLING = 60  # iterations that fit an object to them, before the aberrations move too


def tells_delays(objective: MyopicObjective, state: State) -> bool:
    """Return whether frames of a band tell the group delays of most holes well enough to start there."""
    return float(delay_errors(objective, state).median()) < _LARGEST


@torch.no_grad()
def delay_errors(objective: MyopicObjective, state: State) -> Tensor:
    """Return the standard errors (T, N) [waves] of each hole's group delay, if everything else is known.

    They are Cramer-Rao bounds: a wave is one of the band's mean wavelength, the phase at that is kept, and the noise is
    as given.
    """
    freed, widen = _freed(objective)
    model, basis = freed.model, objective.model.aberrations
    precision = freed.scaled_data(state.with_noise_inflation(1.0).calibration).precision
    wave = 2 * math.pi * model.band.mean / model.window.grid.wavelength  # [rad] at the wavelength of the grid
    z, first = widen(state.z), basis.n_own

    def made(hole: int, step: float) -> Tensor:
        pistons = torch.zeros(basis.n_subapertures, dtype=torch.float64, device="cpu")
        pistons[hole] = step * wave
        moved = z + widen(basis.parameters_of_pistons(pistons)[None].to(z))
        moved[:, first + hole] -= step
        return torch.cat([model(state.image, moved[part]) for part in model.chunks(len(z))])

    def information(hole: int) -> Tensor:
        slope = (made(hole, _STEP) - made(hole, -_STEP)) / (2 * _STEP)
        return (precision * slope**2).sum((1, 2)).double()

    return torch.stack([information(hole) for hole in range(basis.n_subapertures)], dim=1).rsqrt()


def start_from_delays(
    objective: MyopicObjective, state: State, inflation: float, minimizer: Minimizer, callback: Callback | None = None
) -> tuple[State, int]:
    """Return the state with pistons at the group delays and the blurred object that suits them, and the evaluations.

    `inflation` is the noise inflation with which the new descent begins. The callback is called with a `Record` after
    every iteration.
    """
    freed, widen = _freed(objective)
    basis, spent, step = objective.model.aberrations, 0, 0

    def listen(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal spent, step
        spent, step = spent + evaluations, step + 1
        if callback is not None:
            callback(Record("group delays", step, _FITTING, {"cost": cost}, {}))

    found = descend(freed, replace(state, z=widen(state.z)), _FITTING, minimizer, listen).z
    own, _, common = found.tensor_split([basis.n_own, basis.n_own + basis.n_subapertures], dim=1)
    z = basis.with_common_of(torch.cat([own, common], dim=1), state.z)
    return settle(objective, replace(state, z=z).with_noise_inflation(inflation), _SETTLING), spent


def _freed(objective: MyopicObjective) -> tuple[MyopicObjective, Callable[[Tensor], Tensor]]:
    """Return the objective of aberrations with a phase of each hole beside, and what adds these, zero, to z (T, K)."""
    basis = objective.model.aberrations

    def widen(z: Tensor) -> Tensor:
        own, common = z.tensor_split([basis.n_own], dim=1)
        return torch.cat([own, z.new_zeros(len(z), basis.n_subapertures), common], dim=1)

    model = objective.model.through(objective.model.pupil.aperture, basis.with_offsets())
    centre = widen(objective.centre)
    return objective.with_changes(model=model, centre=centre, free=Free.ABERRATIONS), widen
