"""The memory of a limited-memory BFGS: the last steps, the gradient changes that they made, and what follows from them.

Which products of them are kept depends on the device. On a processor reading all pairs takes most of the time, so their
products are kept and updated. On a GPU launches take most of the time, so all products are made anew by one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import partial

import torch
from torch import Tensor

from torchmask.restoration.cuda_graphs import graphed

_CURVED = 2.2e-16  # a correction is kept if s . y exceeds this times y . y


class Corrections(ABC):
    """The last `size` pairs of steps s and gradient changes y, and the approximate Hessian B = theta - W M W^T.

    This is the compact form of Byrd, Nocedal & Schnabel, Math. Program. 63, 129 (1994), with W = [Y, theta S].
    """

    def __init__(self, size: int, like: Tensor) -> None:
        self._size = size
        self._pairs = like.new_zeros(2 * size, like.numel())  # the y, then the s
        self._count = 0
        self._theta = 1.0

    def add(self, step: Tensor, change: Tensor) -> None:
        """Add a pair, if its curvature is positive, and drop the oldest when there are too many.

        The step must have followed from `solve`: it is 0 in the variables that were not free there.
        """
        curvature, energy = torch.stack([step @ change, change @ change]).tolist()
        if curvature > _CURVED * energy:
            self._theta = energy / curvature
            self._keep(step, change)
            self._count = min(self._count + 1, self._size)

    def forget(self) -> None:
        """Drop all pairs, so that the approximate Hessian is the identity."""
        self._count = 0
        self._theta = 1.0

    def __len__(self) -> int:
        return self._count

    @abstractmethod
    def solve(self, gradient: Tensor, free: Tensor) -> Tensor:
        """Solve B d = gradient over the free variables, with d = 0 elsewhere (Byrd et al. 1995, eq. 5.11).

        `gradient` and the boolean `free` have shape (n,), and so has the result d.
        """

    @abstractmethod
    def _keep(self, step: Tensor, change: Tensor) -> None:
        """Keep a pair in place of the oldest one if there is no room."""


class UpdatedCorrections(Corrections):
    """Corrections whose products are updated by the latest pair and by the few variables that enter or leave a bound.

    They are for processors, where what changes in a step is little beside all pairs.
    """

    def __init__(self, size: int, like: Tensor) -> None:
        super().__init__(size, like)
        self._products = like.new_zeros(2 * size, 2 * size)  # of the pairs with each other
        self._free = torch.ones_like(like, dtype=torch.bool)
        self._free_products = torch.zeros_like(self._products)  # the same over the free variables only
        self._order: list[int] = []  # oldest first
        self._new: int | None = None  # pair whose products are not known yet

    def forget(self) -> None:
        super().forget()
        self._order.clear()

    def _keep(self, step: Tensor, change: Tensor) -> None:
        self._new = self._order.pop(0) if len(self._order) == self._size else len(self._order)
        self._order.append(self._new)
        self._pairs[self._new], self._pairs[self._size + self._new] = change, step

    def solve(self, gradient: Tensor, free: Tensor) -> Tensor:
        gradient, theta = gradient * free, self._theta
        if not self._order:
            self._free = free
            return gradient
        products = self._update(gradient, free)
        y = torch.tensor(self._order, device="cpu")
        w = torch.cat([y, y + self._size])
        scale = products.new_ones(len(w))
        scale[len(y) :] = theta
        sy = self._products[y[:, None] + self._size, y]
        older = sy.tril(-1)
        ss = self._products[y[:, None] + self._size, y + self._size]
        middle = torch.cat([torch.cat([-sy.diag().diag(), older.T], 1), torch.cat([older, theta * ss], 1)])
        middle = middle - self._free_products[w[:, None], w] * (scale[:, None] * scale) / theta
        weights = torch.zeros_like(products)
        weights[w] = scale * torch.linalg.solve(middle, scale * products[w])
        return (gradient + (weights @ self._pairs) * free / theta) / theta

    def _update(self, gradient: Tensor, free: Tensor) -> Tensor:
        """Update all products to the latest pair and to the variables now `free`, and return those with `gradient`.

        Reading all pairs takes most of the time, so they are read once for all products.
        """
        vectors, row = [gradient], self._new
        if row is not None:
            rows = [row, self._size + row]
            change, step = self._pairs[row], self._pairs[self._size + row]
            vectors += [change, step, change * self._free]
        products, *new = (self._pairs @ torch.stack(vectors).T).T
        if row is not None:
            change, step, free_change = new  # a step is 0 where variables were not free
            for table, found in ((self._products, change), (self._free_products, free_change)):
                found = torch.stack([found, step])
                table[rows], table[:, rows] = found, found.T
            self._new = None
        changed = (free != self._free).nonzero().flatten()
        if len(changed):
            entered = self._pairs[:, changed]
            sign = free[changed].to(gradient) * 2 - 1
            self._free_products += (entered * sign) @ entered.T
        self._free = free
        return products


class GraphedCorrections(Corrections):
    """Corrections whose products are all made anew for every solution, by operations that a CUDA graph can hold.

    Shapes never change and nothing is read on the host: pairs stand oldest first, and rows of zeros where there are
    none yet.
    """

    def __init__(self, size: int, like: Tensor) -> None:
        super().__init__(size, like)
        self._theta_there = like.new_ones(())
        self._solve = graphed(partial(_solve, self._pairs, self._theta_there), like.device)

    def forget(self) -> None:
        super().forget()
        self._pairs.zero_()
        self._theta_there.fill_(self._theta)

    def _keep(self, step: Tensor, change: Tensor) -> None:
        pairs = self._pairs.view(2, self._size, -1)
        pairs.copy_(torch.cat([pairs[:, 1:], torch.stack([change, step])[:, None]], 1))
        self._theta_there.fill_(self._theta)

    def solve(self, gradient: Tensor, free: Tensor) -> Tensor:
        return self._solve(gradient, free) if self._count else gradient * free


def _solve(pairs: Tensor, theta: Tensor, gradient: Tensor, free: Tensor) -> Tensor:
    """Solve B d = gradient as `Corrections.solve` does; `pairs` (2 size, n) has zeros where there is no pair."""
    gradient, size = gradient * free, len(pairs) // 2
    products, of_free = pairs @ pairs.T, pairs * free
    sy, ss = products[size:, :size], products[size:, size:]
    curvature, older = sy.diagonal(), sy.tril(-1)
    scale = torch.cat([torch.ones_like(curvature), theta.expand(size)])
    middle = torch.cat([torch.cat([-curvature.diag(), older.T], 1), torch.cat([older, theta * ss], 1)])
    middle = middle - (of_free @ of_free.T) * (scale[:, None] * scale) / theta
    missing = (curvature == 0).to(pairs)
    middle = middle + torch.cat([missing, missing]).diag()  # the identity, as zeros have no inverse
    weights = scale * torch.linalg.solve_ex(middle, scale * (pairs @ gradient)).result
    return (gradient + (weights @ pairs) * free / theta) / theta


def make_corrections(size: int, like: Tensor) -> Corrections:
    """Return the corrections of at most `size` pairs that are fastest where the vector `like` (n,) lies."""
    return (UpdatedCorrections if like.device.type == "cpu" else GraphedCorrections)(size, like)
