"""One descent of object and aberrations, as a minimiser with bounds sees it: one scaled vector."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.adjoint import curvature
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimizer
from torchmask.restoration.state import State

_OBJECT_STEP = 0.3  # of the object's scale against that of the aberrations: measured, a factor of 3 either way is worse
_LEAST_CURVATURE = 1e-6  # of the largest: directions that neither data nor prior hold are left with a finite scale
_PROBE_SEED = 0

Variables = Callable[[], tuple[Tensor, Tensor]]
Listener = Callable[[float, int, Variables], None]
"""Told (cost, evaluations since the last time, function giving (image, z)) after every iteration."""


def descend(
    objective: MyopicObjective, state: State, n_iterations: int, minimizer: Minimizer, listener: Listener
) -> State:
    """Lower the objective from `state` for at most `n_iterations`, its calibration as it is, the object positive."""
    image_scale, z_scale = scales(objective, state)
    evaluate = objective.evaluator(state.calibration)
    n, seen = state.image.numel(), 0

    def split(x: Tensor) -> tuple[Tensor, Tensor]:
        return x[:n].view_as(state.image) * image_scale, x[n:].view_as(state.z) * z_scale

    def cost(x: Tensor) -> tuple[float, Tensor]:
        value, by_image, by_z = evaluate(*split(x))
        return float(value), torch.cat([(by_image * image_scale).flatten(), (by_z * z_scale).flatten()])

    def after(x: Tensor, value: float, evaluations: int) -> None:
        nonlocal seen
        seen, new = evaluations, evaluations - seen
        listener(value, new, lambda: split(x))

    start = torch.cat([(state.image / image_scale).flatten(), (state.z / z_scale).flatten()])
    lower = torch.full_like(start, -torch.inf)
    lower[:n] = 0
    image, z = split(minimizer(cost, start, lower, max_iterations=n_iterations, callback=after).x)
    return replace(state, image=image, z=z)


def scales(objective: MyopicObjective, state: State) -> tuple[Tensor, Tensor]:
    """Units in which the diagonal of the Hessian is about one, for image (H', W') and z (K,).

    Curvature of the aberrations is measured by probes; that of the object is the energy of the PSFs and what its prior
    says, which tells flat pixels from edges.
    """
    generator = torch.Generator().manual_seed(_PROBE_SEED)
    precision = objective.scaled_data(state.calibration)[1]
    by_z, pixel = curvature(objective.model, state.image, state.z, precision, generator)
    by_z = by_z + objective.aberration_weight(state.calibration, state.z)
    z_scale = by_z.clamp(min=_LEAST_CURVATURE * float(by_z.max())).rsqrt()
    by_image = pixel + objective.prior_copies * objective.prior.curvature(state.image)
    return _OBJECT_STEP * by_image.rsqrt(), z_scale
