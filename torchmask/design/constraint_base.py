"""Base classes of constraints on the positions of holes, the subspace of linear ones, and projection onto all of them.

An inequality is a set of margins, signed clearances in metres that are at least 0 where it holds. An equality is linear
in the centres, so a search moves in the remaining subspace and satisfies it at every step. All functions take an
aperture whose `centers` (..., N, 2) may have leading population axes, and follow its dtype, device and gradient.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from torchmask.optics.aperture import SparseAperture

Array = np.ndarray


class Infeasible(ValueError):
    """No mask satisfies the constraints, or none was found."""


class Constraint(ABC):
    """A constraint on the positions of the holes."""

    @abstractmethod
    def residuals(self, aperture: SparseAperture) -> Tensor:
        """Return the shortfalls (..., M) [m], 0 where the constraint holds."""

    def penalty(self, aperture: SparseAperture) -> Tensor:
        """Return the sum of the squared shortfalls (...) [m^2], smooth and 0 exactly where the constraint holds."""
        return (self.residuals(aperture) ** 2).sum(-1)

    def violation(self, aperture: SparseAperture) -> Tensor:
        """Return the largest shortfall (...) [m]."""
        shortfalls = self.residuals(aperture).detach().abs()
        return shortfalls.amax(-1) if shortfalls.shape[-1] else shortfalls.sum(-1)

    def project(self, aperture: SparseAperture) -> SparseAperture:
        """Return the mask nearest to `aperture` that satisfies it. Raises `Infeasible` if none is found."""
        return project(aperture, [self])


class Inequality(Constraint):
    """A constraint `margins >= 0`.

    length : name of the dataclass field [m] that sets how strict the constraint is, so that a search that finds no
        room can say which value would fit; None if there is none
    """

    length: ClassVar[str | None] = None

    @abstractmethod
    def margins(self, aperture: SparseAperture) -> Tensor:
        """Return the signed clearances (..., M) [m]."""

    def checked_margins(self, aperture: SparseAperture) -> Tensor:
        """Return the margins (..., M) [m]; raises ValueError unless they are numbers, in a row for each mask."""
        margins, leading = self.margins(aperture), aperture.centers.shape[:-2]
        if not isinstance(margins, Tensor):
            raise TypeError(f"margins of {self} are of type {type(margins).__name__}: a tensor is needed")
        if margins.shape[:-1] != leading or margins.ndim == 0 or not margins.is_floating_point():
            raise ValueError(
                f"margins of {self} have shape {tuple(margins.shape)} and dtype {margins.dtype} for centers of shape "
                f"{tuple(aperture.centers.shape)}: floating-point numbers [m] of shape {(*leading, 'M')} are needed"
            )
        return margins

    def residuals(self, aperture: SparseAperture) -> Tensor:
        return (-self.checked_margins(aperture)).clamp(min=0)


class LinearEquality(Constraint):
    """A constraint `matrix @ centers.flatten() = values`, which fixes holes or relates them by rotations.

    Searches stretch the disc radially, which must leave such constraints satisfied.
    """

    @abstractmethod
    def equations(self, n_subapertures: int) -> tuple[Array, Array]:
        """Return matrix (M, 2N) and values (M) [m] for the flattened centres x_0, y_0, x_1, ..."""

    def residuals(self, aperture: SparseAperture) -> Tensor:
        matrix, values = (
            torch.as_tensor(part, device="cpu").to(aperture.centers) for part in self.equations(aperture.n_subapertures)
        )
        return aperture.centers.flatten(-2) @ matrix.T - values


class Subspace:
    """The masks of N holes that satisfy all linear equalities: centers = origin + basis z, z (..., F) [m].

    The columns of `basis` are orthonormal, so lengths in z are lengths in the flattened centres.

    Raises
    ------
    Infeasible
        If the equalities contradict each other.
    """

    def __init__(self, n_subapertures: int, constraints: Sequence[Constraint] = (), like: Tensor | None = None) -> None:
        size = 2 * n_subapertures
        equations = [c.equations(n_subapertures) for c in constraints if isinstance(c, LinearEquality)]
        matrix = np.concatenate([np.zeros((0, size)), *(m for m, _ in equations)])
        values = np.concatenate([np.zeros(0), *(v for _, v in equations)])
        left, singular, right = np.linalg.svd(matrix)
        rank = int((singular > 1e-9).sum())
        origin = right[:rank].T @ ((left[:, :rank].T @ values) / singular[:rank])
        if np.abs(matrix @ origin - values).max(initial=0.0) > 1e-12 * max(1.0, np.abs(values).max(initial=0.0)):
            names = " and ".join(str(c) for c in constraints if isinstance(c, LinearEquality))
            raise Infeasible(f"no mask of {n_subapertures} holes obeys {names} together: leave one out")
        like = torch.zeros((), dtype=torch.float64, device="cpu") if like is None else like
        self.origin: Tensor = torch.from_numpy(origin).to(like)
        self.basis: Tensor = torch.from_numpy(right[rank:].T.copy()).to(like)
        # The change of z that moves one hole by a given step, with the smallest change elsewhere.
        rows = right[rank:].T.reshape(n_subapertures, 2, -1)
        self.lift: Tensor = torch.from_numpy(np.linalg.pinv(rows, rcond=1e-9)).to(like)  # (N, F, 2)

    @property
    def size(self) -> int:
        """Number of free coordinates, F."""
        return self.basis.shape[1]

    def centers(self, z: Tensor) -> Tensor:
        """Return the centres (..., N, 2) at coordinates (..., F)."""
        return (self.origin + z @ self.basis.T).unflatten(-1, (-1, 2))

    def coordinates(self, centers: Tensor) -> Tensor:
        """Return the coordinates (..., F) of the point of the subspace that is nearest to centres (..., N, 2)."""
        return (centers.flatten(-2) - self.origin) @ self.basis

    def spread(self) -> Tensor:
        """Return a step (F,) that moves every hole in its own direction (by the golden angle), within the subspace."""
        holes = torch.arange(len(self.lift), dtype=self.basis.dtype, device=self.basis.device)
        angles = math.pi * (3 - math.sqrt(5)) * holes
        return torch.stack([angles.cos(), angles.sin()], dim=-1).flatten() @ self.basis

    def place(self, z: Tensor, hole: int, position: Tensor) -> Tensor:
        """Move one hole to `position` (..., 2), or as near as the equalities allow, with the holes tied to it."""
        return z + (position - self.centers(z)[..., hole, :]) @ self.lift[hole].T


def require_constraints(constraints: Sequence[Constraint]) -> None:
    """Raise TypeError unless `constraints` is a sequence of constraints."""
    given = constraints if isinstance(constraints, Sequence) else [constraints]
    if given is not constraints or not all(isinstance(rule, Constraint) for rule in given):
        raise TypeError(f"constraints is {constraints}: a list of constraints is needed, such as [KeepOutDisc(0.2)]")


def all_margins(aperture: SparseAperture, constraints: Sequence[Constraint]) -> Tensor:
    """Return the margins of all inequalities, concatenated (..., M) [m]."""
    margins = [c.checked_margins(aperture) for c in constraints if isinstance(c, Inequality)]
    return torch.cat(margins, dim=-1) if margins else aperture.centers.flatten(-2)[..., :0]


@torch.inference_mode(False)  # it differentiates, whatever the caller does
def project(
    aperture: SparseAperture, constraints: Sequence[Constraint], tick: Callable[[], None] | None = None
) -> SparseAperture:
    """Return the mask nearest to `aperture` that satisfies all `constraints`, to rounding.

    Nearest means the smallest sum of squared shifts, found by sequential quadratic programming. Masks of a population
    are projected one by one. The result has no gradient. `tick` is called at every step of the optimisation, which for
    masks of many holes takes up to half a minute.

    Raises
    ------
    Infeasible
        If no such mask is found.
    """
    require_constraints(constraints)
    centers = aperture.centers.detach()
    double = aperture.replace(centers=centers.double().cpu())
    subspace = Subspace(aperture.n_subapertures, constraints)
    # The result is rounded to the dtype of the aperture and must still satisfy the constraints.
    slack = aperture.mask_diameter * (1e-12 if centers.dtype == torch.float64 else 8 * torch.finfo(centers.dtype).eps)
    masks = [
        _project_one(double.replace(centers=one), subspace, constraints, slack, tick)
        for one in double.centers.reshape(-1, *centers.shape[-2:])
    ]
    return aperture.replace(centers=torch.stack(masks).reshape(centers.shape).to(centers))


def _project_one(
    aperture: SparseAperture,
    subspace: Subspace,
    constraints: Sequence[Constraint],
    slack: float,
    tick: Callable[[], None] | None,
) -> Tensor:
    scale = aperture.mask_diameter
    slack = slack / scale
    margins = _margin_function(aperture, subspace, constraints)
    nearest = subspace.coordinates(aperture.centers).numpy() / scale
    nudge = 1e-9 * subspace.spread().numpy()  # separates coincident holes, which have no direction to part in
    z = nearest
    relevant = np.zeros(0, dtype=bool)
    while True:
        values = margins.values(z)
        shortfall = -values.min(initial=np.inf)
        if shortfall <= -slack / 2:
            return subspace.centers(torch.from_numpy(z * scale))
        # Only margins near zero matter. Others may come near as the holes move, so this is repeated.
        near = values < (0.05 if shortfall > 1e-3 else 0.002)
        before, relevant = relevant, near | relevant if len(relevant) else near
        if len(before) and not (relevant & ~before).any():
            names = ", ".join(map(str, constraints))
            raise Infeasible(f"no mask near the given one obeys {names}: {shortfall * scale:.3g} m are missing")
        rows = np.flatnonzero(relevant)
        # From far away the nearest mask takes an optimisation; Newton's method removes the remaining shortfall.
        if shortfall > 1e-3:
            z = _nearest_point(nearest, z + nudge, margins, rows, slack, tick)
        z = _onto(z, margins, rows, slack)


def _nearest_point(
    target: Array, start: Array, margins: _Margins, rows: Array, slack: float, tick: Callable[[], None] | None
) -> Array:
    """Return argmin |z - target|^2 subject to margins >= slack."""
    result = minimize(
        lambda z: (0.5 * ((z - target) ** 2).sum(), z - target),
        start,
        jac=True,
        method="SLSQP",
        constraints={
            "type": "ineq",
            "fun": lambda z: margins.values(z)[rows] - slack,
            "jac": lambda z: margins.jacobian(z, rows),
        },
        options={"maxiter": 60, "ftol": 1e-12},
        callback=None if tick is None else lambda _: tick(),
    )
    return result.x if np.isfinite(result.x).all() else start


def _onto(z: Array, margins: _Margins, rows: Array, slack: float) -> Array:
    """Repeat the smallest step that satisfies the violated margins, which converges quadratically from nearby."""
    for _ in range(30):
        values = margins.values(z)[rows]
        short = values < slack
        if not short.any():
            break
        z = z + np.linalg.lstsq(margins.jacobian(z, rows[short]), slack - values[short], rcond=1e-9)[0]
    return z


class _Margins(NamedTuple):
    """Functions for the margins (M) and the Jacobian (rows, F) of some of them, at z (F), in mask diameters."""

    values: Callable[[Array], Array]
    jacobian: Callable[[Array, Array], Array]


def _margin_function(aperture: SparseAperture, subspace: Subspace, constraints: Sequence[Constraint]) -> _Margins:
    scale = aperture.mask_diameter

    def margins(z: Tensor) -> Tensor:
        return all_margins(aperture.replace(centers=subspace.centers(z * scale)), constraints) / scale

    def values(z: Array) -> Array:
        with torch.no_grad():
            return margins(torch.from_numpy(z)).numpy()

    def jacobian(z: Array, rows: Array) -> Array:
        # With one copy of the mask per row, the gradient of the sum of each copy's own margin is the Jacobian.
        copies = torch.from_numpy(z).expand(len(rows), -1).clone().requires_grad_()
        own = margins(copies).gather(1, torch.from_numpy(rows)[:, None])
        return torch.autograd.grad(own.sum(), copies)[0].numpy()

    return _Margins(values, jacobian)
