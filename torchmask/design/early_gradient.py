"""Values of a population whose gradient is computed together with them, and once only.

The graph of a chunk is gone when the next one begins: memory does not grow with the population, and stays in the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class EarlyGradient(torch.autograd.Function):
    """Values (B,) of centres (B, N, 2), its first argument, and their gradient, which the backward pass only scales."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        centers, gradient = inputs[0], output[1]
        ctx.mark_non_differentiable(gradient)
        ctx.save_for_backward(centers, gradient)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor | None, ...]:
        centers, gradient = ctx.saved_tensors
        slope = grad[0][:, None, None] * DifferentiatedOnce.apply(gradient, centers)
        return slope, *[None] * (len(ctx.needs_input_grad) - 1)


class DifferentiatedOnce(torch.autograd.Function):
    """A gradient that raises an error when it is differentiated, where torch would give zero Hessians silently."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, centers: Tensor) -> Tensor:
        return gradient.view_as(gradient)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, Tensor], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, Tensor]:
        raise RuntimeError("the criterion has a first derivative only: take differences of its gradient for a Hessian")


def vmap_population(
    function: type[EarlyGradient], in_dims: tuple[int | None, ...], centers: Tensor, *others: Any
) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
    """Apply `function` under `torch.func.vmap`: the mapped axis is one more axis of the population.

    The last of the other arguments says whether to differentiate. Raises ValueError unless only centres are mapped.
    """
    if in_dims[0] is None or in_dims[1:3] != (None, None):
        raise ValueError("torch.func.vmap over a criterion runs over the centres: the PSDs must be the same for all")
    rows = centers.movedim(in_dims[0], 0)
    differentiate = others[-1] or (rows.requires_grad and torch.is_grad_enabled())
    found = function.apply(rows.flatten(0, 1), *others[:-1], differentiate)
    value, gradient = (part.reshape(len(rows), -1, *part.shape[1:]) for part in found)
    return (value, gradient), (0, 0)


def by_chunks(function: Callable[[Tensor], Tensor], centers: Tensor, size: int) -> Tensor:
    """Return `function` (B,) of masks with `centers` (B, N, 2), `size` of them at a time, differentiable once.

    The function must know nothing else that is to be differentiated, and treat each mask by itself.
    """
    differentiate = centers.requires_grad and torch.is_grad_enabled()
    return _ByChunks.apply(centers, function, size, differentiate)[0]  # type: ignore[no-any-return]


class _ByChunks(EarlyGradient):
    """`by_chunks` and, if requested, its gradient."""

    @staticmethod
    def forward(
        centers: Tensor, function: Callable[[Tensor], Tensor], size: int, differentiate: bool
    ) -> tuple[Tensor, Tensor]:
        values, gradients = [], [centers.new_empty(0, *centers.shape[1:])]
        for chunk in centers.split(size):
            with torch.set_grad_enabled(differentiate):
                some = chunk.detach().requires_grad_(differentiate)
                value = function(some)
                if differentiate:
                    gradients.extend(torch.autograd.grad(value.sum(), some))
            values.append(value.detach())
        return torch.cat(values), torch.cat(gradients)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *arguments: Any) -> Any:
        return vmap_population(_ByChunks, in_dims, *arguments)
