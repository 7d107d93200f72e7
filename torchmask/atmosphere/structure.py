"""The phase structure function as a smooth, differentiable function of the displacement, for any outer scale.

Divided by Kolmogorov's 6.88 (r / r0)^(5/3), von Karman's structure function is analytic in (r / L0)^(1/3). A short
Chebyshev series therefore replaces its Bessel function (`von_karman_structure_function`) to 1e-7.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.polynomial import Chebyshev
from torch import Tensor

from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT, require_turbulence, von_karman_structure_function

_SATURATED = 3.0  # in outer scales; beyond, the structure function is constant to 2e-8
_TOLERANCE = 1e-8  # largest of the last coefficients of the Chebyshev series
_DEGREES = (6, 8, 12, 16, 24, 32, 48)


@dataclass(frozen=True)
class StructureFunction:
    """Mean square phase difference [rad^2] between two points of the pupil.

    Parameters
    ----------
    r0 : float
        Fried parameter [m].
    outer_scale : float
        Outer scale [m]; infinite for Kolmogorov turbulence.
    reach : float
        Largest displacement that will be needed [m]. With a finite outer scale, a finite value makes the series
        shorter, and longer displacements are clamped to it; Kolmogorov turbulence has no series, and clamps nothing.

    Raises
    ------
    ValueError
        If a scale is not positive, or r0 is not finite.

    Examples
    --------
    >>> kolmogorov = StructureFunction(r0=0.1)
    >>> round(float(kolmogorov(torch.tensor([0.06, 0.08]))), 2)  # one r0 apart
    6.88
    """

    r0: float
    outer_scale: float = math.inf
    reach: float = math.inf

    def __post_init__(self) -> None:
        require_turbulence(self.r0, 1.0)
        for name, value in (("outer_scale", self.outer_scale), ("reach", self.reach)):
            if not value > 0:
                raise ValueError(f"{name} is {value}: it must be positive, in m")

    def __call__(self, displacement: Tensor) -> Tensor:
        """Return the structure function (...) at `displacement` (..., 2) [m].

        It has the dtype of `displacement` and is differentiable in it, with gradient 0 at 0.
        """
        return self.at(*displacement.unbind(-1))

    def at(self, x: Tensor, y: Tensor) -> Tensor:
        """Return the structure function (...) at displacements (x, y), of shapes that broadcast to (...) [m]."""
        x, y = torch.broadcast_tensors(x, y)
        # The offset, a billionth of r0 squared, keeps the derivative finite at 0. As few passes over arrays as can be.
        squared = torch.addcmul(x.new_full((), 1e-18 * self.r0**2), x, x).addcmul_(y, y)
        if math.isinf(self.outer_scale):
            scale = x.new_full((), math.log2(STRUCTURE_CONSTANT) - 5 / 3 * math.log2(self.r0))
            # a power takes twice as long, and exp_ longer than exp2_
            return torch.add(scale, squared.log2(), alpha=5 / 6).exp2_()
        unit = squared.mul_(1 / self.r0**2)
        longest = min(self.reach, _SATURATED * self.outer_scale)
        root = torch.exp(unit.clamp(max=(longest / self.r0) ** 2).log() / 6)  # (r / r0)^(1/3)
        series = _series(longest / self.outer_scale)
        position = root * (2 / (longest / self.r0) ** (1 / 3)) - 1
        return STRUCTURE_CONSTANT * root * (root * root) ** 2 * _clenshaw(series, position)


def coherence_distance(r0: float) -> float:
    """Return how far a frozen wind carries Kolmogorov turbulence of `r0` [m] until it has changed by 1 rad rms [m].

    That is 0.314 r0; divided by the speed of the wind it is tau0.
    """
    return STRUCTURE_CONSTANT ** (-3 / 5) * r0


@lru_cache(maxsize=64)
def _series(longest: float) -> tuple[float, ...]:
    """Return Chebyshev coefficients of the ratio of von Karman's to Kolmogorov's structure function.

    The variable is (r / L0)^(1/3), from r = 0 to r = `longest` L0.
    """

    def ratio(position: np.ndarray) -> np.ndarray:
        # At 0 the ratio is 1 but computes as 0/0, so a tiny distance replaces 0.
        root = np.maximum((position + 1) / 2 * longest ** (1 / 3), 1e-5)
        values = von_karman_structure_function(torch.from_numpy(root**3), 1.0, 1.0).numpy()
        return values / (STRUCTURE_CONSTANT * root**5)

    coefficients = np.empty(0)
    for degree in _DEGREES:
        coefficients = Chebyshev.interpolate(ratio, degree).coef
        if np.abs(coefficients[-2:]).max() < _TOLERANCE:
            break
    return tuple(coefficients.tolist())


def _clenshaw(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Evaluate the Chebyshev series at x (...)."""
    after, current, twice = torch.zeros_like(x), torch.full_like(x, coefficients[-1]), 2 * x
    for coefficient in coefficients[-2:0:-1]:
        current, after = (coefficient - after).addcmul_(twice, current), current
    return (coefficients[0] - after).addcmul_(x, current)
