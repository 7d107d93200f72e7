"""The function that a search minimises: log MSE_a and terms for the constraints, over a mask's free coordinates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from torchmask.design.constraint_base import (
    Constraint,
    Inequality,
    LinearEquality,
    Subspace,
    all_margins,
    project,
)
from torchmask.optics.aperture import SparseAperture


class Criterion(Protocol):
    """Interface of a criterion for a search: the mean squared error of masks (...), absolute and relative.

    `AsymptoticMSE` is one. A criterion may also have `on_grid(n_pixels)`, for searches that begin on a coarse grid.
    """

    def __call__(self, aperture: SparseAperture, /) -> Tensor: ...

    def relative(self, aperture: SparseAperture, /) -> Tensor: ...


@dataclass(frozen=True)
class OnDevice:
    """A criterion on another device for masks on the processor, where a search does its many small steps.

    Masks go to `device`, values and gradients come back.
    """

    criterion: Criterion
    device: torch.device

    def __call__(self, aperture: SparseAperture) -> Tensor:
        return self.criterion(self._sent(aperture)).to(aperture.centers.device)

    def relative(self, aperture: SparseAperture) -> Tensor:
        """Return the relative error of masks (...)."""
        return self.criterion.relative(self._sent(aperture)).to(aperture.centers.device)

    def _sent(self, aperture: SparseAperture) -> SparseAperture:
        return aperture.replace(centers=aperture.centers.to(self.device))


def device_of(criterion: Criterion) -> torch.device:
    """Return the device of a criterion's buffers; the processor for one that has none."""
    buffers = criterion.buffers() if isinstance(criterion, nn.Module) else iter(())
    return next((buffer.device for buffer in buffers), torch.device("cpu"))


def for_processor(criterion: Criterion) -> Criterion:
    """Return a criterion that takes masks on the processor, wherever `criterion` itself is."""
    device = device_of(criterion)
    return criterion if device.type == "cpu" else OnDevice(criterion, device)


class Holes:
    """The holes that a search moves, the constraints on them, and their free coordinates.

    Parameters
    ----------
    template : SparseAperture
        One mask, of which only the number and kind of holes, dtype and device are used.
    constraints : sequence of Constraint
        All constraints, including those on the mask disc and on overlaps.

    Notes
    -----
    Coordinates x (..., F) and margins are in units of the mask diameter. The plane of x is mapped onto the disc of
    allowed centres by |centre| = R sin(|x| / R). So no centre can leave the disc, and a hole that is attracted to the
    rim, as in most good masks, has a smooth minimum there instead of a boundary.
    """

    def __init__(self, template: SparseAperture, constraints: Sequence[Constraint]) -> None:
        self.template = template
        self.constraints: tuple[Constraint, ...] = tuple(constraints)
        size = template.subaperture_diameter, template.mask_diameter
        self.radius: float = template.shape.center_radius(*size) / template.mask_diameter
        self.subspace: Subspace = Subspace(template.n_subapertures, constraints, template.centers)
        pinned = self.subspace.origin.unflatten(-1, (-1, 2)) / template.mask_diameter
        self.subspace.origin = self._unroll(pinned, 1.0).flatten(-2)

    def _unroll(self, centers: Tensor, largest: float) -> Tensor:
        """Invert the mapping onto the disc; radii are limited to `largest` of the disc's, where its slope vanishes."""
        length = torch.linalg.vector_norm(centers, dim=-1, keepdim=True) / self.radius
        sine = length.clamp(max=largest)
        return centers * torch.where(length > 0, sine.asin() / length, 1.0)

    def aperture(self, x: Tensor) -> SparseAperture:
        """Return the masks at x (..., F)."""
        plane = self.subspace.centers(x)
        squared = (plane**2).sum(-1, keepdim=True)
        length = torch.where(squared > 0, squared, 1.0).sqrt() * (squared > 0)
        centers = plane * torch.sinc(length / (torch.pi * self.radius))
        return self.template.replace(centers=centers * self.template.mask_diameter)

    def coordinates(self, centers: Tensor) -> Tensor:
        """Return the coordinates of masks near `centers` (..., N, 2) [m] in the subspace, at least 1e-3 off the rim."""
        return self.subspace.coordinates(self._unroll(centers / self.template.mask_diameter, 0.999))

    def margins(self, aperture: SparseAperture) -> Tensor:
        """Return the margins (..., M) of all inequalities."""
        return all_margins(aperture, self.constraints) / self.template.mask_diameter

    def place(self, x: Tensor, hole: int, position: Tensor) -> Tensor:
        """Return x (..., F) with one hole, and those tied to it, moved to `position` (..., 2) [mask diameters]."""
        return self.subspace.place(x, hole, self._unroll(position.to(x), 1.0))

    def turned(self, x: Tensor, angle: Tensor, over: Tensor) -> Tensor:
        """Return masks (T, F): x (F,), mirrored left to right where `over` (T,), then turned by `angle` (T,) [rad]."""
        return self.coordinates(_turned(self.aperture(x).centers, angle.to(x), over))

    @cached_property
    def orientation_matters(self) -> bool:
        """Whether a mask may be turned, and some inequality changes when it is, as those on vanes do."""
        may_turn = all(self._is_alike(rule) for rule in self.constraints if isinstance(rule, LinearEquality))
        return may_turn and len(self.free_to_turn.constraints) < len(self.constraints)

    @cached_property
    def may_be_mirrored(self) -> bool:
        """Whether the equalities also hold for the mirrored mask; those of a symmetry order the holes one way round."""
        return all(self._is_alike(rule, over=True) for rule in self.constraints if isinstance(rule, LinearEquality))

    @cached_property
    def free_to_turn(self) -> Holes:
        """The same holes without the constraints that are not alike all around."""
        return Holes(self.template, [rule for rule in self.constraints if self._is_alike(rule)])

    def _is_alike(self, rule: Constraint, *, over: bool = False) -> bool:
        """Return whether a rule takes a mask for the same one turned, and before that mirrored if `over`."""
        mask = self.aperture(0.3 * self.subspace.spread())
        values = rule.margins if isinstance(rule, Inequality) else rule.residuals
        turned = _turned(mask.centers, mask.centers.new_ones(1), mask.centers.new_tensor([over], dtype=torch.bool))[0]
        change = values(mask.replace(centers=turned)) - values(mask)
        return not bool((change.abs() > 1e-5 * mask.mask_diameter).any())

    def feasible(self, x: Tensor, tick: Callable[[], None] | None = None) -> SparseAperture:
        """Return the mask nearest to x (F,) that satisfies all constraints; for `tick` see `project`.

        Raises `Infeasible` if none is found.
        """
        return project(self.aperture(x.detach()), self.constraints, tick)


def _turned(centers: Tensor, angle: Tensor, over: Tensor) -> Tensor:
    """Return the centres (T, N, 2) of a mask (N, 2), mirrored and turned as by `Holes.turned`."""
    cosine, sine, sign = angle.cos(), angle.sin(), 1 - 2 * over.to(angle)
    rows = torch.stack([sign * cosine, sign * sine, -sine, cosine], dim=-1)
    return centers @ rows.unflatten(-1, (2, 2))


class Evaluation(NamedTuple):
    """Merit (P,), its gradient (P, F), relative MSE (P,) and margins (P, M) of P masks."""

    merit: Tensor
    gradient: Tensor
    relative_mse: Tensor
    margins: Tensor


class Merit:
    """log(relative MSE) + augmented Lagrangian of the margins g: sum(relu(multiplier - w g)^2 - multiplier^2) / (2 w).

    Without multipliers this is the quadratic penalty (w / 2) sum(relu(-g)^2). With the logarithm, one weight suits all
    problems. `evaluations` counts the masks whose MSE was computed, with or without gradient.
    Source: Nocedal & Wright, Numerical Optimization, section 17.3.
    """

    criterion: Criterion
    holes: Holes
    weight: float
    evaluations: int

    def __init__(self, criterion: Criterion, holes: Holes, weight: float) -> None:
        self.criterion, self.holes, self.weight = criterion, holes, weight
        self.evaluations = 0

    def __call__(self, x: Tensor, multipliers: Tensor | float = 0.0) -> Evaluation:
        """Evaluate masks at x (P, F), with multipliers (P, M)."""
        x = x.detach().requires_grad_()
        aperture = self.holes.aperture(x)
        relative, margins = self.criterion.relative(aperture), self.holes.margins(aperture)
        excess = (multipliers - self.weight * margins).clamp(min=0) ** 2 - multipliers**2
        merit = relative.log() + excess.sum(-1) / (2 * self.weight)
        (gradient,) = torch.autograd.grad(merit.sum(), x)
        self.evaluations += len(x)
        return Evaluation(merit.detach(), gradient, relative.detach(), margins.detach())

    def value(self, x: Tensor) -> Tensor:
        """Return the merit (P,) without multipliers."""
        with torch.no_grad():
            aperture = self.holes.aperture(x)
            self.evaluations += len(x)
            return self.penalised(self.criterion.relative(aperture), aperture)

    def require_value(self, found: bool) -> None:
        """Raise ValueError unless a mask was `found` whose merit is a finite number."""
        if not found:
            raise ValueError(
                f"the criterion's relative error has no finite logarithm at any of {self.evaluations} masks: it must "
                "be finite and positive, so look for what makes it NaN, infinite or 0"
            )

    def penalised(self, relative_mse: Tensor, aperture: SparseAperture) -> Tensor:
        """Return the merit (P,) without multipliers of P masks whose relative MSE (P,) is known."""
        shortfall = self.holes.margins(aperture).clamp(max=0)
        return relative_mse.log() + self.weight / 2 * (shortfall**2).sum(-1)
