"""Quasi-Newton descents from many random masks, then basin hopping on a pool of the best, in one batch throughout."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Criterion, Evaluation, Holes, Merit
from torchmask.design.refine import Monitor
from torchmask.design.starts import changed_mask, random_mask, turned_to_fit

BATCH = 32  # masks that descend at a time
POOL = 12
FINALISTS = 8
RANDOM_SHARE = 0.3  # share of the budget for random starts, before basin hopping
FREE_SHARE = 0.5  # share of the budget for masks without the rules that are not alike all around
TURNED = 4  # starts from each of the best of these masks
WEIGHT = 1e3  # of the squared overlaps; more slows the descents, less ranks masks by gains that the polish removes
TOLERANCE = 1e-3  # predicted decrease of log MSE at which a descent ends; the pool is polished later
SAME = 0.01  # rms difference of sorted separations, in mask diameters, below which two masks are the same optimum


class Pool:
    """The best local optima so far, all different up to rotation, reflection and the order of holes."""

    holes: Holes
    size: int

    def __init__(self, holes: Holes, size: int) -> None:
        self.holes, self.size = holes, size
        self.entries: list[tuple[float, Tensor, Tensor]] = []  # value, x, sorted separations

    def offer(self, x: Tensor, value: float) -> None:
        """Keep x (F,) if it is among the best. Of two masks that are the same optimum only the better stays."""
        if not np.isfinite(value):
            return
        shape = torch.pdist(self.holes.aperture(x).centers).sort().values / self.holes.template.mask_diameter
        near = [float((shape - other).square().mean().sqrt()) < SAME for _, _, other in self.entries]
        if any(same and entry[0] <= value for same, entry in zip(near, self.entries, strict=True)):
            return
        self.entries = [entry for same, entry in zip(near, self.entries, strict=True) if not same]
        self.entries = sorted([*self.entries, (value, x, shape)], key=lambda entry: entry[0])[: self.size]


def basin_hopping(
    criterion: Criterion, holes: Holes, budget: int, rng: np.random.Generator, monitor: Monitor
) -> tuple[Tensor, int]:
    """Return the best few local optima (n, F), best first, and the number of evaluations used, at most `budget`.

    Where rules are not alike all around, such as those on vanes, half of the budget goes to masks without them, which
    are then turned to where they break them least, as descents carry no hole across a vane.

    Raises ValueError if the criterion has no finite logarithm at any mask.
    """
    merit, spent = Merit(criterion, holes, WEIGHT), 0
    starts: list[Tensor] = []
    if holes.orientation_matters and (share := int(FREE_SHARE * budget)) >= BATCH:
        free = Merit(criterion, holes.free_to_turn, WEIGHT)

        def tell(found: Evaluation, x: Tensor) -> None:
            under_all = merit.penalised(found.relative_mse, holes.aperture(x))
            monitor.update(free.evaluations, under_all, found.relative_mse, x)

        shapes = _hop(free, share, [], rng, tell).entries
        starts = [turned_to_fit(holes, x, rng) for _, x, _ in shapes for _ in range(TURNED)]
        spent = free.evaluations
    pool = _hop(
        *(merit, budget - spent, starts, rng),
        lambda found, x: monitor.update(spent + merit.evaluations, found.merit, found.relative_mse, x),
    )
    merit.require_value(bool(pool.entries))
    return torch.stack([x for _, x, _ in pool.entries[:FINALISTS]]), spent + merit.evaluations


def _hop(
    merit: Merit,
    budget: int,
    starts: list[Tensor],
    rng: np.random.Generator,
    tell: Callable[[Evaluation, Tensor], None],
) -> Pool:
    """Return the pool after descents from `starts`, or if there are none from random masks, and then from the pool."""
    holes, starts, seeded = merit.holes, starts[::-1], bool(starts)
    batch = max(1, min(BATCH, budget))
    pool = Pool(holes, POOL)

    def new_start() -> Tensor:
        if starts:
            return starts.pop()
        if (not seeded and merit.evaluations < RANDOM_SHARE * budget) or not pool.entries:
            return random_mask(holes, rng)
        return changed_mask(holes, pool.entries[rng.integers(len(pool.entries))][1], rng)

    first = torch.stack([new_start() for _ in range(batch)])
    descent = BatchedBFGS(first, first_step=0.03, tolerance=TOLERANCE)
    while merit.evaluations + batch <= budget:
        points = descent.ask()
        found = merit(points)
        descent.tell(found.merit, found.gradient)
        tell(found, points)
        for k in torch.nonzero(descent.finished)[:, 0].tolist():
            pool.offer(descent.points[k].clone(), float(descent.values[k]))
            descent.restart(slice(k, k + 1), new_start()[None])
    for k in range(batch):
        pool.offer(descent.points[k].clone(), float(descent.values[k]))
    return pool


def coarse_criterion(criterion: Criterion) -> Criterion:
    """Return `criterion` on a grid of 96 pixels, coarse for speed but too fine for a search to exploit its errors."""
    grid, on_grid = getattr(criterion, "grid", None), getattr(criterion, "on_grid", None)
    return criterion if grid is None or on_grid is None or min(grid.shape) <= 96 else on_grid(96)
