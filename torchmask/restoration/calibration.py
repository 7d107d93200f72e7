"""What the frames themselves tell between two descents: transmission, noise inflation, strength of the turbulence."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.state import State

_LEAST_TRANSMISSION = 1e-3


@torch.no_grad()
def fit_of_frames(objective: MyopicObjective, state: State) -> tuple[Tensor, Tensor]:
    """The transmission (T,) at which each frame fits best, and the chi-square per pixel (T,) that is left then."""
    transmissions, squares = [], []
    for part in objective.model.chunks(len(state.z)):
        frames, model = objective.frames[part], objective.model(state.image, state.z[part])
        precision = objective.precision[part] if len(objective.precision) > 1 else objective.precision
        precision = precision.expand_as(frames)
        transmission = (precision * model * frames).sum((1, 2)) / (precision * model**2).sum((1, 2))
        transmissions.append(transmission)
        error = (precision * (frames - transmission[:, None, None] * model) ** 2).sum((1, 2))
        squares.append(error / (precision > 0).sum((1, 2)).clamp(min=1))
    return torch.cat(transmissions).to(state.z).clamp(min=_LEAST_TRANSMISSION), torch.cat(squares).to(state.z)


def recalibrate(objective: MyopicObjective, state: State, power: int | None, *, follow_r0: bool) -> State:
    """Transmission, noise and, if it is open, strength of the turbulence as the state itself tells them.

    `power` is None while objects are still being found. Once all is in its place, frames are weighed by that power of
    how well they fit: 2 through a full pupil, because what is left there comes from another minimum and harms more than
    white noise of that power; 1 for a mask, where it comes from the modes left out.
    """
    state = calibrate(objective, state)
    state = share_noise_inflation(state) if power is None else sharpen_noise_inflation(state, power)
    state = unwrap_pistons(objective, state)
    return follow_turbulence(objective, state) if follow_r0 else state


def calibrate(objective: MyopicObjective, state: State) -> State:
    """The state with the transmissions that fit best, 1 on average, and each frame's noise inflation of its own."""
    transmission, chi_square = fit_of_frames(objective, state)
    return state.calibrated(transmission=transmission / transmission.mean(), noise_inflation=chi_square.clamp(min=1))


def share_noise_inflation(state: State) -> State:
    """Common to all frames: those that fit badly are what draws a wrong object to the right one."""
    inflation = state.calibration.noise_inflation
    return state.calibrated(noise_inflation=inflation.mean().expand_as(inflation).clone())


def sharpen_noise_inflation(state: State, power: int) -> State:
    """Each frame weighed by how well it fits against the best: by the given power of its noise inflation."""
    inflation = state.calibration.noise_inflation
    return state.calibrated(noise_inflation=inflation**power / inflation.min() ** (power - 1))


def follow_turbulence(objective: MyopicObjective, state: State) -> State:
    """The state whose prior on the aberrations is as strong as they have turned out to be."""
    if Free.ABERRATIONS not in objective.free:
        return state
    strength = objective.model.aberrations.turbulence_strength(state.z)
    return state if strength is None else state.calibrated(aberration_weight=1 / strength)


def unwrap_pistons(objective: MyopicObjective, state: State) -> State:
    """The state without needless full waves on the pistons, which the frames of one wavelength cannot tell."""
    known = Free.ABERRATIONS not in objective.free or not state.calibration.aberration_weight
    if known or len(objective.model.band.wavelengths) > 1:
        return state
    return replace(state, z=objective.model.aberrations.unwrapped(state.z, objective.centre))
