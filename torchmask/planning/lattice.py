"""Axes of a table that was measured on a lattice, and its values between the points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Collection, Sequence
from dataclasses import dataclass

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


def locate(
    axes: Sequence[Axis], point: Sequence[float], told: Collection[str] = ()
) -> tuple[list[float], tuple[str, ...]]:
    """Return the fractional indices of a point, and the names of the axes that do not hold it.

    `told` names those of which a warning said so before.

    Raises ValueError for a value that cannot be.

    Warns
    -----
    UserWarning
        For each of those axes that was not told before; its nearest end is taken.
    """
    places = [axis.place(value) for axis, value in zip(axes, point, strict=True)]
    outside = [axis for axis, value in zip(axes, point, strict=True) if not axis.holds(value)]
    for axis in (axis for axis in outside if axis.name not in told):
        warnings.warn(
            f"blind restorations were tried for {axis.words} from {axis.values[0]:g} to {axis.values[-1]:g}: beyond, "
            "what they lose is taken to be that of the nearest tried",
            stacklevel=3,
        )
    return places, tuple(axis.name for axis in outside)


def interpolate(table: np.ndarray, places: Sequence[float]) -> float:
    """Return the multilinear interpolation of a table at fractional indices inside it.

    >>> interpolate(np.array([[0.0, 1.0], [2.0, 3.0]]), (0.5, 0.25))
    1.25
    """
    for place in places:
        first = min(int(place), len(table) - 2)
        table = table[first] + (place - first) * (table[first + 1] - table[first])
    return float(table)
