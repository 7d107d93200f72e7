"""Optimisers of `torch.optim` as minimisers with bounds, for comparison or as a basis for your own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.restoration.projected_lbfgs import AfterIteration, Cost, Minimum, require_finite, require_vectors

OptimizerFactory = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


@dataclass(frozen=True)
class TorchMinimizer:
    """An optimiser of `torch.optim` whose steps are projected onto the bounds.

    Parameters
    ----------
    factory : callable
        Function that returns an optimiser for given parameters, such as `partial(torch.optim.Adam, lr=0.1)`. Variables
        are scaled so that the diagonal of the Hessian is about 1. Every descent has a new optimiser.
    steps : int
        Number of steps of the optimiser in one iteration of the restoration.

    Raises
    ------
    TypeError
        If `factory` does not return an optimiser.
    ValueError
        If `steps` is below 1.

    Examples
    --------
    >>> from functools import partial
    >>> target = torch.tensor([1.0, -2.0], dtype=torch.float64)
    >>> def cost(x): return float(((x - target) ** 2).sum()), 2 * (x - target)
    >>> minimizer = TorchMinimizer(partial(torch.optim.SGD, lr=0.5))
    >>> minimizer(cost, torch.zeros(2).double(), torch.zeros(2).double(), max_iterations=3).x
    tensor([1., 0.], dtype=torch.float64)
    """

    factory: OptimizerFactory
    steps: int = 1

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise ValueError(f"steps is {self.steps}: it must be at least 1")
        made = self.factory([torch.zeros(1, device="cpu")])
        if not isinstance(made, torch.optim.Optimizer):
            raise TypeError(f"factory returns a {type(made).__name__}: it must return an optimiser of torch.optim")

    def __call__(
        self, cost: Cost, start: Tensor, lower: Tensor, *, max_iterations: int, callback: AfterIteration | None = None
    ) -> Minimum:
        """Minimise `cost` by `max_iterations` times `steps` steps, and return the best point that was evaluated.

        Raises ValueError if the shapes differ or the cost is not finite at the start.
        """
        require_vectors(start, lower)
        x = torch.maximum(start, lower).requires_grad_()
        optimizer = self.factory([x])
        best, least, evaluations = x.detach().clone(), float("inf"), 0

        def closure() -> float:
            nonlocal best, least, evaluations
            point = torch.maximum(x.detach(), lower)  # a step with several evaluations may leave the bounds in between
            value, gradient = cost(point)
            x.grad = gradient * (x.detach() >= lower)
            if not evaluations:
                require_finite(value)
            evaluations += 1
            if value < least:
                best, least = point, value
            return value

        for _ in range(max_iterations):
            for _ in range(self.steps):
                optimizer.step(closure)  # type: ignore[arg-type]
                with torch.no_grad():
                    x.clamp_(min=lower)
            if callback is not None:
                callback(best, least, evaluations)
        closure()  # the last point may be the best
        message = f"{max_iterations} iterations of {self.steps} steps"
        return Minimum(best, least, max_iterations, evaluations, False, message)
