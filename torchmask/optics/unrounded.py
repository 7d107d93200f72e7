"""Products that `torch.autocast` does not round to half precision."""

from __future__ import annotations

import torch
from torch import Tensor


def product(left: Tensor, right: Tensor) -> Tensor:
    """Return the matrix product in the dtype of `left`, see `unrounded`.

    Examples
    --------
    >>> with torch.autocast("cpu", dtype=torch.bfloat16):
    ...     product(torch.tensor([[1.001]]), torch.tensor([[3.0]]))
    tensor([[3.0030]])
    """
    first, second = unrounded(left, right)
    return (first @ second).to(left.dtype)


def unrounded(*factors: Tensor) -> tuple[Tensor, ...]:
    """Return the factors of a matrix product as float64 where autocast is on, and as they are otherwise.

    Autocast would multiply in half precision, in which a phase of 10 rad is known to 0.03 rad. It leaves float64 alone,
    also in a backward pass within it, which switching it off for the product alone would not shelter. The caller
    converts the product back.

    Examples
    --------
    >>> unrounded(torch.ones(2, 2))[0].dtype
    torch.float32
    >>> with torch.autocast("cpu", dtype=torch.bfloat16):
    ...     unrounded(torch.ones(2, 2))[0].dtype
    torch.float64
    """
    device = factors[0].device.type
    rounds = torch.amp.is_autocast_available(device) and torch.is_autocast_enabled(device)
    return tuple(factor.double() for factor in factors) if rounds else factors
