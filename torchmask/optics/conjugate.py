"""Solution of linear systems that are known only by their action on a vector."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Operator = Callable[[Tensor], Tensor]


def conjugate_gradients(hessian: Operator, right: Tensor, precondition: Operator, n_iterations: int) -> Tensor:
    """Solve hessian(x) = right for every entry of the first axis by preconditioned conjugate gradients.

    `hessian` is a positive definite operator that acts on the entries independently. Entries of `right` that are zero
    give solutions that are zero. Source: Hestenes & Stiefel, J. Res. Natl. Bur. Stand. 49, 409, 1952.
    """
    axes, tiny = tuple(range(1, right.ndim)), torch.finfo(right.dtype).tiny

    def inner(a: Tensor, b: Tensor) -> Tensor:
        return (a * b).sum(axes, keepdim=True)

    x, residual = torch.zeros_like(right), right
    direction = scaled = precondition(residual)
    size = inner(residual, scaled)
    for _ in range(n_iterations):
        curved = hessian(direction)
        step = size / inner(direction, curved).clamp(min=tiny)  # the curvature is 0 where an entry is 0 or solved
        x, residual = x + step * direction, residual - step * curved
        scaled = precondition(residual)
        size, before = inner(residual, scaled), size
        direction = scaled + size / before.clamp(min=tiny) * direction
    return x
