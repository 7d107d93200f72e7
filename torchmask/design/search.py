"""The search for the best mask."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchmask.design.cma import evolve
from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.feasibility import Constraint
from torchmask.design.hybrid import coarse_criterion, explore
from torchmask.design.merit import Criterion, Holes
from torchmask.design.refine import Monitor, SearchResult, conclude, polish
from torchmask.optics.aperture import SparseAperture
from torchmask.record import Callback

METHODS = ("hybrid", "cma")


def search_mask(
    criterion: Criterion,
    n_subapertures: int,
    mask_diameter: float,
    fill_factor: float,
    *,
    method: str = "hybrid",
    refine: bool = True,
    seed: int = 0,
    budget: int | None = None,
    constraints: Sequence[Constraint] = (),
    callback: Callback | None = None,
) -> SearchResult:
    """Search the positions of N equal round holes, at fixed collecting area, that minimise a criterion.

    Parameters
    ----------
    criterion : AsymptoticMSE, or any differentiable error of masks like it
    n_subapertures : int
        N.
    mask_diameter : float
        D [m].
    fill_factor : float
        N d^2 / D^2, which sets the diameter d of the holes.
    method : {"hybrid", "cma"}
        "cma": CMA-ES with penalties, the published method. "hybrid": batched quasi-Newton descents from random
        masks, then basin hopping on a pool of the best, on a coarse frequency grid; better at equal time.
    refine : bool
        End with a gradient stage on the grid of `criterion`. Without it the best mask of the search is only moved onto
        the rules.
    seed : int
        Same seed, same numbers (on the same machine and number of threads).
    budget : int, optional
        Evaluations of the criterion (for "hybrid": on the coarse grid) before the gradient stage.
    constraints : sequence of Constraint
        Rules beside the mask disc and the overlap, which always hold.
    callback : callable, optional
        Gets a `Record` now and then, with the best centres so far, which may still break a rule by a little.

    Raises
    ------
    ValueError
        For a request that no mask fulfils.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}: known methods are {', '.join(METHODS)}")
    diameter = mask_diameter * math.sqrt(fill_factor / n_subapertures)
    holes = Holes(
        SparseAperture(torch.zeros(n_subapertures, 2, dtype=torch.float64), diameter, mask_diameter),
        (InsideDisc(), NoOverlap(), *constraints),
    )
    seeds = np.random.SeedSequence(seed).spawn(1)
    rng = np.random.default_rng(seeds[0])
    if method == "cma":
        budget = 20_000 if budget is None else budget
        monitor = Monitor("design/cma", budget, holes, callback)
        best, used = evolve(criterion, holes, budget, 32, rng, monitor)
        starts = best[None]
    else:
        budget = 100_000 if budget is None else budget
        monitor = Monitor("design/hybrid", budget, holes, callback)
        starts, used = explore(coarse_criterion(criterion), holes, budget, rng, monitor)
    history = monitor.history
    if refine:
        allowance = 400 * len(starts)
        monitor = Monitor("design/refine", allowance, holes, callback)
        aperture, polished = polish(criterion, holes, starts, allowance, monitor)
        history |= monitor.history
        used += polished
    else:
        aperture = holes.feasible(starts[0])
    return conclude(criterion, aperture, constraints, used, history)
