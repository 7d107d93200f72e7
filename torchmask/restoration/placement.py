"""How a mask lies, found together with object and aberrations: a turn and an even magnification.

A turn shifts every baseline across itself, and a magnification along itself; no aberration does that. So the frames of
any object tell both, once its restoration has become sharp. They are described by a step (2,): the turn from x to y
[rad] and the shrinkage, minus the logarithm of the magnification, by which the mask still has to move from where the
model has it. Holes stay as they are while a step is looked for, and are turned and magnified with the mask when it is
taken.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.geometry import MaskGeometry
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.placed import PlacedSamples
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_STEP = 1e-4  # for the slope of the frames: a hundredth of a pupil sample or less


class Misplacement(NamedTuple):
    """What the frames tell to first order of how the mask lies, with everything else as it is.

    step : (2,) turn [rad] and shrinkage that lower the misfit most
    gain : by how much
    """

    step: Tensor
    gain: float

    @property
    def size(self) -> float:
        """How far the step moves holes, over their distance from the centre."""
        return math.hypot(*self.step.tolist())


@torch.no_grad()
def slopes_of_frames(model: ExposureModel, image: Tensor, z: Tensor) -> Tensor:
    """Derivatives (2, T, H, W) of the frames in the step at zero, by central differences."""

    def made(step: Tensor) -> Tensor:
        samples = PlacedSamples(model.pupil, step).samples
        return torch.cat([model(image, z[part], samples) for part in model.chunks(len(z))])

    steps = _STEP * torch.eye(2, dtype=torch.float64, device=z.device)
    return torch.stack([(made(step) - made(-step)) / (2 * _STEP) for step in steps])


@torch.no_grad()
def misplacement(objective: MyopicObjective, state: State) -> Misplacement:
    """The Gauss-Newton step of the mask alone: the rest, which could follow, makes it longer."""
    model = objective.model
    frames, precision = objective.scaled_data(state.calibration)
    made = torch.cat([model(state.image, state.z[part]) for part in model.chunks(len(state.z))])
    residual = model.background.residual(frames - made, precision)
    slopes = slopes_of_frames(model, state.image, state.z)
    pull = (precision * slopes * residual).double().sum((1, 2, 3))
    step = torch.linalg.solve(information(slopes, precision), pull)
    return Misplacement(step, 0.5 * float(pull @ step))


def is_misplaced(objective: MyopicObjective, state: State, schedule: Schedule) -> bool:
    """Whether the frames say clearly that the mask lies elsewhere."""
    found = misplacement(objective, state)
    return found.gain > schedule.misplaced_gain and found.size > schedule.misplaced


def information(slopes: Tensor, precision: Tensor) -> Tensor:
    """What frames of this precision tell of the step if everything else is known: the matrix (2, 2) of `slopes`."""
    weighted = (precision.sqrt() * slopes).double().flatten(1)
    return weighted @ weighted.T


def largest_magnification(model: ExposureModel) -> float:
    """By which the mask may still grow before its image is undersampled."""
    period = model.window.grid.period * model.band.shortest / model.window.grid.wavelength
    return max(1.0, 0.5 * period / model.pupil.aperture.extent)


def placed_as(objective: MyopicObjective, told: Aperture, geometry: MaskGeometry) -> MyopicObjective:
    """The objective whose mask, `told`, lies by `geometry`."""
    aperture = told if geometry == MaskGeometry() or not isinstance(told, SparseAperture) else geometry.apply(told)
    if torch.equal(aperture.centers, objective.model.pupil.aperture.centers):
        return objective
    return objective.with_changes(model=objective.model.through(aperture))


def distance(one: MaskGeometry, other: MaskGeometry) -> float:
    """How far holes lie apart in two geometries, over their distance from the centre, at most."""
    return float(torch.linalg.matrix_norm(one.matrix - other.matrix, 2))


def moved(state: State, step: Tensor) -> State:
    """The state whose mask has made the step."""
    turn, shrinkage = step.tolist()
    factor = math.exp(-shrinkage)
    matrix = MaskGeometry(turn, factor, factor).matrix @ state.geometry.matrix
    return replace(state, geometry=MaskGeometry.from_matrix(matrix))
