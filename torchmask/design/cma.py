"""CMA-ES over the positions of the holes, the search of the published method."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchmask.design.merit import Criterion, Holes, Merit
from torchmask.design.refine import PENALTY, Monitor
from torchmask.design.starts import random_mask
from torchmask.io import extra

POPULATION = 32


def evolve(
    criterion: Criterion, holes: Holes, budget: int, rng: np.random.Generator, monitor: Monitor
) -> tuple[Tensor, int]:
    """Return the best point x (1, F) of CMA-ES with a quadratic penalty on constraints, and the evaluations used.

    It starts from a random mask with steps of a fifth of the mask diameter, evaluates each generation in one batched
    call, and restarts from another random mask when it has converged and budget is left. With a budget of one mask, or
    if no hole is free to move, that mask is measured. Source: N. Hansen, The CMA evolution strategy: a tutorial,
    arXiv:1604.00772; package `cma`.

    Raises ValueError if the criterion has no finite logarithm at any mask.
    """
    with extra("design"):
        import cma

    merit = Merit(criterion, holes, PENALTY)
    population = min(POPULATION, budget)
    best, best_value = random_mask(holes, rng), np.inf

    def measure(x: Tensor) -> list[float]:
        nonlocal best, best_value
        values = merit.value(x)
        values = torch.where(values.isfinite(), values, torch.inf)
        index = int(values.argmin())
        if float(values[index]) < best_value:
            best, best_value = x[index], float(values[index])
        monitor.update(merit.evaluations, values, values.exp(), x)
        return values.double().cpu().tolist()

    alone = population == 1 or holes.subspace.size == 0  # pycma needs two points, and a coordinate to change
    if alone:
        measure(best[None])
    while not alone and merit.evaluations + population <= budget:
        start = random_mask(holes, rng).double().cpu().numpy()
        options = {
            "popsize": population,
            "randn": lambda *shape: rng.standard_normal(shape),
            # By default pycma seeds NumPy's global state, logs to outcmaes/ and reads cma_signals.in.
            "seed": np.nan,
            "verbose": -9,
            "verb_log": 0,
            "verb_disp": 0,
            "signals_filename": "",
            "tolfun": 1e-7,
        }
        strategy = cma.CMAEvolutionStrategy(start, 0.2, options)
        while not strategy.stop() and merit.evaluations + population <= budget:
            points = np.asarray(strategy.ask())
            strategy.tell(list(points), measure(torch.from_numpy(points).to(best)))
    merit.require_value(np.isfinite(best_value))
    return best[None], merit.evaluations
