"""What the frames themselves tell between two descents: transmission, noise inflation, strength of the turbulence."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.background import Background, weighted_mean
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.state import State

_LEAST_TRANSMISSION = 1e-3


@torch.no_grad()
def fit_of_frames(objective: MyopicObjective, state: State) -> tuple[Tensor, Tensor]:
    """The transmission (T,) at which each frame fits best, and the chi-square per pixel (T,) that is left then.

    A background that is free is fitted with it.
    """
    transmissions, squares, background = [], [], objective.model.background
    for part in objective.model.chunks(len(state.z)):
        precision = objective.precision[part] if len(objective.precision) > 1 else objective.precision
        frames = objective.frames[part]
        model = objective.model(state.image, state.z[part])
        transmission = _fit_transmission(background, model, frames, precision)
        transmissions.append(transmission.flatten())
        precision = precision.expand_as(frames)
        error = (precision * background.residual(frames - transmission * model, precision) ** 2).sum((1, 2))
        squares.append(error / (precision > 0).sum((1, 2)).clamp(min=1))
    return torch.cat(transmissions).to(state.z).clamp(min=_LEAST_TRANSMISSION), torch.cat(squares).to(state.z)


def _fit_transmission(background: Background, model: Tensor, frames: Tensor, precision: Tensor) -> Tensor:
    """Least squares (T, 1, 1) of `frames` against `model`, with a constant besides where that is free and positive."""

    def slope(x: Tensor, y: Tensor) -> Tensor:
        return (precision * x * y).sum((1, 2), keepdim=True) / (precision * x**2).sum((1, 2), keepdim=True)

    alone = slope(model, frames)
    if background is Background.NONE:
        return alone
    mean_model, mean_frame = weighted_mean(model, precision), weighted_mean(frames, precision)
    beside = slope(model - mean_model, frames - mean_frame)
    return torch.where(mean_frame > beside * mean_model, beside, alone)


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
    """The state with the transmissions that fit best, 1 on average, and each frame's noise inflation of its own.

    What all transmissions have in common is the object's brightness.
    """
    transmission, chi_square = fit_of_frames(objective, state)
    common = transmission.mean()
    if objective.model.background is not Background.NONE:  # beside which the frames' mean does not tell it
        state = replace(state, image=state.image * common)
    return state.calibrated(transmission=transmission / common, noise_inflation=chi_square.clamp(min=1))


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
