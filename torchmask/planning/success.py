"""How often a restoration with unknown aberrations succeeds, and what it loses: measured maps, interpolated.

The maps are `success_mask.json` and `success_full.json` beside this file, written by `experiments/success_map.py`; each
holds its own conditions.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from typing import Literal, get_args

import numpy as np

from torchmask.planning.lattice import Axis, interpolate, locate

Pupil = Literal["mask", "full"]
THROUGH: dict[Pupil, str] = {"mask": "masks", "full": "a full pupil"}
SUCCESS = 1.3  # a restoration succeeds if its score is within this factor of that for known PSFs


@dataclass(frozen=True)
class BlindOutlook:
    """What to expect of a restoration that has to find the aberrations.

    cost : its score over that for known PSFs, median; below 1 where both are drowned in noise
    success : chance that this ratio is within 1.3
    low, high : Wilson's interval of that chance at one standard error, from the number of restorations
    outside : names of what lies outside what was tried, for which its nearest edge was taken
    harder : those of them that make restorations lose more than at any point that was tried: the rest is a lower limit
    restored : its score over cost times the one predicted for instants in narrow light: by how much restorations differ
        from the linear estimate that is predicted, and what exposure and band do to them

    Examples
    --------
    >>> round(BlindOutlook(cost=1.2, success=0.75, low=0.5, high=0.9).mse(relative_mse=0.15, above_floor=0.1), 3)
    0.194
    """

    cost: float
    success: float
    low: float
    high: float
    outside: tuple[str, ...] = ()
    restored: float = 1.0
    harder: tuple[str, ...] = ()

    def mse(self, relative_mse: float, above_floor: float) -> float:
        """Return what a relative error predicted for known PSFs of instants in narrow light becomes.

        What of it a mask can avoid, `above_floor`, is multiplied by the square of cost, where that is above 1, times
        restored: a score is an amplitude. No more than 1 is returned, the error of knowing nothing.
        """
        return min(1.0, relative_mse + ((max(1.0, self.cost) * self.restored) ** 2 - 1) * above_floor)


@dataclass(frozen=True, eq=False)
class SuccessMap:
    """Restorations on a lattice of frames, photons per frame and the diameter of a hole, or of a full pupil, over r0.

    n_frames, n_photons, d_over_r0 : the values measured, in rising order, at least two each
    tried, succeeded : numbers of restorations, indexed [frames, photons, d_over_r0]
    cost : median over them of the score over that for known PSFs
    conditions : what all of them share, in a sentence
    pupil : what the restorations were through
    level : geometric mean over them of the score for known PSFs over the one that `TurbulentMSE` predicts; a single
        number where it was not measured, and is taken to be the same at all points

    Raises ValueError if a shape or an order is wrong, or a number of restorations cannot be.

    Examples
    --------
    >>> outlook = success_map().outlook(d_over_r0=0.6, n_photons=2e6, n_frames=10)
    >>> outlook.low <= outlook.success <= outlook.high
    True
    """

    n_frames: Sequence[float]
    n_photons: Sequence[float]
    d_over_r0: Sequence[float]
    tried: np.ndarray
    succeeded: np.ndarray
    cost: np.ndarray
    conditions: str = ""
    pupil: Pupil = "mask"
    level: np.ndarray = field(default_factory=lambda: np.array(1.0))

    def __post_init__(self) -> None:
        shape = tuple(len(axis.values) for axis in self._axes)
        if np.ndim(self.level) == 0:
            object.__setattr__(self, "level", np.full(shape, self.level))
        for name in ("tried", "succeeded", "cost", "level"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), float))
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}: {shape} is needed, as by the axes")
        measured = (self.succeeded >= 0) & (self.succeeded <= self.tried) & (self.tried >= 1)
        if not (measured & (self.cost > 0) & (self.level > 0)).all():
            raise ValueError(
                "each cell needs at least one restoration, no more successes than those, a positive cost and level"
            )

    @property
    def _axes(self) -> tuple[Axis, ...]:
        return (
            Axis("n_frames", "numbers of frames", self.n_frames, logarithmic=True),
            Axis("n_photons", "photons per frame", self.n_photons, logarithmic=True),
            Axis("d_over_r0", "d/r0", self.d_over_r0, harder=True),
        )

    def outlook(self, d_over_r0: float, n_photons: float, n_frames: float) -> BlindOutlook:
        """Return chance and cost at one point.

        Between the lattice's points the chance is linear, cost and level are geometric, in the logarithms of photons
        and frames and in d / r0, so that at its points they are what was measured and between two of them they lie
        between the two. Each of the frames showed turbulence of its own.

        Parameters
        ----------
        d_over_r0 : float
            Diameter of a hole, or of the full pupil, over Fried's parameter.
        n_photons : float
            Electrons per frame through the aperture.
        n_frames : float

        Raises
        ------
        ValueError
            If a number is not finite and positive.

        Warns
        -----
        UserWarning
            If the point lies outside the map, whose nearest edge is taken.
        """
        places, outside, harder = locate(self._axes, (n_frames, n_photons, d_over_r0), THROUGH[self.pupil])
        chance = self.succeeded / self.tried
        middle, half = chance + 0.5 / self.tried, np.sqrt(chance * (1 - chance) / self.tried + 0.25 / self.tried**2)
        low, high = ((middle + side * half) / (1 + 1 / self.tried) for side in (-1, 1))
        return BlindOutlook(
            cost=math.exp(interpolate(np.log(self.cost), places)),
            success=interpolate(chance, places),
            low=interpolate(low, places),
            high=interpolate(high, places),
            outside=outside,
            restored=math.exp(interpolate(np.log(self.level), places)),
            harder=harder,
        )


@functools.cache
def success_map(pupil: Pupil = "mask") -> SuccessMap:
    """Return the map that comes with the library, of masks ("mask") or of the full pupil ("full").

    Raises ValueError for any other kind of pupil.

    >>> success_map() is success_map()  # it is read once
    True
    """
    if pupil not in get_args(Pupil):
        raise ValueError(f"pupil is {pupil!r}: maps are known of {' and '.join(get_args(Pupil))}")
    table = files("torchmask.planning").joinpath(f"success_{pupil}.json")
    return SuccessMap(**json.loads(table.read_text(encoding="utf-8")), pupil=pupil)
