"""Recalibration between two descents: transmissions, noise inflation and strength of the turbulence."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.background import Background, weighted_mean
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.state import LEAST_TRANSMISSION, State


@torch.no_grad()
def fit_of_frames(objective: MyopicObjective, state: State) -> tuple[Tensor, Tensor]:
    """Return the best-fitting transmission of each frame (T,), and the chi-square per pixel (T,) of the residual.

    A free background is fitted at the same time.
    """
    transmissions, squares, background = [], [], objective.model.background
    common = 0.0
    if background is Background.COMMON:
        common, background = _common_level(objective, state), Background.NONE
    for frames, precision, model in _compared(objective, state):
        frames = frames - common
        transmission = _fit_transmission(background, model, frames, precision)
        transmissions.append(transmission.flatten())
        precision = precision.expand_as(frames)
        error = (precision * background.residual(frames - transmission * model, precision) ** 2).sum((1, 2))
        squares.append(error / (precision > 0).sum((1, 2)).clamp(min=1))
    return torch.cat(transmissions).to(state.z).clamp(min=LEAST_TRANSMISSION), torch.cat(squares).to(state.z)


def _compared(objective: MyopicObjective, state: State) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Return frames (t, H, W), their precision and the model at unit transmission, for a few frames at a time."""
    for part in objective.model.chunks(len(state.z)):
        frames = objective.frames[part]
        precision = objective.precision[part] if len(objective.precision) > 1 else objective.precision
        yield frames, precision, objective.model(state.image, state.z[part])


def _common_level(objective: MyopicObjective, state: State) -> float:
    """Return the constant, at least 0, that fits all frames best together with a transmission of each frame."""
    pull = weight = 0.0
    for frames, precision, model in _compared(objective, state):
        slope = _slope(precision, model, torch.ones_like(model))
        apart = precision * (1 - slope * model)  # of a constant, what no transmission can imitate
        pull += float((apart * frames).sum())
        weight += float(apart.sum())
    return max(0.0, pull / weight)


def _fit_transmission(background: Background, model: Tensor, frames: Tensor, precision: Tensor) -> Tensor:
    """Return the least-squares factor (T, 1, 1) of `model` to `frames`, with a constant if that is free and > 0."""
    alone = _slope(precision, model, frames)
    if background is Background.NONE:
        return alone
    mean_model, mean_frame = weighted_mean(model, precision), weighted_mean(frames, precision)
    beside = _slope(precision, model - mean_model, frames - mean_frame)
    return torch.where(mean_frame > beside * mean_model, beside, alone)


def _slope(precision: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the least-squares factor (t, 1, 1) of `x` to `y`; 0 where `x` is 0, as for an object without light."""
    square = (precision * x**2).sum((1, 2), keepdim=True)
    return (precision * x * y).sum((1, 2), keepdim=True) / square.clamp(min=torch.finfo(square.dtype).tiny)


def recalibrate(objective: MyopicObjective, state: State, power: int | None, *, follow_r0: bool) -> State:
    """Update transmissions and noise and, with `follow_r0`, the strength of the turbulence from the state.

    `power` is None before the object has been found. Afterwards, frames are weighted by that power of their residual
    variance (`Traits.fit_power`).
    """
    state = calibrate(objective, state)
    state = share_noise_inflation(state) if power is None else sharpen_noise_inflation(state, power)
    state = unwrap_pistons(objective, state)
    return follow_turbulence(objective, state) if follow_r0 else state


def calibrate(objective: MyopicObjective, state: State) -> State:
    """Return the state with the best-fitting transmissions, of mean 1, and the noise inflation of each frame.

    A factor common to all transmissions belongs to the object's brightness.
    """
    transmission, chi_square = fit_of_frames(objective, state)
    common = transmission.mean()
    if objective.model.background is not Background.NONE:  # else the mean of the frames fixes the brightness already
        state = replace(state, image=state.image * common)
    return state.calibrated(transmission=transmission / common, noise_inflation=chi_square.clamp(min=1))


def share_noise_inflation(state: State) -> State:
    """Return the state with the mean noise inflation in all frames, as badly fitted ones pull a wrong object right."""
    inflation = state.calibration.noise_inflation
    return state.calibrated(noise_inflation=inflation.mean().expand_as(inflation).clone())


def sharpen_noise_inflation(state: State, power: int) -> State:
    """Return the state with noise inflation raised to `power` relative to that of the frames that fit best.

    With powers above 1 these are the best quarter, which count alike: a single frame would soon rule the object.
    """
    inflation = state.calibration.noise_inflation
    best = inflation.quantile(0.25, interpolation="lower") if power > 1 else inflation.min()
    return state.calibrated(noise_inflation=inflation.clamp(min=best) ** power / best ** (power - 1))


def follow_turbulence(objective: MyopicObjective, state: State) -> State:
    """Return the state with the prior on the aberrations adapted to their estimated variance."""
    if Free.ABERRATIONS not in objective.free:
        return state
    strength = objective.model.aberrations.turbulence_strength(state.z)
    return state if strength is None else state.calibrated(aberration_weight=1 / strength)


def unwrap_pistons(objective: MyopicObjective, state: State) -> State:
    """Return the state without full waves of piston, which the frames of one wavelength cannot show."""
    known = Free.ABERRATIONS not in objective.free or not state.calibration.aberration_weight
    model = objective.model
    if known or len(model.band.wavelengths) > 1:
        return state
    wave = 2 * math.pi * model.band.mean / model.window.grid.wavelength
    return replace(state, z=model.aberrations.unwrapped(state.z, objective.centre, wave))
