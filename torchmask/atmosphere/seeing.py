"""Turbulence during one exposure: its strength, and the wind that carries it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import roots_jacobi
from torch import Tensor

from torchmask.atmosphere.structure import StructureFunction, coherence_distance
from torchmask.plain import require_plain

_HOST = {"dtype": torch.float64, "device": "cpu"}  # whatever the default device


@dataclass(frozen=True)
class Seeing:
    """One layer of von Karman turbulence under a frozen wind, and the exposure that averages over it.

    Parameters
    ----------
    r0 : float
        Fried parameter at the reference wavelength, that of the grid [m].
    outer_scale : float
        Outer scale L0 [m]; infinite for Kolmogorov turbulence.
    exposure : float
        Exposure time T [s]; 0 for instantaneous frames.
    wind : float or (float, float)
        Wind speed [m/s] with all directions equally likely, or wind velocity (vx, vy) [m/s].

    Raises
    ------
    ValueError
        If a length is not positive, the exposure or the speed is negative, a number is not finite, or an exposure is
        given without wind, in which case its length would have no effect.

    Examples
    --------
    >>> seeing = Seeing(r0=0.1, exposure=5e-3, wind=10.0)
    >>> round(1e3 * seeing.tau0, 2)  # ms
    3.14
    """

    r0: float
    outer_scale: float = math.inf
    exposure: float = 0.0
    wind: float | tuple[float, float] = 0.0

    def __post_init__(self) -> None:
        self.structure()  # checks the scales
        if not (math.isfinite(self.exposure) and self.exposure >= 0):
            raise ValueError(f"exposure is {self.exposure}: it must be finite and not negative, in s")
        require_plain("wind", self.wind)
        wind = self.wind.detach().cpu() if isinstance(self.wind, Tensor) else self.wind
        try:
            given = np.asarray(wind)
            numbers = given.astype(float) if given.dtype.kind in "iuf" else np.empty(0)
        except (TypeError, ValueError):
            numbers = np.empty(0)
        if numbers.shape not in ((), (2,)) or not np.isfinite(numbers).all() or (numbers.ndim == 0 and numbers < 0):
            raise ValueError(f"wind is {self.wind}: it must be a speed of at least 0 or a pair (vx, vy), in m/s")
        object.__setattr__(self, "wind", float(numbers) if numbers.ndim == 0 else tuple(numbers.tolist()))
        if self.exposure > 0 and self.speed == 0:
            raise ValueError(f"exposure is {self.exposure} s without wind: say how fast the turbulence moves, in m/s")

    @property
    def speed(self) -> float:
        """Speed of the wind [m/s]."""
        return math.hypot(*self.wind) if isinstance(self.wind, tuple) else float(self.wind)

    @property
    def tau0(self) -> float:
        """Coherence time [s], in which the phase at a point changes by 1 rad rms in Kolmogorov turbulence."""
        return math.inf if self.speed == 0 else coherence_distance(self.r0) / self.speed

    @property
    def is_isotropic(self) -> bool:
        """Whether no direction is distinguished."""
        return self.exposure == 0 or not isinstance(self.wind, tuple)

    def structure(self, reach: float = math.inf) -> StructureFunction:
        """Return the structure function of the phase, for displacements up to `reach` [m]."""
        return StructureFunction(self.r0, self.outer_scale, reach)

    def drift(self, n_lags: int = 7, n_directions: int = 8) -> tuple[Tensor, Tensor]:
        """Return displacements (L, 2) [m] of the turbulence between two instants of an exposure, with weights (L,).

        They are a Gauss quadrature over the lag of two instants of [0, T], of density 2 (1 - x) / T with x = lag / T. A
        displacement represents its opposite too.
        """
        if self.exposure == 0:
            return torch.zeros(1, 2, **_HOST), torch.ones(1, **_HOST)
        lags, weights = _triangle_quadrature(n_lags)
        if isinstance(self.wind, tuple):
            directions = torch.tensor([self.wind], **_HOST)
        else:
            angle = math.pi * (torch.arange(n_directions, **_HOST) + 0.5) / n_directions
            directions = self.wind * torch.stack([angle.cos(), angle.sin()], -1)
        steps = self.exposure * lags[:, None, None] * directions
        return steps.flatten(0, 1), (weights[:, None] / len(directions)).expand(-1, len(directions)).flatten()


def _triangle_quadrature(n: int) -> tuple[Tensor, Tensor]:
    """Return nodes and weights on [0, 1] for the density 2 (1 - x), exact for polynomials of degree 2 n - 1."""
    nodes, weights = roots_jacobi(n, 1, 0)
    return torch.from_numpy((np.asarray(nodes) + 1) / 2), torch.from_numpy(np.asarray(weights) / np.sum(weights))
