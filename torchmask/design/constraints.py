"""Constraints on masks, each with a penalty, a violation and a projection.

Every search applies `InsideDisc` and `NoOverlap`; others are passed to it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from torchmask.design.constraint_base import Constraint, Inequality, LinearEquality, require_constraints
from torchmask.numbers import whole_number
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.overlaps import check_overlaps, pair_clearances
from torchmask.optics.shape_base import safe_length
from torchmask.plain import require_type


@dataclass(frozen=True)
class InsideDisc(Inequality):
    """Every hole lies wholly inside the disc of diameter `mask_diameter`. N margins, one per hole."""

    def margins(self, aperture: SparseAperture) -> Tensor:
        return aperture.shape.clearance(aperture.centers, aperture.subaperture_diameter, aperture.mask_diameter)


@dataclass(frozen=True)
class RimMargin(Inequality):
    """At least `margin` [m] of material lies between every hole and the rim of the mask disc. N margins."""

    length: ClassVar[str] = "margin"

    margin: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.margin) and self.margin >= 0):
            raise ValueError(f"margin is {self.margin}: it must be finite and not negative, in m")

    def margins(self, aperture: SparseAperture) -> Tensor:
        return InsideDisc().margins(aperture) - self.margin


@dataclass(frozen=True)
class MinimumGap(Inequality):
    """At least `gap` [m] of material lies between any two holes. N(N-1)/2 margins, one per pair.

    For hexagons the gap is measured along the normal of a side, which is exact for sides that face each other and
    never exceeds the true distance.
    """

    length: ClassVar[str] = "gap"

    gap: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.gap) and self.gap >= 0):
            raise ValueError(f"gap is {self.gap}: it must be finite and not negative, in m")

    def margins(self, aperture: SparseAperture) -> Tensor:
        return pair_clearances(aperture) - self.gap


class NoOverlap(MinimumGap):
    """No two holes overlap: the minimum gap is 0."""

    def __init__(self) -> None:
        super().__init__(0.0)


@dataclass(frozen=True)
class KeepOutDisc(Inequality):
    """No hole reaches into a disc, such as a central obstruction. N margins.

    Hexagons count as their circumscribed discs.

    Parameters
    ----------
    diameter : float
        Diameter of the disc [m].
    center : (float, float)
        Centre (x, y) of the disc [m].
    """

    length: ClassVar[str] = "diameter"

    diameter: float
    center: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.diameter) and self.diameter > 0):
            raise ValueError(f"diameter is {self.diameter}: it must be finite and positive, in m")
        _require_point("center", self.center)

    def margins(self, aperture: SparseAperture) -> Tensor:
        difference = aperture.centers - aperture.centers.new_tensor(self.center)
        return safe_length(difference) - self.diameter / 2 - aperture.outer_diameter / 2


@dataclass(frozen=True)
class KeepOutSegment(Inequality):
    """No hole reaches into a thick line, such as a spider vane or the gap between two mirror segments. N margins.

    The line has round ends. Hexagons count as their circumscribed discs.

    Parameters
    ----------
    start : (float, float)
        First end (x, y) [m].
    end : (float, float)
        Second end (x, y) [m].
    width : float
        Full width [m]; 0 for a line.
    """

    length: ClassVar[str] = "width"

    start: tuple[float, float]
    end: tuple[float, float]
    width: float

    def __post_init__(self) -> None:
        _require_point("start", self.start)
        _require_point("end", self.end)
        if math.dist(self.start, self.end) == 0:
            raise ValueError(f"start and end are both {self.start}: for a round zone use KeepOutDisc")
        if not (math.isfinite(self.width) and self.width >= 0):
            raise ValueError(f"width is {self.width}: it must be finite and not negative, in m")

    def margins(self, aperture: SparseAperture) -> Tensor:
        start, end = (aperture.centers.new_tensor(point) for point in (self.start, self.end))
        length = torch.linalg.vector_norm(end - start)
        along = (end - start) / length
        offset = aperture.centers - start
        # Vector from the nearest point of the segment. On the axis, the gradient pushes a hole sideways.
        position = offset @ along
        across = offset[..., 1] * along[0] - offset[..., 0] * along[1]
        difference = torch.stack([across, position - position.clamp(min=0).minimum(length)], dim=-1)
        return safe_length(difference) - self.width / 2 - aperture.outer_diameter / 2


@dataclass(frozen=True)
class NonRedundancy(Inequality):
    """All N(N-1) baselines of the mask are at least `distance` [m] apart from each other and from zero.

    If `distance` is twice the hole diameter, no two pairs of holes share a spatial frequency. (N(N-1)/2)^2 margins.
    """

    length: ClassVar[str] = "distance"

    distance: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.distance) and self.distance > 0):
            raise ValueError(f"distance is {self.distance}: it must be finite and positive, in m")

    def margins(self, aperture: SparseAperture) -> Tensor:
        device = aperture.centers.device
        first, second = torch.triu_indices(aperture.n_subapertures, aperture.n_subapertures, 1, device=device)
        baselines = aperture.centers[..., first, :] - aperture.centers[..., second, :]
        one, other = torch.triu_indices(len(first), len(first), 1, device=device)
        pairs = torch.cat(
            [
                baselines,
                baselines[..., one, :] - baselines[..., other, :],
                baselines[..., one, :] + baselines[..., other, :],
            ],
            dim=-2,
        )
        return safe_length(pairs) - self.distance


@dataclass(frozen=True)
class FixedHoles(LinearEquality):
    """Some holes have fixed positions.

    Parameters
    ----------
    positions : sequence of (float, float)
        Centres (x, y) of these holes [m].
    indices : sequence of int, optional
        Indices of these holes in the mask, by default the first ones.
    """

    positions: Sequence[tuple[float, float]]
    indices: Sequence[int] | None = None

    def __post_init__(self) -> None:
        for position in self.positions:
            _require_point("each position", position)
        if self.indices is not None:
            if len(self.indices) != len(self.positions) or len(set(self.indices)) != len(self.indices):
                raise ValueError(f"indices is {self.indices}: it must name {len(self.positions)} different holes")
            if min(self.indices, default=0) < 0:
                raise ValueError(f"indices is {self.indices}: holes are counted from 0")

    def equations(self, n_subapertures: int) -> tuple[np.ndarray, np.ndarray]:
        indices = list(range(len(self.positions)) if self.indices is None else self.indices)
        if max(indices, default=-1) >= n_subapertures:
            raise ValueError(
                f"hole {max(indices)} is to be fixed, but the mask has {n_subapertures} holes, counted from 0"
            )
        matrix = np.eye(2 * n_subapertures).reshape(n_subapertures, 2, -1)[indices].reshape(-1, 2 * n_subapertures)
        return matrix, np.asarray(self.positions, dtype=float).reshape(-1)


@dataclass(frozen=True)
class NFoldSymmetry(LinearEquality):
    """The mask is unchanged by a rotation of 1/n_fold of a turn about the centre.

    Holes n_fold k, ..., n_fold k + n_fold - 1 are rotations of one of them, counterclockwise. If one hole is left over,
    it is the last one and lies at the centre.
    """

    n_fold: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "n_fold", whole_number("n_fold", self.n_fold, least=2))

    def equations(self, n_subapertures: int) -> tuple[np.ndarray, np.ndarray]:
        n = self.n_fold
        left = n_subapertures % n
        if left > 1:
            near = sorted({n_subapertures - left, n_subapertures - left + 1, n_subapertures - left + n} - {0})
            raise ValueError(
                f"{n_subapertures} holes cannot be {n}-fold symmetric: take a multiple of {n}, or one more "
                f"(a hole at the centre), such as {', '.join(map(str, near))}"
            )
        turn = 2 * math.pi / n
        rotation = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
        matrix = np.zeros((n_subapertures, 2, n_subapertures, 2))
        for hole in range(n_subapertures):
            matrix[hole, :, hole, :] += np.eye(2)
            if hole < n_subapertures - left:  # r_next = rotation r_hole around the orbit
                start = hole - hole % n
                matrix[hole, :, start + (hole - start - 1) % n, :] -= rotation
        matrix = matrix.reshape(2 * n_subapertures, 2 * n_subapertures)
        return matrix, np.zeros(2 * n_subapertures)


def check_mask(aperture: SparseAperture, tolerance: float = 1e-9, constraints: Sequence[Constraint] = ()) -> None:
    """Raise ValueError unless the holes lie in the mask disc, do not overlap and satisfy `constraints`.

    The message says by how much, in metres, and names holes that overlap.

    Parameters
    ----------
    aperture : SparseAperture
        One mask, or a population of which every mask is checked; one of no masks is in order.
    tolerance : float
        Largest shortfall that is accepted, as a fraction of the mask diameter.
    constraints : sequence of Constraint
        Further constraints to check.

    Examples
    --------
    >>> check_mask(SparseAperture([[-0.4, 0.0], [0.4, 0.0]], subaperture_diameter=0.2, mask_diameter=1.0))
    """
    require_type("aperture", aperture, SparseAperture)
    require_constraints(constraints)
    if not aperture.centers.isfinite().all():
        raise ValueError("centers hold values that are not finite: a training that diverged may have put them there")
    check_overlaps(aperture, tolerance)
    for constraint in (InsideDisc(), *constraints):
        violation = constraint.violation(aperture)
        worst = float(violation.max()) if violation.numel() else 0.0
        if not worst <= tolerance * aperture.mask_diameter:  # NaN is no mask in order either
            raise ValueError(
                f"{constraint} is broken by {worst:.3g} m ({worst / aperture.mask_diameter:.3g} of the mask "
                f"diameter; the tolerance is {tolerance:.3g})"
            )


def _require_point(name: str, point: tuple[float, float]) -> None:
    if len(point) != 2 or not all(math.isfinite(value) for value in point):
        raise ValueError(f"{name} is {point}: it must be a finite (x, y) in m")
