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

    This is the compact form of Byrd, Nocedal & Schnabel, Math. Program. 63, 129 (1994), with W = [Y, theta S]. Its
    solution over the free variables (Byrd, Lu, Nocedal & Zhu, SIAM J. Sci. Comput. 16, 1190, 1995, eq. 5.11) needs no
    theta but in two places, once theta S is written as S: d = (g + [Y, S] X^-1 [Y, S]^T g) / theta, where

        X = [-theta D, R; R^T, S^T S] - the products of [Y, S] with itself over the free variables,

    D and R are the diagonal and what stands above it of Y^T S.
    """

    def __init__(self, size: int, like: Tensor, dtype: torch.dtype) -> None:
        self._size = size
        self._pairs = like.new_zeros(2 * size, like.numel(), dtype=dtype)  # the y, then the s
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
        """Solve B d = gradient over the free variables, with d = 0 elsewhere.

        `gradient` and the boolean `free` have shape (n,), and so has the result d.
        """

    @abstractmethod
    def _keep(self, step: Tensor, change: Tensor) -> None:
        """Keep a pair in place of the oldest one if there is no room."""


class UpdatedCorrections(Corrections):
    """Corrections whose products are updated by the latest pair and by the few variables that enter or leave a bound.

    They are for processors, where what changes in a step is little beside all pairs, and reading these takes most of
    the time. Therefore pairs are kept in `dtype`, which may be shorter than that of the vectors.
    """

    def __init__(self, size: int, like: Tensor, dtype: torch.dtype) -> None:
        super().__init__(size, like, dtype)
        self._steps = like.new_zeros(2, size, size)  # products of the pairs, y and s, with the steps
        self._free_products = like.new_zeros(2, size, 2, size)  # with each other, over the free variables only
        self._newer = like.new_zeros(size, size)  # whether the pair in each column is newer than that in each row
        self._free = torch.ones_like(like, dtype=torch.bool)
        self._next = 0  # place of the next pair
        self._new: int | None = None  # place of the pair whose products are not known yet

    def forget(self) -> None:
        super().forget()
        self._next, self._new = 0, None

    def _keep(self, step: Tensor, change: Tensor) -> None:
        self._new, self._next = self._next, (self._next + 1) % self._size
        self._pairs[self._new], self._pairs[self._size + self._new] = change, step
        self._newer[:, self._new], self._newer[self._new] = 1, 0

    def solve(self, gradient: Tensor, free: Tensor) -> Tensor:
        gradient, n = gradient * free, self._count
        if not n:
            self._free = free
            return gradient
        products = self._update(gradient, free)
        ys, ss = self._steps[:, :n, :n]
        older = ys * self._newer[:n, :n]
        middle = -self._free_products[:, :n, :, :n].reshape(2 * n, 2 * n)
        middle[:n, :n].diagonal().sub_(self._theta * ys.diagonal())
        middle[:n, n:] += older
        middle[n:, :n] += older.T
        middle[n:, n:] += ss
        weights = torch.zeros_like(products)
        weights[:, :n] = torch.linalg.solve_ex(middle, products[:, :n].flatten()).result.view(2, n)
        return (gradient + (weights.flatten().to(self._pairs) @ self._pairs) * free) / self._theta

    def _update(self, gradient: Tensor, free: Tensor) -> Tensor:
        """Update all products to the latest pair and to the variables now `free`, and return those with `gradient`.

        The result (2, size) holds the products of the y and of the s. Reading all pairs takes most of the time, so they
        are read once for all products.
        """
        vectors, place = [gradient.to(self._pairs)], self._new
        if place is not None:
            vectors += [self._pairs[self._size + place], self._pairs[place] * self._free]
        products, *new = (torch.stack(vectors) @ self._pairs.T).to(gradient).unflatten(1, (2, self._size))
        if place is not None:
            step, free_change = new
            self._steps[:, :, place], self._steps[1, place] = step, step[1]
            for which, found in enumerate((free_change, step)):  # a step is 0 where variables were not free
                self._free_products[which, place], self._free_products[:, :, which, place] = found, found
            self._new = None
        changed = (free != self._free).nonzero().flatten()
        if len(changed):
            entered = self._pairs[:, changed]
            sign = free[changed].to(entered) * 2 - 1
            self._free_products += ((entered * sign) @ entered.T).view_as(self._free_products)
        self._free = free
        return products


class GraphedCorrections(Corrections):
    """Corrections whose products are all made anew for every solution, by operations that a CUDA graph can hold.

    Shapes never change and nothing is read on the host: pairs stand oldest first, and rows of zeros where there are
    none yet.
    """

    def __init__(self, size: int, like: Tensor) -> None:
        super().__init__(size, like, like.dtype)
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
    middle = torch.cat([torch.cat([-theta * curvature.diag(), older.T], 1), torch.cat([older, ss], 1)])
    missing = (curvature == 0).to(pairs)  # the identity, as zeros have no inverse
    middle = middle - of_free @ of_free.T + torch.cat([missing, missing]).diag()
    weights = torch.linalg.solve_ex(middle, pairs @ gradient).result
    return (gradient + (weights @ pairs) * free) / theta


def make_corrections(size: int, like: Tensor) -> Corrections:
    """Return the corrections of at most `size` pairs that are fastest where the vector `like` (n,) lies."""
    if like.device.type != "cpu":
        return GraphedCorrections(size, like)
    return UpdatedCorrections(size, like, torch.float32)  # descents are as fast by it as by pairs in float64
