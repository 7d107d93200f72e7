"""Search for the mask that minimises a criterion."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchmask.design.cma import evolve
from torchmask.design.constraint_base import Constraint, Infeasible
from torchmask.design.criterion_check import require_criterion
from torchmask.design.hybrid import basin_hopping, coarse_criterion
from torchmask.design.merit import Criterion, device_of, for_processor
from torchmask.design.refine import Monitor, SearchResult, conclude, polish
from torchmask.design.room import require_room
from torchmask.numbers import whole_number
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import hole_diameter
from torchmask.record import Callback

DEFAULT_BUDGETS = {"hybrid": 100_000, "cma": 20_000}  # evaluations for up to 11 holes
METHODS = tuple(DEFAULT_BUDGETS)
_ALONE = 320  # evaluations for one hole, which has no pattern: a descent of each mask of a batch
POLISH = 120  # evaluations of the gradient stage for each of its starting masks


@torch.inference_mode(False)  # it differentiates, whatever the caller does
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
    """Search for the positions of N equal round holes that minimise a criterion at fixed collecting area.

    Parameters
    ----------
    criterion : AsymptoticMSE or similar
        Differentiable error of masks, which may be on a GPU; the search itself is made on the processor.
    n_subapertures : int
        Number of holes, N.
    mask_diameter : float
        Diameter D of the mask [m].
    fill_factor : float
        Fill factor N d^2 / D^2, which sets the diameter d of the holes.
    method : {"hybrid", "cma"}
        "cma" is CMA-ES with penalties, the published method. "hybrid" makes batched quasi-Newton descents from random
        masks, then basin hopping on a pool of the best, on a coarse frequency grid; it is better in the same time.
        Where constraints are not alike all around, such as those on vanes, half of its budget goes to masks without
        them, which it then turns into place.
    refine : bool
        Whether to end with a gradient stage on the grid of `criterion`. Otherwise the best mask of the search is only
        projected onto the constraints.
    seed : int
        Random seed. The same seed gives the same result on the same machine with the same number of threads.
    budget : int, optional
        Evaluations of the criterion before the gradient stage, for "hybrid" on the coarse grid. One hole, or holes that
        are all fixed, take no more than they need.
    constraints : sequence of Constraint
        Constraints in addition to those on the mask disc and on overlaps, which always hold.
    callback : callable, optional
        Receives a `Record` from time to time with the best centres so far, which may still violate a constraint
        slightly.

    Returns
    -------
    SearchResult
        Best mask, feasible to 1e-9 of its diameter, with its error on the grid of `criterion` and on its device.

    Raises
    ------
    ValueError
        If an argument is out of range, the holes are narrower than a sample of the criterion's frequencies, no mask
        that fulfils the request is found, or the criterion has no finite logarithm at any mask.
    TypeError
        If `constraints` is not a sequence of constraints, or as `require_criterion`.

    Examples
    --------
    A small search on a coarse grid; leave `budget` out for a result to quote.

    >>> from torchmask.design.criterion import AsymptoticMSE
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> from torchmask.grid import Grid
    >>> grid = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
    >>> criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)
    >>> found = search_mask(criterion, n_subapertures=3, mask_diameter=1.0, fill_factor=0.1, seed=0, budget=300)
    >>> found.aperture.centers.shape, found.relative_mse < 0.5
    (torch.Size([3, 2]), True)
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}: known methods are {', '.join(METHODS)}")
    n_subapertures = whole_number("n_subapertures", n_subapertures)
    if budget is None:
        # The cost of an evaluation grows with N, and searches should take about the same time.
        budget = max(1, int(DEFAULT_BUDGETS[method] * min(1.0, 11 / n_subapertures)))
    budget = whole_number("budget", budget, note=", in evaluations")
    seed = whole_number("seed", seed, least=0)
    narrowest = _require_sampling(criterion, n_subapertures, mask_diameter, fill_factor)
    holes, known = require_room(n_subapertures, mask_diameter, fill_factor, constraints, callback, narrowest)
    trial, needs_gradient = _ring(holes.template), refine or method == "hybrid"
    require_criterion(for_processor(criterion), trial, differentiable=needs_gradient)
    if holes.subspace.size == 0:
        budget = 1  # the only mask
    elif n_subapertures == 1:
        budget = min(budget, _ALONE)
    rng = np.random.default_rng(seed)
    monitor = Monitor(f"design/{method}", budget, holes, callback)
    explore = evolve if method == "cma" else basin_hopping
    working = for_processor(criterion if method == "cma" else coarse_criterion(criterion))
    starts, used = explore(working, holes, budget, rng, monitor)
    device, criterion = device_of(criterion), for_processor(criterion)
    history, best = monitor.history(criterion, used)
    # Without a gradient stage, one evaluation of each candidate is needed to compare them once they are feasible, and
    # one of the mask that the room for them gave.
    allowance = (POLISH if refine else 1) * len(starts) + 1
    monitor = Monitor("design/refine", allowance, holes, callback, before=used, known=known if best is None else best)
    aperture, polished = polish(criterion, holes, starts, allowance, monitor)
    of_polish, best = monitor.history(criterion, polished)
    return conclude(criterion, best or aperture, constraints, used + polished, history | of_polish, device)


def _ring(template: SparseAperture) -> SparseAperture:
    """Return the mask with its holes evenly on a ring, on which a criterion can be tried."""
    number = torch.arange(template.n_subapertures, device="cpu").to(template.centers)
    angle = 2 * math.pi / template.n_subapertures * number
    return template.replace(centers=0.35 * template.mask_diameter * torch.stack([angle.cos(), angle.sin()], -1))


def _require_sampling(criterion: Criterion, n_subapertures: int, mask_diameter: float, fill_factor: float) -> float:
    """Return the width of a sample of the criterion's frequencies in the pupil [m], 0 if it has no grid.

    The light of a baseline lies within a hole diameter of its frequency: that of narrower holes falls in between, so
    `Infeasible` is raised for them. Raises ValueError if the grid aliases an image through masks of this diameter.
    """
    hole, grid = hole_diameter(n_subapertures, mask_diameter, fill_factor), getattr(criterion, "grid", None)
    if grid is not None:
        grid.require_sampling(mask_diameter)
    step = 0.0 if grid is None else grid.period / min(grid.shape)
    if grid is None or hole >= step:
        return step
    most, needed = math.floor(fill_factor * (mask_diameter / step) ** 2), math.ceil(grid.period / hole)
    fewer = f", n_subapertures of at most {most} at this fill factor" if most else ""
    raise Infeasible(
        f"holes of {hole:.4g} m are narrower than a sample of the criterion's frequencies, {step:.4g} m in the pupil, "
        f"which would miss their baselines: take holes of at least {step:.4g} m{fewer}, or a grid of at least {needed} "
        f"x {needed} frequencies"
    )
