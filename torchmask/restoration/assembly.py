"""Assemble the result of a restoration from its final state."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.checkpoint import Progress, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.light_beyond import light_beyond
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.posterior import evenness, place_deviations, standard_deviations
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.state import State
from torchmask.restoration.traits import Refinement
from torchmask.restoration.verdict import Verdict


@torch.no_grad()
def assemble_result(
    objective: MyopicObjective,
    stack: FrameStack,
    progress: Progress,
    r0: float | None,
    verdict: Verdict | None = None,
    *,
    n_modes: int | None = None,
) -> RestorationResult:
    """Return the result of a finished restoration, with the first `n_modes` modes of the coefficients; None: all.

    `r0` [m] is the initial one of the prior, None if it has none.
    """
    model, state = objective.model, progress.state
    refined = progress.refinement is Refinement.ON
    change = model.aberrations.change(state.z)
    transmission, weight = state.calibration.transmission, state.calibration.aberration_weight
    made = torch.cat([model(state.image, state.z[part]) for part in model.chunks(len(state.z))])
    frames = made * transmission[:, None, None].to(made)
    background = model.background.level(objective.frames - frames, objective.precision)
    frames = frames + background
    residuals = (objective.frames - frames) * objective.precision.sqrt()
    beyond = light_beyond(model, state.image, state.z)
    whole = state.image * (stack.unit / (1 - beyond))
    return RestorationResult(
        object=model.window.crop(whole).clone(),
        extended_object=whole,
        light_beyond=beyond,
        coefficients=model.aberrations.coefficients(state.z)[..., :n_modes],
        transmission=transmission,
        background=(background * stack.unit + stack.known).mean((1, 2)).to(transmission),
        model=frames * stack.unit + stack.known,
        residuals=residuals,
        chi_square=(residuals**2).sum((1, 2)) / stack.valid.sum((1, 2)).clamp(min=1),
        prior=repr(objective.prior),
        r0=math.nan if r0 is None else r0 * weight ** (3 / 5),
        noise=stack.variance**0.5,
        cost=torch.tensor(progress.costs, dtype=torch.float64, device="cpu"),
        converged=progress.status is Status.CONVERGED,
        message=_message(progress),
        n_evaluations=progress.n_evaluations,
        seconds=0.0,
        rotation=state.geometry.rotation,
        magnification=state.geometry.magnification,
        geometry_std=_geometry_deviations(objective, state) if refined else None,
        verdict=verdict,
        motion=None if change is None else change[..., :n_modes],
    )


def _geometry_deviations(objective: MyopicObjective, state: State) -> Tensor:
    """Return the standard deviations (2,) of rotation [rad] and magnification."""
    scale = torch.tensor([1.0, state.geometry.magnification], dtype=torch.float64, device="cpu")
    return scale * place_deviations(objective, state, objective.model.cutoff).cpu()


def add_deviations(
    result: RestorationResult,
    objective: MyopicObjective,
    stack: FrameStack,
    progress: Progress,
    n_samples: int,
) -> RestorationResult:
    """Return the result with standard deviations of the object, up to the cut-off, and of the coefficients.

    Warns if its verdict is that light is scarce: then they count noise, and not what the prior has taken off.
    """
    if result.verdict is not None and result.verdict.is_scarce:
        warnings.warn(
            "the frames show too little of the object for its standard deviations, which may be several times too "
            "small: they count noise, not what the prior on the object has taken off; take more light or more frames",
            stacklevel=3,
        )
    model = objective.model
    image, z = standard_deviations(objective, progress.state, model.cutoff, stack.photon_share, n_samples)
    if not progress.integrated:  # in faint light it is the prior that makes an object even
        image = image * evenness(progress.state.image)
    spread = torch.stack([model.aberrations.coefficients(sample) for sample in z]).square().mean((0, 1)).sqrt()
    spread = spread[:, : result.coefficients.shape[-1]]
    deviations = model.window.crop(image) * (stack.unit / (1 - result.light_beyond))
    return replace(result, object_std=deviations, coefficients_std=spread)


def _message(progress: Progress) -> str:
    iterations = len(progress.costs)
    if progress.status is Status.CONVERGED:
        message = f"converged: the last segment lowered the cost by a fraction {progress.decrease or 0.0:.1e}"
    elif progress.status is Status.STUCK:
        message = f"stopped, as {Status.STUCK.value}: try smaller steps, or another minimiser"
    elif progress.status is Status.ITERATION_LIMIT:
        message = f"stopped at max_iterations = {iterations}"
    else:
        message = "stopped at the limit of iterations for a start"
    if progress.averaged > 1:
        message += f"; the mean object of {progress.averaged} starts, of {progress.starts} made"
    elif progress.starts > 1:
        message += f"; the best of {progress.starts} starts" + (", two of which ended alike" if progress.alike else "")
    message += "; then phases were retrieved for the object found" if progress.retrieved else ""
    return message + ("; then the aberrations were integrated out" if progress.integrated else "")
