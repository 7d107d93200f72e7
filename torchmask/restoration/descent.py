"""One descent in object and aberrations, which a bounded minimiser sees as one scaled vector."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.adjoint import curvature
from torchmask.restoration.cuda_graphs import graphed
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placement import (
    information,
    largest_magnification,
    moved,
    slopes_of_frames,
    smallest_magnification,
)
from torchmask.restoration.projected_lbfgs import AfterIteration, Cost, Minimizer, Minimum
from torchmask.restoration.state import State

_OBJECT_STEP = 0.3  # factor on the object's scale relative to that of the aberrations: 3 times more or less is worse
_LEAST_CURVATURE = 1e-6  # of the largest, for a finite scale of directions that neither data nor prior constrain
_PROBE_SEED = 0

Variables = Callable[[], tuple[Tensor, Tensor]]
Listener = Callable[[float, int, Variables], None]
"""Called with (cost, evaluations since the last call, function that returns (image, z)) after every iteration."""


def descend(
    objective: MyopicObjective, state: State, n_iterations: int, minimizer: Minimizer, listener: Listener
) -> State:
    """Minimise the objective from `state` for at most `n_iterations`, with fixed calibration and an object >= 0.

    If the mask's geometry is free, the returned state has a new one, for which the objective must be updated
    (`placement.placed_as`).
    """
    moves = Free.PLACE in objective.free
    image_scale, z_scale = scales(objective, state)
    step_scale = place_scale(objective, state) if moves else state.z.new_zeros(0)
    evaluate = objective.evaluator(state.calibration)
    # What is known is no part of the vector: the minimiser's own work grows with its length.
    n = state.image.numel() if Free.OBJECT in objective.free else 0
    place = n + (state.z.numel() if objective.free & (Free.ABERRATIONS | Free.COMMON) else 0)
    seen = 0

    def split(x: Tensor) -> tuple[Tensor, Tensor]:
        image = x[:n].view_as(state.image) * image_scale if n else state.image
        return image, x[n:place].view_as(state.z) * z_scale if place > n else state.z

    def of_vector(x: Tensor) -> tuple[Tensor, Tensor]:
        value, by_image, by_z, by_step = evaluate(*split(x), x[place:] * step_scale if moves else None)
        slope = step_scale if by_step is None else by_step * step_scale
        return value, joined(by_image * image_scale, by_z * z_scale, slope)

    there = graphed(of_vector, state.image.device)

    def cost(x: Tensor) -> tuple[float, Tensor]:
        value, gradient = there(x)
        return float(value), gradient

    def joined(image: Tensor, z: Tensor, step: Tensor) -> Tensor:
        return torch.cat([image.flatten()[:n], z.flatten()[: place - n], step])

    def after(x: Tensor, value: float, evaluations: int) -> None:
        nonlocal seen
        seen, new = evaluations, evaluations - seen
        listener(value, new, lambda: split(x))

    start = joined(state.image / image_scale, state.z / z_scale, torch.zeros_like(step_scale))
    if not len(start):
        return state
    lower = torch.full_like(start, -torch.inf)
    lower[:n] = 0
    if moves:
        lower[-1] = -math.log(largest_magnification(objective.model)) / step_scale[-1]
    found = minimizer(cost, start, lower, max_iterations=n_iterations, callback=after).x
    image, z = split(found)
    # what frames have in common has the same slope in each, but products of the minimiser round by place in its vector
    state = replace(state, image=image, z=objective.model.aberrations.mean_common(z))
    if not moves:
        return state
    turn, shrinkage = found[place:] * step_scale
    # the minimiser knows no upper bound, and a mask seldom shrinks until its holes are too few samples wide
    most = -math.log(smallest_magnification(objective.model))
    return moved(state, torch.stack([turn, shrinkage.clamp(max=most)]))


class Watched:
    """A minimiser that tells of its last descent whether it is stuck.

    It is if it has made iterations and is back where it began, though it does not say that this is a minimum, as an
    optimiser that diverges from its first step.
    """

    def __init__(self, minimizer: Minimizer) -> None:
        self.minimizer: Minimizer = minimizer
        self.is_stuck: bool = False

    def __call__(
        self, cost: Cost, start: Tensor, lower: Tensor, *, max_iterations: int, callback: AfterIteration | None = None
    ) -> Minimum:
        found = self.minimizer(cost, start, lower, max_iterations=max_iterations, callback=callback)
        is_back = torch.equal(found.x, torch.maximum(start, lower))
        self.is_stuck = is_back and found.n_iterations > 0 and not found.converged
        return found


def place_scale(objective: MyopicObjective, state: State) -> Tensor:
    """Return the units (2,) in which the misfit has unit curvature along a step of the mask."""
    slopes = slopes_of_frames(objective.model, state.image, state.z)
    return information(slopes, objective.scaled_data(state.calibration)[1]).diagonal().rsqrt()


def scales(objective: MyopicObjective, state: State) -> tuple[Tensor, Tensor]:
    """Return units of image (H', W') and z (K,) in which the diagonal of the Hessian is about one.

    The curvature in the aberrations is estimated with random probes; that in the object is the energy of the PSFs plus
    the curvature of the prior, which differs between flat parts and edges.
    """
    generator = torch.Generator().manual_seed(_PROBE_SEED)
    precision = objective.scaled_data(state.calibration)[1]
    by_z, pixel = curvature(objective.model, state.image, state.z, precision, generator)
    by_z = by_z + objective.aberration_weight(state.calibration, state.z)
    z_scale = by_z.clamp(min=_LEAST_CURVATURE * float(by_z.max())).rsqrt()
    by_image = pixel + objective.prior_copies * objective.prior.curvature(state.image)
    return _OBJECT_STEP * by_image.rsqrt(), z_scale
