"""Descents from many random masks, then basin hopping on a pool of the best, all in one batch that never waits."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Criterion, Holes, Merit
from torchmask.design.refine import Monitor
from torchmask.design.starts import changed_mask, random_mask

BATCH = 32  # masks in flight
POOL = 12
FINALISTS = 8
RANDOM_SHARE = 0.3  # of the budget goes to random starts before the pool is hopped on
WEIGHT = 1e3  # of the squared overlaps: stiffer slows the descents, softer ranks by what the polish takes away
TOLERANCE = 1e-3  # promised decrease of log MSE at which a descent ends; the pool is polished later
SAME = 0.01  # masks whose sorted separations differ by less than this of the diameter (rms) are one optimum


class Pool:
    """The best local optima so far, all different up to rotation, reflection and the order of holes."""

    holes: Holes
    size: int

    def __init__(self, holes: Holes, size: int) -> None:
        self.holes, self.size = holes, size
        self.entries: list[tuple[float, Tensor, Tensor]] = []  # value, x, sorted separations

    def offer(self, x: Tensor, value: float) -> None:
        """Keep x (F,) if it is among the best; of two that are the same optimum the better stays."""
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
    """The best few local optima (n, F) found within `budget` evaluations of `criterion`, best first, and their cost."""
    merit = Merit(criterion, holes, WEIGHT)
    batch = max(1, min(BATCH, budget))
    pool = Pool(holes, POOL)
    descent = BatchedBFGS(
        torch.stack([random_mask(holes, rng) for _ in range(batch)]), first_step=0.03, tolerance=TOLERANCE
    )
    while merit.evaluations + batch <= budget:
        points = descent.ask()
        found = merit(points)
        descent.tell(found.merit, found.gradient)
        monitor.update(merit.evaluations, found.merit, found.relative_mse, points)
        for k in torch.nonzero(descent.finished)[:, 0].tolist():
            pool.offer(descent.points[k].clone(), float(descent.values[k]))
            if merit.evaluations < RANDOM_SHARE * budget or not pool.entries:
                start = random_mask(holes, rng)
            else:
                start = changed_mask(holes, pool.entries[rng.integers(len(pool.entries))][1], rng)
            descent.restart(torch.tensor([k]), start[None])
    for k in range(batch):
        pool.offer(descent.points[k].clone(), float(descent.values[k]))
    return torch.stack([x for _, x, _ in pool.entries[:FINALISTS]]), merit.evaluations


def coarse_criterion(criterion: Criterion) -> Criterion:
    """`criterion` on a grid of 96 pixels, coarse enough for speed and not yet so coarse that a search games it."""
    grid, on_grid = getattr(criterion, "grid", None), getattr(criterion, "on_grid", None)
    return criterion if grid is None or on_grid is None or min(grid.shape) <= 96 else on_grid(96)
