"""Samples of the aberrations of every frame, and an object that follows them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.calibration import follow_turbulence, unwrap_pistons
from torchmask.restoration.cuda_graphs import graphed
from torchmask.restoration.escapes import settle
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_ACCEPTED = 0.8  # target share of accepted moves: larger ones are rejected too often, smaller ones explore too slowly
_ADAPTED = 1.05  # factor by which their size changes after a round
_KEPT = 0.5  # fraction of the momentum kept after a move


class AberrationSampler:
    """Sampler of the aberrations of every frame for a given object, by Hamiltonian Monte Carlo.

    A move is one leapfrog step, after which part of the momentum is kept (Horowitz, Phys. Lett. B 268, 247, 1991).
    Moves are accepted or rejected for each frame separately, since frames depend on each other only through the object.
    Aberrations common to all frames stay fixed.

    The metric of moves is Laplace's approximation at the state for which the sampler is made: of each frame by itself
    or, if the metric is `shared`, its mean over the frames. That of a frame depends on where its samples begin, which
    shifts those that follow for many moves; the mean hardly does, and takes larger moves.
    """

    def __init__(
        self, objective: MyopicObjective, state: State, generator: torch.Generator, *, shared: bool = False
    ) -> None:
        self.objective: MyopicObjective = objective
        self.generator: torch.Generator = generator
        precision = laplace_precision(objective, state)
        self.factor: Tensor = torch.linalg.cholesky(precision.mean(0) if shared else precision)
        self.momentum: Tensor = self._normal(state.z)
        self._energy = graphed(partial(_energy, objective), state.z.device)

    def sample(self, state: State, n_moves: int, size: float) -> tuple[Tensor, float]:
        """Return the aberrations (T, K) after `n_moves` of `size` standard deviations, and the share accepted."""
        z, momentum = state.z, self.momentum
        weight = torch.zeros_like(z[0]) + self.objective.aberration_weight(state.calibration, z)
        given = (state.image, *self.objective.scaled_data(state.calibration), weight)
        energy, slope = self._energy(z, *given)
        accepted = 0.0
        for _ in range(n_moves):
            momentum = _KEPT * momentum + (1 - _KEPT**2) ** 0.5 * self._normal(z)
            push = momentum - size / 2 * self._whiten(slope)
            there = z + self._unwhiten(size * push)
            energy_there, slope_there = self._energy(there, *given)
            push = push - size / 2 * self._whiten(slope_there)
            rise = energy_there - energy + 0.5 * (push.square() - momentum.square()).sum(1)
            goes = torch.rand(len(z), dtype=z.dtype, device="cpu", generator=self.generator).to(z) < (-rise).exp()
            momentum = torch.where(goes[:, None], push, -momentum)
            z, slope = (torch.where(goes[:, None], new, old) for new, old in ((there, z), (slope_there, slope)))
            energy = torch.where(goes, energy_there, energy)
            accepted += float(goes.to(z).mean()) / n_moves
        self.momentum = momentum
        return z, accepted

    def _normal(self, z: Tensor) -> Tensor:
        shape = (len(z), self.objective.model.aberrations.n_own)
        return torch.randn(shape, dtype=z.dtype, device="cpu", generator=self.generator).to(z)

    def _whiten(self, slope: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self.factor, slope[..., None], upper=False)[..., 0]

    def _unwhiten(self, change: Tensor) -> Tensor:
        own = torch.linalg.solve_triangular(self.factor.mT, change[..., None], upper=True)[..., 0]
        return pad(own, (0, self.objective.model.aberrations.n_common))


def _energy(
    objective: MyopicObjective,
    z: Tensor,
    image: Tensor,
    frames: Tensor,
    precision: Tensor,
    unit: Tensor,
    weight: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return misfit plus prior of each frame (T,), and the gradient in its own parameters (T, n_own).

    After the image come `ScaledData` and the weights (K,) of the aberrations' prior.
    """
    misfit = data_fidelity(
        *(objective.model, image, z, frames, precision), want_object=False, unit=unit, parallel=objective.parallel
    )
    assert misfit.aberration_gradient is not None
    held = weight * (z - objective.centre)
    energy = misfit.value.to(z) + 0.5 * (held * (z - objective.centre)).sum(1)
    return energy, (misfit.aberration_gradient + held)[:, : objective.model.aberrations.n_own]


@torch.no_grad()
def laplace_precision(objective: MyopicObjective, state: State) -> Tensor:
    """Return the Gauss-Newton Hessian (T, K, K) of the cost in each frame's own K aberrations, for a fixed object."""
    model, z = objective.model, state.z
    n_own = model.aberrations.n_own
    precision = objective.scaled_data(state.calibration)[1]
    weight = torch.zeros_like(z[0]) + objective.aberration_weight(state.calibration, z)

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def of_frame(t: int) -> Tensor:
        changes = Linearization(model, state.image, z[t : t + 1]).by_modes(n_own)[:, 0]
        # in the dtype of z, or rounding could outweigh the prior of modes that are hardly seen
        changes = (changes * precision[t if len(precision) > 1 else 0].sqrt()).flatten(1).to(z)
        return changes @ changes.T + weight[:n_own].diag()

    return torch.stack(list(objective.parallel(of_frame, range(len(z)))))


@torch.no_grad()
def sample_rounds(
    objective: MyopicObjective,
    state: State,
    heats: Iterable[float],
    schedule: Schedule,
    generator: torch.Generator,
    *,
    follow_r0: bool,
    alone: bool = False,
) -> Iterator[tuple[State, float]]:
    """Yield the state after each round, and the share of moves that it accepted.

    In a round the aberrations are moved for the object at hand, and the object is fitted to them. The variance of the
    noise is that of `state` times one of the `heats`, which leaves both more freedom; if the samples are heated
    `alone`, the object is fitted in the noise of `state`, and the frames share a metric. With `follow_r0` the weight of
    the aberrations' prior is estimated from the samples.
    """
    noise, size = state.calibration.noise_inflation, schedule.move_size
    for number, heat in enumerate(heats):
        hot = replace(state, calibration=replace(state.calibration, noise_inflation=heat * noise))
        if number % schedule.renewal == 0:
            sampler = AberrationSampler(objective, hot, generator, shared=alone)
        z, accepted = sampler.sample(hot, schedule.moves, size)
        size = size * _ADAPTED if accepted > _ACCEPTED else size / _ADAPTED
        state = settle(objective, replace(state if alone else hot, z=z), schedule.settling)
        state = unwrap_pistons(objective, state)
        state = follow_turbulence(objective, state) if follow_r0 else state
        yield state, accepted
