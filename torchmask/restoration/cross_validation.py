"""The prior under which frames predict each other best, by cross-validation.

Which weight suits a prior depends on the object, on how well the mask covers its frequencies, and on what of the frames
the model does not know: neither its slopes alone nor the cost tell. But the frames of a stack show the same object.
Under too light a prior an object that is fitted to half of them follows their noise, under too heavy a one it loses
what they show, and either way it predicts the other half less well (two-fold cross-validation: Stone, J. R. Stat. Soc.
B 36, 111, 1974). The aberrations stay those that were found from all frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.restoration.escapes import settle_object
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.state import State


@torch.no_grad()
def choose_prior(
    objective: MyopicObjective, state: State, priors: Sequence[ObjectPrior], n_iterations: int
) -> ObjectPrior:
    """Return the one of `priors`, which are given the heaviest first, under which frames predict each other best.

    What counts is the misfit of each half of the frames to an object that is fitted to the other half, in
    `n_iterations` from the one before; the first has twice as many, from the object of all frames on. Frames take
    turns. All priors are compared, as misfits may rise before they fall: in faint light the objects of the heaviest
    are not at rest yet, and look better than they are. One frame, or one prior, leaves no choice.

    Raises ValueError without any prior.
    """
    if not priors:
        raise ValueError("there are no priors to choose from: `choices` has to return at least one")
    if len(priors) == 1 or len(state.z) == 1:
        return priors[0]
    halves = [_Misfit.of(objective, state, slice(first, None, 2)) for first in (0, 1)]
    # the object of all frames knows the half that it is to predict
    changes = [half.settle(torch.zeros_like(state.image), priors[0], n_iterations) for half in halves]
    misfits = []
    for prior in priors:
        changes = [half.settle(change, prior, n_iterations) for half, change in zip(halves, changes, strict=True)]
        misfits.append(sum(half.rise(change) for half, change in zip(halves, reversed(changes), strict=True)))
    return priors[misfits.index(min(misfits))]


@dataclass(frozen=True)
class _Misfit:
    """Misfit of some frames as a function of how the object (H', W') changes, for given aberrations.

    The gradient is exact. The Hessian is that of frames as large as the field with even noise and no free background,
    for all priors alike.

    image : the object from which changes count
    slope, power : gradient (H', W') and Hessian (H', W'/2 + 1) of `MyopicObjective.object_quadratic`
    price : of the object's light, which is no misfit
    """

    image: Tensor
    slope: Tensor
    power: Tensor
    price: float

    @classmethod
    def of(cls, objective: MyopicObjective, state: State, part: slice) -> _Misfit:
        some, there = objective.of_frames(part), state.of_frames(part)
        slope, power = some.object_quadratic(there.image, there.z, there.calibration)
        return cls(state.image, slope, power, objective.model.background.price)

    def rise(self, change: Tensor) -> float:
        """Return by how much the misfit rises."""
        return float((change * (self.slope + 0.5 * self._curved(change))).sum())

    def settle(self, change: Tensor, prior: ObjectPrior, n_iterations: int) -> Tensor:
        """Return the change that these frames and the prior ask for, from `change` on."""
        slope = self.slope + self._curved(change) + self.price
        return settle_object(self.image + change, slope, self.power, prior, n_iterations)[1] - self.image

    def _curved(self, change: Tensor) -> Tensor:
        return torch.fft.irfft2(torch.fft.rfft2(change) * self.power, s=change.shape)
