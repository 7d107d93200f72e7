"""Rotation and magnification of a mask, estimated together with object and aberrations.

A rotation changes every baseline perpendicular to itself, and a magnification along itself; no aberration does that.
The frames of any object therefore show both, once its restoration is sharp. They are described by a step (2,) from the
geometry in the model: the rotation from x to y [rad], and the shrinkage, minus the logarithm of the magnification. The
shape of the holes is kept while a step is sought, and is rotated and magnified with the mask when the step is taken.
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
from torchmask.restoration.placed import PlacedSamples, centers_of
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State

_STEP = 1e-4  # of the finite differences: a hundredth of a pupil sample or less


class Misplacement(NamedTuple):
    """First-order estimate of the error of the mask's geometry, with everything else fixed.

    step : (2,) rotation [rad] and shrinkage that minimise the misfit
    gain : decrease of the misfit
    """

    step: Tensor
    gain: float

    @property
    def size(self) -> float:
        """Displacement of the holes by the step, over their distance from the centre."""
        return math.hypot(*self.step.tolist())


@torch.no_grad()
def slopes_of_frames(model: ExposureModel, image: Tensor, z: Tensor) -> Tensor:
    """Return the derivatives (2, T, H, W) of the frames with respect to the step, at zero, by central differences."""

    centers = centers_of(model.pupil)

    def made(step: Tensor) -> Tensor:
        samples = PlacedSamples(model.pupil, centers, step).samples
        return torch.cat([model(image, z[part], samples) for part in model.chunks(len(z))])

    steps = _STEP * torch.eye(2, dtype=torch.float64, device=z.device)
    return torch.stack([(made(step) - made(-step)) / (2 * _STEP) for step in steps])


@torch.no_grad()
def misplacement(objective: MyopicObjective, state: State) -> Misplacement:
    """Return the Gauss-Newton step of the mask alone; jointly with object and aberrations it would be larger."""
    model = objective.model
    frames, precision, unit = objective.scaled_data(state.calibration)
    made = torch.cat([model(state.image, state.z[part]) for part in model.chunks(len(state.z))])
    residual = model.background.residual(frames - made, precision, unit)
    slopes = slopes_of_frames(model, state.image, state.z)
    pull = (precision * slopes * residual).double().sum((1, 2, 3))
    step = torch.linalg.solve(information(slopes, precision), pull)
    return Misplacement(step, 0.5 * float(pull @ step))


def is_misplaced(objective: MyopicObjective, state: State, schedule: Schedule) -> bool:
    """Return whether the frames clearly show that the mask's geometry is wrong."""
    found = misplacement(objective, state)
    return found.gain > schedule.misplaced_gain and found.size > schedule.misplaced


def information(slopes: Tensor, precision: Tensor) -> Tensor:
    """Return the Fisher information (2, 2) of the step from the frames' `slopes`, if everything else is known."""
    weighted = (precision.sqrt() * slopes).double().flatten(1)
    return weighted @ weighted.T


def largest_magnification(model: ExposureModel) -> float:
    """Return the magnification of the mask at which its image becomes undersampled, at least 1."""
    period = model.window.grid.period * model.band.shortest / model.window.grid.wavelength
    return max(1.0, 0.5 * period / model.pupil.aperture.extent)


def smallest_magnification(model: ExposureModel) -> float:
    """Return the magnification of the mask at which a hole spans two samples, at most 1."""
    widest = max(model.band.wavelengths) / (model.pupil.grid.pixel_scale * min(model.pupil.grid.shape))  # step [m]
    return min(1.0, 2 * widest / model.pupil.aperture.subaperture_diameter)


def placed_as(objective: MyopicObjective, told: Aperture, geometry: MaskGeometry) -> MyopicObjective:
    """Return the objective with the mask `told` transformed by `geometry`."""
    aperture = told if geometry == MaskGeometry() or not isinstance(told, SparseAperture) else geometry.apply(told)
    if torch.equal(aperture.centers, objective.model.pupil.aperture.centers):
        return objective
    return objective.with_changes(model=objective.model.through(aperture))


def distance(one: MaskGeometry, other: MaskGeometry) -> float:
    """Return the largest displacement of a hole between two geometries, over its distance from the centre."""
    return float(torch.linalg.matrix_norm(one.matrix - other.matrix, 2))


def moved(state: State, step: Tensor) -> State:
    """Return the state with the mask moved by the step."""
    turn, shrinkage = step.tolist()
    factor = math.exp(-shrinkage)
    matrix = MaskGeometry(turn, factor, factor).matrix @ state.geometry.matrix
    return replace(state, geometry=MaskGeometry.from_matrix(matrix))
