"""Descents from many random masks, then basin hopping on a pool of the best, all in one batch that never waits."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Criterion, Holes, Merit
from torchmask.design.refine import PENALTY, Monitor

_BATCH = 32
_POOL = 12
_FINALISTS = 4


def coarse_criterion(criterion: Criterion, subaperture_diameter: float) -> Criterion:
    """The same criterion on the coarsest grid that a search can trust, if it can be had on another grid."""
    if not hasattr(criterion, "on_grid"):
        return criterion
    grid = criterion.grid
    n = 96
    if n >= min(grid.shape):
        return criterion
    return criterion.on_grid(n)


class Pool:
    """The best local optima so far, all different."""

    def __init__(self, size: int, distance: float) -> None:
        self.size, self.distance = size, distance
        self.points: list[Tensor] = []
        self.values: list[float] = []

    def offer(self, x: Tensor, value: float) -> None:
        for k, other in enumerate(self.values):
            if abs(other - value) < self.distance:  # the same optimum, up to rotation: keep the better
                if value < other:
                    self.points[k], self.values[k] = x, value
                break
        else:
            self.points.append(x)
            self.values.append(value)
        order = np.argsort(self.values)[: self.size]
        self.points = [self.points[k] for k in order]
        self.values = [self.values[k] for k in order]


def explore(
    criterion: Criterion, holes: Holes, budget: int, rng: np.random.Generator, monitor: Monitor
) -> tuple[Tensor, int]:
    """The best few local optima (n, F) found within `budget` evaluations of `criterion`, and the evaluations used."""
    merit = Merit(criterion, holes, PENALTY)
    generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
    pool = Pool(_POOL, 1e-4)
    x = holes.random(_BATCH, generator)
    descent = BatchedBFGS(x, first_step=0.03, tolerance=1e-4)
    while merit.evaluations + _BATCH <= budget:
        points = descent.ask()
        found = merit(points)
        descent.tell(found.merit, found.gradient)
        monitor.update(merit.evaluations, found.merit, found.relative_mse, points)
        for k in torch.nonzero(descent.finished)[:, 0].tolist():
            pool.offer(descent.points[k].clone(), float(descent.values[k]))
            if merit.evaluations < 0.3 * budget or not pool.points:
                start = holes.random(1, generator)[0]
            else:
                start = hop(holes, pool.points[rng.integers(len(pool.points))], rng, generator)
            descent.restart(torch.tensor([k]), start[None])
    for k in range(_BATCH):
        pool.offer(descent.points[k].clone(), float(descent.values[k]))
    return torch.stack(pool.points[:_FINALISTS]), merit.evaluations


def hop(holes: Holes, x: Tensor, rng: np.random.Generator, generator: torch.Generator) -> Tensor:
    """A start near x (F,): one hole anywhere, two anywhere, or all a little."""
    n = holes.template.n_subapertures
    move = rng.integers(3)
    if move == 2:
        return x + 0.03 * torch.as_tensor(rng.standard_normal(len(x))).to(x)
    for hole in rng.choice(n, size=min(n, move + 1), replace=False):
        x = holes.place(x[None], int(hole), holes.random_positions(1, generator).to(x))[0]
    return x
