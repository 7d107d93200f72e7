"""What a search minimises: the logarithm of MSE_a and what the rules add to it, over the free coordinates of a mask."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torchmask.design.feasibility import Constraint, Subspace, all_margins, project, with_centers
from torchmask.optics.aperture import SparseAperture


class Criterion(Protocol):
    """What a search needs of a criterion: the mean squared error of masks (...), absolute and relative.

    `AsymptoticMSE` is one. A criterion may also offer `on_grid(n_pixels)`, for searches that begin on a coarse grid.
    """

    def __call__(self, aperture: SparseAperture, /) -> Tensor: ...

    def relative(self, aperture: SparseAperture, /) -> Tensor: ...


class Holes:
    """The holes a search may move, the rules on them, and the coordinates it moves them by.

    Parameters
    ----------
    template : SparseAperture
        One mask, of which only the number and kind of holes, dtype and device count.
    constraints : sequence of Constraint
        All the rules, the mask disc and the overlap among them.

    Notes
    -----
    Coordinates x (..., F) and margins are in units of the mask diameter.
    """

    def __init__(self, template: SparseAperture, constraints: Sequence[Constraint]) -> None:
        self.template = template
        self.constraints = tuple(constraints)
        self.subspace = Subspace(template.n_subapertures, constraints, template.centers)

    def aperture(self, x: Tensor) -> SparseAperture:
        """The masks at x (..., F)."""
        return with_centers(self.template, self.subspace.centers(x * self.template.mask_diameter))

    def coordinates(self, centers: Tensor) -> Tensor:
        """The coordinates of the masks nearest to `centers` (..., N, 2) [m] that obey the equalities."""
        return self.subspace.coordinates(centers) / self.template.mask_diameter

    def margins(self, x: Tensor) -> Tensor:
        """Margins (..., M) of all inequalities."""
        return all_margins(self.aperture(x), self.constraints) / self.template.mask_diameter

    def place(self, x: Tensor, hole: int, position: Tensor) -> Tensor:
        """x with one hole moved to `position` (..., 2), as far as it may, and all that is tied to it."""
        scale = self.template.mask_diameter
        return self.subspace.place(x * scale, hole, position * scale) / scale

    def random(self, n: int, generator: torch.Generator) -> Tensor:
        """Coordinates (n, F) of masks whose holes are thrown into the disc, whether they overlap or not."""
        x = self.coordinates(self.template.centers).expand(n, -1)
        for hole in range(self.template.n_subapertures):
            x = self.place(x, hole, self.random_positions(n, generator).to(x))
        return x

    def random_positions(self, n: int, generator: torch.Generator) -> Tensor:
        """n centres (n, 2), uniform over the disc that centres may lie in, in mask diameters."""
        radius = (1 - self.template.subaperture_diameter / self.template.mask_diameter) / 2
        u = torch.rand(n, 2, generator=generator, dtype=torch.float64)
        angle = 2 * torch.pi * u[:, 1]
        return radius * u[:, :1].sqrt() * torch.stack([angle.cos(), angle.sin()], dim=-1)

    def feasible(self, x: Tensor) -> SparseAperture:
        """The mask nearest to x (F,) that obeys all rules, to rounding. Raises `Infeasible` if none is found."""
        return project(self.aperture(x), self.constraints)


class Evaluation(NamedTuple):
    """Of P masks: merit (P,), its gradient (P, F), relative MSE (P,) and margins (P, M)."""

    merit: Tensor
    gradient: Tensor
    relative_mse: Tensor
    margins: Tensor


class Merit:
    """log(relative MSE) + augmented Lagrangian of the margins g: sum(relu(multiplier - w g)^2 - multiplier^2) / (2 w).

    Without multipliers this is the quadratic penalty (w / 2) sum(relu(-g)^2). The logarithm makes one weight fit every
    problem. `evaluations` counts the masks whose MSE was computed, with or without gradient.
    Source: Nocedal & Wright, Numerical Optimization, section 17.3.
    """

    def __init__(self, criterion: Criterion, holes: Holes, weight: float) -> None:
        self.criterion, self.holes, self.weight = criterion, holes, weight
        self.evaluations = 0

    def __call__(self, x: Tensor, multipliers: Tensor | float = 0.0) -> Evaluation:
        """At x (P, F), with multipliers (P, M)."""
        x = x.detach().requires_grad_()
        relative = self.criterion.relative(self.holes.aperture(x))
        margins = self.holes.margins(x)
        multipliers = torch.as_tensor(multipliers).to(margins)
        excess = (multipliers - self.weight * margins).clamp(min=0) ** 2 - multipliers**2
        merit = relative.log() + excess.sum(-1) / (2 * self.weight)
        (gradient,) = torch.autograd.grad(merit.sum(), x)
        self.evaluations += len(x)
        return Evaluation(merit.detach(), gradient, relative.detach(), margins.detach())

    def value(self, x: Tensor) -> Tensor:
        """The merit alone (P,), without multipliers."""
        with torch.no_grad():
            shortfall = self.holes.margins(x).clamp(max=0)
            self.evaluations += len(x)
            return self.criterion.relative(self.holes.aperture(x)).log() + self.weight / 2 * (shortfall**2).sum(-1)
