"""Quasi-Newton descents of many masks at once, in which every evaluation is one batched call."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

Function = Callable[[Tensor], Tensor]

_ARMIJO = 1e-4  # share of the predicted decrease that a step must achieve
_SHORTEST = 1e-10  # fraction of a full step below which a descent ends


class BatchedBFGS:
    """BFGS with a backtracking line search on P independent problems of F variables, by ask and tell.

    Each round evaluates one point per problem: `ask()` returns the points (P, F), and `tell(values, gradients)` takes
    the results. A problem whose step was good enough gets a new direction; one whose step was too long shortens it.
    `finished` (P,) marks converged problems, which `restart` starts again from another point.

    Parameters
    ----------
    start : (P, F) tensor
        First point of each problem.
    first_step : float
        Length of the first step of a descent and upper limit of all others, in the units of the variables.
    tolerance : float
        Predicted decrease of the next step below which a descent ends, in the units of the function.
    patience : int
        Largest number of accepted steps of a descent.

    Notes
    -----
    The full inverse Hessian approximation is kept: with 2N variables it costs less than a history of pairs. The first
    update scales it (Nocedal & Wright, Numerical Optimization, eq. 6.20); pairs without positive curvature are skipped.
    """

    first_step: float
    tolerance: float
    patience: int
    finished: Tensor

    def __init__(self, start: Tensor, first_step: float, tolerance: float, patience: int = 1000) -> None:
        self.first_step, self.tolerance, self.patience = first_step, tolerance, patience
        n, size = start.shape
        self.points: Tensor = start.clone()
        self.values: Tensor = start.new_full((n,), torch.inf)
        self.gradients: Tensor = torch.zeros_like(start)
        self.finished = torch.zeros(n, dtype=torch.bool, device=start.device)
        self._identity = torch.eye(size, dtype=start.dtype, device=start.device)
        self._inverse = self._identity.repeat(n, 1, 1)
        self._direction = torch.zeros_like(start)
        self._slope = start.new_zeros(n)
        self._step = start.new_ones(n)
        self._accepted = start.new_zeros(n, dtype=torch.long)

    def restart(self, members: Tensor | slice, points: Tensor) -> None:
        """Restart the problems `members` (indices, mask or slice) from `points`."""
        self.points[members] = points
        self.values[members] = torch.inf
        self._direction[members] = 0.0
        self._step[members] = 1.0
        self._inverse[members] = self._identity
        self._accepted[members] = 0
        self.finished[members] = False

    def ask(self) -> Tensor:
        """Return the points to evaluate (P, F); those of finished problems no longer change."""
        return self.points + (self._step * ~self.finished)[:, None] * self._direction

    def tell(self, values: Tensor, gradients: Tensor) -> None:
        """Take values (P,) and gradients (P, F) at the points of the latest `ask`."""
        good = torch.isfinite(values) & torch.isfinite(gradients).all(-1)
        good &= ~self.finished & ((values <= self.values + _ARMIJO * self._step * self._slope) | self.values.isinf())
        if bool(good.any()):
            self._accept(good, values, gradients)
        shorter = ~good & ~self.finished
        # The minimum of the parabola through both values and the slope, limited to 0.1 to 0.5 of the step.
        rise = values - self.values - self._step * self._slope
        step = -0.5 * self._slope * self._step**2 / rise
        step = torch.where(torch.isfinite(step), step, 0.1 * self._step)
        step = torch.minimum(torch.maximum(step, 0.1 * self._step), 0.5 * self._step)
        self._step = torch.where(shorter, step, self._step)
        self.finished |= shorter & (self._step < _SHORTEST)

    def _accept(self, good: Tensor, values: Tensor, gradients: Tensor) -> None:
        moved = self._step[good, None] * self._direction[good]
        change = gradients[good] - self.gradients[good]
        inverse = _updated(self._inverse[good], moved, change, self._accepted[good] == 1)
        self.points[good] += moved
        self.values[good], self.gradients[good] = values[good], gradients[good]
        direction = -(inverse @ gradients[good, :, None])[..., 0]
        slope = (direction * gradients[good]).sum(-1)
        # No step is longer than the first one, whose length is prescribed because there is no curvature yet.
        length = torch.linalg.vector_norm(direction, dim=-1).clamp(min=torch.finfo(direction.dtype).tiny)
        first = self._accepted[good] == 0
        scale = torch.where(first, self.first_step / length, (self.first_step / length).clamp(max=1))
        self._inverse[good], self._direction[good], self._slope[good] = inverse, direction, slope
        self._step[good] = scale
        self._accepted[good] += 1
        self.finished[good] = (-slope * scale < self.tolerance) | (self._accepted[good] > self.patience)


def _updated(inverse: Tensor, s: Tensor, y: Tensor, first: Tensor) -> Tensor:
    """Apply the BFGS update to inverse Hessians (P, F, F) for steps s and gradient changes y (P, F)."""
    sy, yy = (s * y).sum(-1), (y * y).sum(-1)
    curved = sy > 1e-10 * torch.sqrt((s * s).sum(-1) * yy)
    rho = torch.where(curved, 1 / sy, 0)
    gamma = torch.where(first & curved, sy / yy, 1)
    inverse = inverse * gamma[:, None, None]
    hy = (inverse @ y[..., None])[..., 0]
    factor = rho + rho**2 * (y * hy).sum(-1)
    cross = (rho[:, None, None] * hy[..., None]) * s[:, None, :]
    return inverse - cross - cross.mT + factor[:, None, None] * (s[..., None] * s[:, None, :])
