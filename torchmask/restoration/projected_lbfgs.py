"""Limited-memory BFGS with lower bounds, on torch tensors, which stay on the device of the start."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from torchmask.restoration.corrections import make_corrections

_SUFFICIENT = 1e-4  # required fraction of the decrease that the slope predicts (Armijo)
_BACKTRACKS = 20

Cost = Callable[[Tensor], tuple[float, Tensor]]
"""Function of x (n,) that returns (value, gradient (n,))."""
AfterIteration = Callable[[Tensor, float, int], None]
"""Function called with (x, value, number of evaluations so far)."""


@dataclass(frozen=True)
class Minimum:
    """Outcome of a descent: final point (n,) and cost, iterations and evaluations, and whether and why it stopped."""

    x: Tensor
    value: float
    n_iterations: int
    n_evaluations: int
    converged: bool
    message: str


class Minimizer(Protocol):
    """Function that minimises a cost from a start, under lower bounds (-inf where there is none)."""

    def __call__(
        self, cost: Cost, start: Tensor, lower: Tensor, *, max_iterations: int, callback: AfterIteration | None = None
    ) -> Minimum: ...


@dataclass(frozen=True)
class ProjectedLBFGS:
    """`minimize_bounded` as a `Minimizer`, which keeps `n_corrections` pairs of steps and gradient changes."""

    n_corrections: int = 20

    def __call__(
        self, cost: Cost, start: Tensor, lower: Tensor, *, max_iterations: int, callback: AfterIteration | None = None
    ) -> Minimum:
        return minimize_bounded(
            cost, start, lower, max_iterations=max_iterations, n_corrections=self.n_corrections, callback=callback
        )


def minimize_bounded(
    cost: Cost,
    start: Tensor,
    lower: Tensor,
    *,
    max_iterations: int,
    max_evaluations: int | None = None,
    n_corrections: int = 20,
    gradient_tolerance: float = 0.0,
    cost_tolerance: float = 1e-12,
    callback: AfterIteration | None = None,
) -> Minimum:
    """Minimise `cost` over x >= `lower` by L-BFGS with two-metric projection.

    Variables at their bound that the gradient pushes against it stay there for the iteration; the others follow a
    backtracking line search along the quasi-Newton step, projected onto the bounds.

    Parameters
    ----------
    cost : callable
        Function of x (n,) that returns (value, gradient (n,)).
    start : (n,) tensor
        Starting point, which is clipped to the bounds.
    lower : (n,) tensor
        Lower bounds, -inf where there is none.
    max_iterations : int
        Maximum number of iterations.
    max_evaluations : int, optional
        Maximum number of evaluations of the cost. None: four times `max_iterations`.
    n_corrections : int
        Number of pairs of steps and gradient changes to keep.
    gradient_tolerance : float
        Converged when no component of the projected gradient is larger.
    cost_tolerance : float
        Converged when an iteration lowers the cost by a smaller fraction of it.
    callback : callable, optional
        Called with (x, value, number of evaluations so far) after every iteration.

    Raises
    ------
    ValueError
        If the shapes differ or the cost is not finite at the start.

    References
    ----------
    Bertsekas, SIAM J. Control Optim. 20, 221 (1982); Schmidt, Kim & Sra, in Optimization for Machine Learning (2011).

    Examples
    --------
    >>> target = torch.tensor([1.0, -2.0], dtype=torch.float64)
    >>> def cost(x): return float(((x - target) ** 2).sum()), 2 * (x - target)
    >>> minimize_bounded(cost, torch.zeros(2).double(), torch.zeros(2).double(), max_iterations=20).x
    tensor([1., 0.], dtype=torch.float64)
    """
    require_vectors(start, lower)
    budget = 4 * max_iterations if max_evaluations is None else max_evaluations
    x = torch.maximum(start, lower)
    value, gradient = cost(x)
    require_finite(value)
    memory = make_corrections(n_corrections, x)
    evaluations, iteration = 1, 0

    def end(message: str, converged: bool = False) -> Minimum:
        return Minimum(x, value, iteration, evaluations, converged, message)

    while True:
        free = (x > lower) | (gradient < 0)
        steepness = float((gradient * free).abs().max())
        if not math.isfinite(steepness):
            return end(f"the gradient is {steepness}")
        if steepness <= gradient_tolerance:
            return end(f"projected gradient {steepness:.1e}", converged=True)
        if iteration == max_iterations:
            return end(f"{max_iterations} iterations")
        direction = -memory.solve(gradient, free)
        # Without corrections the length of the gradient has no scale: limit the first step to one unit.
        step = 1.0 if len(memory) else min(1.0, 1 / float(direction.norm()))
        accepted = None
        for _ in range(_BACKTRACKS):
            if evaluations >= budget:
                return end(f"{budget} evaluations")
            trial = torch.maximum(x + step * direction, lower)
            moved = trial - x
            slope = float(gradient @ moved)
            if not slope < 0:  # nor if it is NaN, as of pairs that have no solution
                break
            new_value, new_gradient = cost(trial)
            evaluations += 1
            if new_value <= value + _SUFFICIENT * slope:
                accepted = trial, moved, new_value, new_gradient
                break
            step *= _shorter(slope, new_value - value)
        if accepted is None:
            if not len(memory):
                return end("no step lowers the cost", converged=True)
            memory.forget()
            continue
        trial, moved, new_value, new_gradient = accepted
        memory.add(moved, new_gradient - gradient)
        decrease, x, value, gradient = value - new_value, trial, new_value, new_gradient
        iteration += 1
        if callback is not None:
            callback(x, value, evaluations)
        if decrease <= cost_tolerance * abs(value):
            return end(f"the last iteration lowered the cost by {decrease:.1e}", converged=True)


def require_vectors(start: Tensor, lower: Tensor) -> None:
    """Raise ValueError unless a start and its bounds have the same shape (n,)."""
    if start.ndim != 1 or start.shape != lower.shape:
        raise ValueError(
            f"start and lower have shapes {tuple(start.shape)} and {tuple(lower.shape)}: both must be (n,)"
        )


def require_finite(value: float) -> None:
    """Raise ValueError unless the cost at the start is finite."""
    if not math.isfinite(value):
        raise ValueError(f"the cost at the start is {value}: it must be finite")


def _shorter(slope: float, rise: float) -> float:
    """Return the factor on the step that minimises the parabola through value, slope and trial, within [0.1, 0.5]."""
    return min(max(0.5 * slope / (slope - rise), 0.1), 0.5) if rise < float("inf") else 0.1
