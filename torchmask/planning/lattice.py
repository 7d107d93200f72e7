"""Axes of a table that was measured on a lattice, and its values between the points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

_ROUNDING = 1e-9


@dataclass(frozen=True)
class Axis:
    """Values along one axis of a lattice.

    name : of the quantity, for errors
    words : what its values are, for warnings
    values : in rising order, at least two
    logarithmic : whether tables are interpolated evenly in its logarithm
    may_be_zero : whether 0 is a value of the quantity
    harder : whether restorations lose more and more beyond the last value, so that its neighbour tells nothing there

    Raises ValueError if the values are too few, negative or out of order, or 0 where that is none.

    Examples
    --------
    >>> round(Axis("n_photons", "photons per frame", (1e5, 1e7), logarithmic=True).place(1e6), 6)
    0.5
    """

    name: str
    words: str
    values: Sequence[float]
    logarithmic: bool = False
    may_be_zero: bool = False
    harder: bool = False

    def __post_init__(self) -> None:
        if len(self.values) < 2 or not (np.diff(self.values) > 0).all() or not self._can_be(self.values[0]):
            raise ValueError(
                f"{self.name} is {list(self.values)}: at least two values are needed, in rising order, {self._wanted}"
            )

    @property
    def _wanted(self) -> str:
        return "finite and at least 0" if self.may_be_zero else "finite and positive"

    def _can_be(self, value: float) -> bool:
        return math.isfinite(value) and (value > 0 or (value == 0 and self.may_be_zero))

    def place(self, value: float) -> float:
        """Return the fractional index of a value, that of the nearest end outside.

        Raises ValueError unless the value is finite and positive, or 0 where it may be.
        """
        if not self._can_be(value):
            raise ValueError(f"{self.name} is {value}: it must be {self._wanted}")
        scale = np.log if self.logarithmic else np.asarray
        return float(np.interp(scale(value), scale(np.array(self.values)), np.arange(len(self.values))))

    def holds(self, value: float) -> bool:
        """Return whether a value lies between the ends."""
        return self.values[0] * (1 - _ROUNDING) <= value <= self.values[-1] * (1 + _ROUNDING)

    def is_harder(self, value: float) -> bool:
        """Return whether restorations lose more at a value than at any that was tried, by an unknown amount."""
        return self.harder and value > self.values[-1] * (1 + _ROUNDING)


class Located(NamedTuple):
    """A point of a lattice: its fractional indices, the names of the axes that do not hold it, and of those among them
    along which restorations lose more than at any point that was tried."""

    places: list[float]
    outside: tuple[str, ...]
    harder: tuple[str, ...]


def locate(axes: Sequence[Axis], point: Sequence[float], through: str, told: Collection[str] = ()) -> Located:
    """Find a point on the lattice of restorations `through` a mask or a full pupil, in words for warnings.

    `told` names the axes of which a warning said before that they do not hold the point.

    Raises ValueError for a value that cannot be.

    Warns
    -----
    UserWarning
        For each axis that does not hold the point and was not told before; its nearest end is taken.
    """
    known = list(zip(axes, point, strict=True))
    places = [axis.place(value) for axis, value in known]
    outside = [axis for axis, value in known if not axis.holds(value)]
    harder = tuple(axis.name for axis, value in known if axis.is_harder(value))
    for axis in (axis for axis in outside if axis.name not in told):
        then = "beyond, what they lose is taken to be that of the nearest tried"
        if axis.name in harder:
            then = (
                "they lose more beyond the last, by how much is not known, so that a plan chooses such a point only if "
                "there is no other"
            )
        first, last = axis.values[0], axis.values[-1]
        warnings.warn(
            f"blind restorations through {through} were tried for {axis.words} from {first:g} to {last:g}: {then}",
            stacklevel=3,
        )
    return Located(places, tuple(axis.name for axis in outside), harder)


def interpolate(table: np.ndarray, places: Sequence[float]) -> float:
    """Return the multilinear interpolation of a table at fractional indices inside it.

    >>> interpolate(np.array([[0.0, 1.0], [2.0, 3.0]]), (0.5, 0.25))
    1.25
    """
    for place in places:
        first = min(int(place), len(table) - 2)
        table = table[first] + (place - first) * (table[first + 1] - table[first])
    return float(table)
