"""Aberrations that change during an exposure, which lowers the contrast of the fringes.

Each frame has, beside the aberrations at its middle, parameters for their change from its beginning to its end. They
are white under the covariance that the change has if frozen turbulence moves with the wind, and the image is the mean
over two instants (`AberrationBasis.in_motion`). Zero change is a stationary point of the cost, because a frame does not
tell the direction of time, so the search starts from small random changes. It starts only when the object is sharp:
before, a change that takes the fringes of a hole through whole waves explains the frames of a blurred object as well.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from torchmask.optics.aperture import Aperture
from torchmask.restoration.aberrations import AberrationBasis, MakesBasis
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placement import placed_as
from torchmask.restoration.state import Modes, State

_FIRST = 0.1  # rms of the first changes, relative to their prior


@dataclass(frozen=True)
class Setting:
    """What an objective is made for and a state may change: how the mask lies, and which aberrations there are.

    told : the mask as the user describes it
    still : basis of the aberrations of snapshots
    moving : the same basis with changes during the exposure; None: frames are snapshots
    finer : makes the basis with more modes, and with the same changes, for after the search; None: there are no more
    """

    told: Aperture
    still: AberrationBasis
    moving: AberrationBasis | None = None
    finer: MakesBasis | None = None

    @classmethod
    def of(
        cls, objective: MyopicObjective, moving: AberrationBasis | None = None, finer: MakesBasis | None = None
    ) -> Setting:
        """Return the setting of an objective of snapshots; known aberrations do not move and have no more modes."""
        model, is_free = objective.model, Free.ABERRATIONS in objective.free
        return cls(model.pupil.aperture, model.aberrations, moving if is_free else None, finer if is_free else None)

    def awaits_motion(self, state: State) -> bool:
        """Return whether aberrations change during the exposure, and the state does not have the change yet."""
        return self.moving is not None and state.modes is Modes.STILL

    def in_motion(self, state: State, seed: int, change: Tensor | None = None) -> State:
        """Return the state with changes of the aberrations, if it awaits them.

        They are small and random, or for the first T' frames the given `change` (T', N, J) [rad rms].
        """
        if self.moving is None or not self.awaits_motion(state):
            return state
        size = (len(state.z), self._n_changes)
        generator = torch.Generator().manual_seed(seed)
        first = _FIRST * torch.randn(size, dtype=state.z.dtype, device="cpu", generator=generator).to(state.z)
        if change is not None:
            known = self.moving.parameters_of_change(change.to(first))
            first[: len(change)] = known[:, self.still.n_own : self.moving.n_own]
        return replace(state, z=self._widened(state.z, first), modes=Modes.MOVING)

    def in_finer_modes(self, state: State) -> State:
        """Return the state in the basis `finer`, with the same aberrations; the state itself if there is none."""
        return state if self.awaits_motion(state) or not self._has_finer else self._in_modes(state, Modes.FINER)

    def in_all_modes(self, state: State) -> State:
        """Return the state in the basis `finer`; the state itself if there is none. A change that it awaits is zero."""
        if not self._has_finer:
            return state
        if self.awaits_motion(state):
            still = state.z.new_zeros(len(state.z), self._n_changes)
            state = replace(state, z=self._widened(state.z, still), modes=Modes.MOVING)
        return self._in_modes(state, Modes.FINER)

    def in_first_modes(self, state: State) -> State:
        """Return the state with the part of its aberrations that the modes of the search can represent."""
        if state.modes is not Modes.FINER:
            return state
        return self._in_modes(state, Modes.STILL if self.moving is None else Modes.MOVING)

    def objective_at(self, objective: MyopicObjective, state: State) -> MyopicObjective:
        """Return the objective with its mask and its aberrations as `state` has them."""
        objective, basis = placed_as(objective, self.told, state.geometry), self._basis(state.modes)
        model, centre = objective.model, objective.centre
        if model.aberrations is basis:
            return objective
        if state.modes is Modes.FINER:
            centre = torch.zeros_like(state.z)
        else:
            own, common = centre[:, : self.still.n_own], centre[:, centre.shape[1] - self.still.n_common :]
            centre = torch.cat([own, common], dim=1)
            if state.modes is Modes.MOVING:
                centre = self._widened(centre, centre.new_zeros(len(centre), self._n_changes))
        model = model.through(model.pupil.aperture, basis.to(model.device))
        return objective.with_changes(model=model, centre=centre)

    @property
    def _has_finer(self) -> bool:
        return self.finer is not None and self.finer() is not None

    @property
    def _n_changes(self) -> int:
        """Number of parameters of a frame for the change of its aberrations."""
        return 0 if self.moving is None else self.moving.n_parameters - self.still.n_parameters

    def _basis(self, modes: Modes) -> AberrationBasis:
        if modes is Modes.STILL:
            return self.still
        basis = self.moving if modes is Modes.MOVING else self.finer and self.finer()
        assert basis is not None, f"the state has aberrations that this setting lacks: {modes.value}"
        return basis

    def _in_modes(self, state: State, modes: Modes) -> State:
        """Return the state in other modes, with the change of its aberrations; modes that it lacks begin at zero."""
        here, there, n_changes = self._basis(state.modes), self._basis(modes), self._n_changes
        own, change, common = state.z.tensor_split([here.n_own - n_changes, here.n_own], dim=1)
        now = (own @ here.mixing[:, : own.shape[1]].to(own).T).unflatten(1, (here.n_subapertures, here.n_modes))
        now = pad(now, (0, there.n_modes - here.n_modes)).flatten(1)  # a negative width cuts modes off
        mixing = there.mixing[:, : there.n_own - n_changes].to(own)
        z = torch.cat([now @ torch.linalg.pinv(mixing).T, change, common], dim=1)
        return replace(state, z=z, modes=modes)

    def _widened(self, z: Tensor, change: Tensor) -> Tensor:
        """Insert the parameters (T, M) of a change into z (T, K) of snapshots."""
        own, common = z.tensor_split([self.still.n_own], dim=1)
        return torch.cat([own, change, common], dim=1)
