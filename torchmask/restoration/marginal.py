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
from torch import Tensor
from torch.nn.functional import pad

from torchmask.record import Callback, Record
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.calibration import follow_turbulence, unwrap_pistons
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.escapes import settle
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_ACCEPTED = 0.8  # target share of accepted moves: larger ones are rejected too often, smaller ones explore too slowly
_ADAPTED = 1.05  # factor by which their size changes after a round
_KEPT = 0.5  # fraction of the momentum kept after a move


class AberrationSampler:
    """Sampler of the aberrations of every frame for a given object, by Hamiltonian Monte Carlo.

    A move is one leapfrog step, after which part of the momentum is kept (Horowitz, Phys. Lett. B 268, 247, 1991).
    Moves are accepted or rejected for each frame separately, since frames depend on each other only through the object.
    Their metric is Laplace's approximation at the state for which the sampler is made. Aberrations common to all frames
    stay fixed.
    """

    def __init__(self, objective: MyopicObjective, state: State, generator: torch.Generator) -> None:
        self.objective: MyopicObjective = objective
        self.generator: torch.Generator = generator
        self.factor: Tensor = torch.linalg.cholesky(laplace_precision(objective, state))
        self.momentum: Tensor = self._normal(state.z)

    def sample(self, state: State, n_moves: int, size: float) -> tuple[Tensor, float]:
        """Return the aberrations (T, K) after `n_moves` of `size` standard deviations, and the share accepted."""
        z, momentum = state.z, self.momentum
        energy, slope = self._energy(state, z)
        accepted = 0.0
        for _ in range(n_moves):
            momentum = _KEPT * momentum + (1 - _KEPT**2) ** 0.5 * self._normal(z)
            push = momentum - size / 2 * self._whiten(slope)
            there = z + self._unwhiten(size * push)
            energy_there, slope_there = self._energy(state, there)
            push = push - size / 2 * self._whiten(slope_there)
            rise = energy_there - energy + 0.5 * (push.square() - momentum.square()).sum(1)
            goes = torch.rand(len(z), dtype=z.dtype, device="cpu", generator=self.generator).to(z) < (-rise).exp()
            momentum = torch.where(goes[:, None], push, -momentum)
            z, slope = (torch.where(goes[:, None], new, old) for new, old in ((there, z), (slope_there, slope)))
            energy = torch.where(goes, energy_there, energy)
            accepted += float(goes.to(z).mean()) / n_moves
        self.momentum = momentum
        return z, accepted

    def _energy(self, state: State, z: Tensor) -> tuple[Tensor, Tensor]:
        """Return misfit plus prior of each frame (T,), and the gradient in its own parameters (T, n_own)."""
        objective = self.objective
        frames, precision, unit = objective.scaled_data(state.calibration)
        misfit = data_fidelity(
            *(objective.model, state.image, z, frames, precision),
            want_object=False,
            unit=unit,
            parallel=objective.parallel,
        )
        assert misfit.aberration_gradient is not None
        held = objective.aberration_weight(state.calibration, z) * (z - objective.centre)
        energy = misfit.value.to(z) + 0.5 * (held * (z - objective.centre)).sum(1)
        return energy, (misfit.aberration_gradient + held)[:, : objective.model.aberrations.n_own]

    def _normal(self, z: Tensor) -> Tensor:
        shape = (len(z), self.objective.model.aberrations.n_own)
        return torch.randn(shape, dtype=z.dtype, device="cpu", generator=self.generator).to(z)

    def _whiten(self, slope: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self.factor, slope[..., None], upper=False)[..., 0]

    def _unwhiten(self, change: Tensor) -> Tensor:
        own = torch.linalg.solve_triangular(self.factor.mT, change[..., None], upper=True)[..., 0]
        return pad(own, (0, self.objective.model.aberrations.n_common))


@torch.no_grad()
def laplace_precision(objective: MyopicObjective, state: State) -> Tensor:
    """Return the Gauss-Newton Hessian (T, K, K) of the cost in each frame's own K aberrations, for a fixed object."""
    model, z = objective.model, state.z
    n_own = model.aberrations.n_own
    precision = objective.scaled_data(state.calibration)[1]
    weight = torch.zeros_like(z[0]) + objective.aberration_weight(state.calibration, z)
    still = state.image.expand(n_own, *state.image.shape) * 0
    each = torch.eye(n_own, z.shape[1], dtype=z.dtype, device=z.device)[:, None]

    @torch.no_grad()  # needed here too, as no_grad applies to one thread only
    def of_frame(t: int) -> Tensor:
        changes = Linearization(model, state.image, z[t : t + 1]).forward(still, each)[:, 0]
        changes = (changes * precision[t if len(precision) > 1 else 0].sqrt()).flatten(1).to(z)
        return changes @ changes.T + weight[:n_own].diag()

    return torch.stack(list(objective.parallel(of_frame, range(len(z)))))


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
) -> tuple[State, int]:
    """Return the marginal estimate of the object with its best-fitting aberrations, and the number of evaluations.

    `state` is the end of a descent, with a positive weight of the aberrations' prior; with `follow_r0` this weight is
    estimated from the samples. The callback is called with a `Record` after every round.
    """
    generator = torch.Generator().manual_seed(seed)
    sampler, size, spent = AberrationSampler(objective, state, generator), schedule.move_size, 0
    total, first = torch.zeros_like(state.image), rounds // 2
    for number in range(rounds):
        if number and number % schedule.renewal == 0:
            sampler = AberrationSampler(objective, state, generator)
        z, accepted = sampler.sample(state, schedule.moves, size)
        size = size * _ADAPTED if accepted > _ACCEPTED else size / _ADAPTED
        state = settle(objective, replace(state, z=z), schedule.settling)
        state = unwrap_pistons(objective, state)
        state = follow_turbulence(objective, state) if follow_r0 else state
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
