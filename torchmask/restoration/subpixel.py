"""Where the object lies between the pixels.

The frames cannot tell: a shift of the object and opposite tilts of all frames make the same images. The priors on the
object can, because edges and points that lie on the pixels have the least total variation and no negative
side lobes. A descent hardly moves along this direction, so the best position is looked for directly.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.lbfgsb import minimize_bounded
from torchmask.restoration.model import ExposureModel
from torchmask.restoration.priors import total_variation, total_variation_curvature
from torchmask.restoration.problem import JointProblem, State

_STEPS = (0.4, 0.2)  # pixels: along each axis in turn, whatever lowers the cost is taken
_ITERATIONS = 60


def tilt(model: ExposureModel, offset: tuple[float, float]) -> Tensor:
    """The aberrations (K,) that move every image by `offset` (dy, dx) pixels, as closely as the modes can."""
    phase = 2 * math.pi * (model.positions * model.positions.new_tensor([offset[1], offset[0]])).sum(-1)
    # A constant phase does nothing; it may take up the mean piston, which the modes need not contain.
    modes = torch.cat([model.basis, model.chromaticity[:, None]], dim=1).double()
    q, r = torch.linalg.qr(modes)
    return torch.linalg.lstsq(r.cpu(), (q.T @ phase.double()).cpu()[:, None], driver="gelsd").solution[:-1, 0].to(q)


def centre_on_pixels(problem: JointProblem, state: State) -> State:
    """The state moved by less than a pixel to where the cost is least, or `state` itself.

    For each position the object is settled in the quadratic approximation of the misfit in the object, for known PSFs
    and a full field: that needs no more frames, only FFTs of the object.
    """
    gradient, power = problem.object_quadratic(state)

    def settle(offset: tuple[float, float]) -> tuple[float, Tensor]:
        return _settle(shift(state.image, offset), shift(gradient, offset), power, problem.tv_weight)

    stay = best = settle((0.0, 0.0))
    place = (0.0, 0.0)
    for step in _STEPS:
        for dy, dx in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)):
            offset = (place[0] + dy, place[1] + dx)
            if (trial := settle(offset))[0] < best[0]:
                best, place = trial, offset
    z = state.z - tilt(problem.model, place).to(state.z)
    change = (state.z - problem.centre) ** 2 - (z - problem.centre) ** 2
    gain = stay[0] - best[0] + 0.5 * float((problem.prior(state) * change).sum())
    return replace(state, image=best[1], z=z) if gain > 0 else state


def _settle(centre: Tensor, gradient: Tensor, power: Tensor, tv_weight: float) -> tuple[float, Tensor]:
    """Minimise <gradient, o - centre> + 1/2 |o - centre|^2_power + tv_weight TV(o) over o >= 0: (value, o)."""
    start = centre.clamp(min=0)
    scale = (power.mean() + tv_weight * total_variation_curvature(start)).rsqrt()

    def cost(x: Tensor) -> tuple[float, Tensor]:
        image = x.view_as(centre) * scale
        change = image - centre
        curved = torch.fft.irfft2(torch.fft.rfft2(change) * power, s=change.shape)
        variation, slope = total_variation(image)
        value = (change * (gradient + 0.5 * curved)).sum() + tv_weight * variation
        return float(value), ((gradient + curved + tv_weight * slope) * scale).flatten()

    x = (start / scale).flatten()
    found = minimize_bounded(cost, x, torch.zeros_like(x), max_iterations=_ITERATIONS)
    return found.value, found.x.view_as(centre) * scale


def shift(image: Tensor, offset: tuple[float, float]) -> Tensor:
    """Move an image (H, W) by `offset` (dy, dx) pixels, with wrap-around, by the shift theorem."""
    nu_y = torch.fft.fftfreq(image.shape[0], dtype=image.dtype, device=image.device)[:, None]
    nu_x = torch.fft.rfftfreq(image.shape[1], dtype=image.dtype, device=image.device)
    angle = -2 * math.pi * (nu_y * offset[0] + nu_x * offset[1])
    return torch.fft.irfft2(torch.fft.rfft2(image) * torch.polar(torch.ones_like(angle), angle), s=image.shape)
