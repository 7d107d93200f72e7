"""Optimisers of `torch.optim` as minimisers with bounds, to compare with or to build on."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import torch
from torch import Tensor

from torchmask.restoration.projected_lbfgs import AfterIteration, Cost, Minimum, require_finite, require_vectors

OptimizerFactory = Callable[[Iterable[Tensor]], torch.optim.Optimizer]


@dataclass(frozen=True)
class TorchMinimizer:
    """Any optimiser of `torch.optim`, each step of which is projected on the bounds.

    Parameters
    ----------
    factory : callable
        Makes an optimiser of the parameters it is given, such as `partial(torch.optim.Adam, lr=0.1)`. Variables are
        scaled such that the diagonal of the Hessian is about 1. Every descent has a fresh optimiser.
    steps : int
        Of the optimiser, which make one iteration of the restoration.

    Raises
    ------
    TypeError
        If `factory` makes something else.
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
        made = self.factory([torch.zeros(1)])
        if not isinstance(made, torch.optim.Optimizer):
            raise TypeError(f"factory makes a {type(made).__name__}: it must make an optimiser of torch.optim")

    def __call__(
        self, cost: Cost, start: Tensor, lower: Tensor, *, max_iterations: int, callback: AfterIteration | None = None
    ) -> Minimum:
        """Lower `cost` by `max_iterations` times `steps` steps; the best point that was evaluated comes back.

        Raises ValueError if the shapes differ or the cost is not finite at the start.
        """
        require_vectors(start, lower)
        x = torch.maximum(start, lower).requires_grad_()
        optimizer = self.factory([x])
        best, least, evaluations = x.detach().clone(), float("inf"), 0

        def closure() -> float:
            nonlocal best, least, evaluations
            point = torch.maximum(x.detach(), lower)  # a step of several evaluations leaves the bounds on its way
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
