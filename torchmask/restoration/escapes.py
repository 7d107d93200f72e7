"""Ways out of local minima that a descent does not find.

Outlying frames: for a fixed object, the aberrations of a frame are a small separate problem, for which several random
starts are cheap. Fringes: in a band, pistons may be whole waves off (`fringes`). Sub-pixel position of the object: the
frames do not constrain it, as a shift of the object and the opposite tilt of all frames give the same images. The prior
on the object does, because edges and points that are centred on pixels have the least total variation and no negative
side lobes. A descent hardly moves along this direction, so the best position is searched directly.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.metrics import shift
from torchmask.restoration.calibration import calibrate
from torchmask.restoration.cuda_graphs import graphed
from torchmask.restoration.descent import Variables, descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.fringes import change_fringes
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import Minimizer, minimize_bounded
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State
from torchmask.restoration.traits import Traits


def escape(
    objective: MyopicObjective,
    state: State,
    first_inflation: float,
    traits: Traits,
    schedule: Schedule,
    minimizer: Minimizer,
    number: int,
    *,
    whole_waves: bool,
) -> tuple[State, int]:
    """Try all ways out, for the `number`-th time; return the state, itself if none gains, and the evaluations.

    `whole_waves` is whether pistons change by these. Frames of a full pupil already had many starts in the tournament,
    unless they started from a sensor's estimate.
    """
    evaluations = 0
    if traits.estimated or not traits.many_minima:
        seed = traits.seed + number
        state, evaluations = restart_outlier_frames(objective, state, first_inflation, schedule, minimizer, seed)
        if whole_waves:
            state, tried = change_fringes(objective, state)
            evaluations += tried
    if Free.OBJECT in objective.free:
        state = centre_on_pixels(objective, state, schedule)
    return state, evaluations


def restart_outlier_frames(
    objective: MyopicObjective,
    state: State,
    first_inflation: float,
    schedule: Schedule,
    minimizer: Minimizer,
    seed: int,
) -> tuple[State, int]:
    """Refit the aberrations of outlying frames from several random starts; return the state and the evaluations spent.

    All starts of all such frames descend together, as if each were a frame. A frame keeps its aberrations unless a
    start ends at a lower cost; if all keep theirs, `state` itself is returned.
    """
    inflation = calibrate(objective, state).calibration.noise_inflation
    lost = (inflation > schedule.outlying * inflation.quantile(0.25)).nonzero().flatten()
    every = lost.repeat(schedule.restarts)
    if not len(every):
        return state, 0
    starts, now = objective.of_frames(every, free=Free.ABERRATIONS), state.of_frames(every)
    n_evaluations = 0

    def count(cost: float, evaluations: int, variables: Variables) -> None:
        nonlocal n_evaluations
        n_evaluations += evaluations

    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(now.z.shape, dtype=now.z.dtype, device="cpu", generator=generator).to(now.z)
    spread = float((state.z - objective.centre).square().mean(1).sqrt().median())  # robust against the lost frames
    fresh = objective.model.aberrations.with_common_of(starts.centre + spread * noise, now.z)
    trial = replace(now, z=fresh).with_noise_inflation(first_inflation)
    for _ in range(schedule.restart_rounds):  # the noise falls, else most starts end in poor minima
        trial = descend(starts, trial, schedule.restart_iterations, minimizer, count)
        left = calibrate(starts, trial).calibration.noise_inflation
        trial = trial.calibrated(noise_inflation=left)
    rivals = torch.cat([state.z[lost], trial.z])  # the present aberrations first
    all_rivals = torch.cat([lost, every])
    costs = objective.of_frames(all_rivals).frame_costs(state.image, rivals, state.of_frames(all_rivals).calibration)
    best = costs.nan_to_num(torch.inf).unflatten(0, (-1, len(lost))).argmin(0)
    spent = n_evaluations * len(now.z) // len(state.z)
    if not best.any():
        return state, spent
    z = state.z.clone()
    z[lost] = rivals[best * len(lost) + torch.arange(len(lost), device=best.device)]
    return replace(state, z=z), spent


def centre_on_pixels(objective: MyopicObjective, state: State, schedule: Schedule) -> State:
    """Return the state shifted by less than a pixel to the lowest cost, or `state` itself if that is not lower.

    At each position the object is fitted with the misfit approximated as quadratic, for known PSFs and a full field,
    which needs FFTs of the object only, not of the frames.
    """
    gradient, power = objective.object_quadratic(state.image, state.z, state.calibration)
    gradient = gradient + objective.model.background.price

    def settle(offset: tuple[float, float]) -> tuple[float, Tensor]:
        image, slope = shift(state.image, offset), shift(gradient, offset)
        return settle_object(image, slope, power, objective.prior, schedule.pixel_iterations)

    stay = best = settle((0.0, 0.0))
    place = (0.0, 0.0)
    for step in schedule.pixel_steps:
        for dy, dx in ((step, 0.0), (0.0, step)):
            offsets = [(place[0] + sign * dy, place[1] + sign * dx) for sign in (1, -1)]
            for offset, trial in zip(offsets, objective.parallel(settle, offsets), strict=True):
                if trial[0] < best[0]:
                    best, place = trial, offset
    z = state.z - tilt(objective.model, place).to(state.z)
    change = (state.z - objective.centre) ** 2 - (z - objective.centre) ** 2
    held = 0.5 * float((objective.aberration_weight(state.calibration, state.z) * change).sum())
    return replace(state, image=best[1], z=z) if stay[0] - best[0] + held > 0 else state


@torch.no_grad()  # needed here too, as no_grad applies to one thread only
def settle_object(
    centre: Tensor, gradient: Tensor, power: Tensor, prior: ObjectPrior, max_iterations: int
) -> tuple[float, Tensor]:
    """Minimise <gradient, o - centre> + 1/2 |o - centre|^2_power + prior(o) over o >= 0; return (value, o)."""
    start = centre.clamp(min=0)
    scale = (power.mean() + prior.curvature(start)).rsqrt()

    def of_vector(x: Tensor) -> tuple[Tensor, Tensor]:
        image = x.view_as(centre) * scale
        change = image - centre
        curved = torch.fft.irfft2(torch.fft.rfft2(change) * power, s=change.shape)
        penalty, slope = prior.value_and_gradient(image)
        value = (change * (gradient + 0.5 * curved)).sum() + penalty
        return value, ((gradient + curved + slope) * scale).flatten()

    there = graphed(of_vector, centre.device)

    def cost(x: Tensor) -> tuple[float, Tensor]:
        value, by_x = there(x)
        return float(value), by_x

    x = (start / scale).flatten()
    found = minimize_bounded(cost, x, torch.zeros_like(x), max_iterations=max_iterations)
    return found.value, found.x.view_as(centre) * scale


@torch.no_grad()
def settle(objective: MyopicObjective, state: State, n_iterations: int) -> State:
    """Return the state with the object that suits its aberrations best; the misfit is approximated as quadratic."""
    slope, power = objective.object_quadratic(state.image, state.z, state.calibration)
    slope = slope + objective.model.background.price
    return replace(state, image=settle_object(state.image, slope, power, objective.prior, n_iterations)[1])


def tilt(model: ExposureModel, offset: tuple[float, float]) -> Tensor:
    """Return the parameters (K,) that shift every image by `offset` (dy, dx) pixels, as closely as the modes allow."""
    samples = model.pupil.samples()
    phase = 2 * math.pi * (samples.positions * samples.positions.new_tensor([offset[1], offset[0]])).sum(-1)
    # A constant phase has no effect, so it is fitted too: the modes need not include the mean piston.
    modes = torch.cat([samples.basis, samples.chromaticity[:, None]], dim=1).double()
    q, r = torch.linalg.qr(modes)
    return torch.linalg.lstsq(r.cpu(), (q.T @ phase.double()).cpu()[:, None], driver="gelsd").solution[:-1, 0].to(q)
