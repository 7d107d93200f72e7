"""Machining tolerances of a mask, by Monte Carlo simulation of errors of hole positions and diameters.

Position errors are independent for every hole and axis, and Gaussian. The diameter error is Gaussian and common to all
holes of a mask, because one tool or one etching cuts them all and the criterion has one diameter per mask. Independent
errors of N diameters act to first order through their mean and would do about sqrt(N) times less harm, so a common
error is the cautious choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from torch import Tensor

from torchmask.numbers import whole_number
from torchmask.optics.aperture import Aperture, SparseAperture
from torchmask.optics.draws import draw_normal
from torchmask.record import Callback, Record

Criterion = Callable[[Aperture], Tensor]
Kind = Literal["position", "diameter", "both"]
_USUAL = 25  # evaluations of the criterion that a tolerance takes
# Relative errors of the diameter at which the criterion is evaluated: closer to each other where errors are small.
_DIAMETERS = np.array([-0.3, -0.08, -0.02, 0.0, 0.02, 0.08, 0.3])


@dataclass(frozen=True)
class MachiningErrors:
    """Effect of machining errors of a given size on the error of the restoration; `print` shows the main numbers.

    position_rms : rms error of each coordinate of a hole [m]
    diameter_rms : rms error of the common diameter of the holes [m]
    nominal_mse : MSE of the mask as designed
    mse : (n_draws,) MSE of the masks as machined. The second half has the errors of the first half with opposite sign,
        so that first-order effects cancel in the mean
    """

    position_rms: float
    diameter_rms: float
    nominal_mse: float
    mse: Tensor

    @property
    def growth(self) -> Tensor:
        """Relative growth of the MSE of each draw, (n_draws,)."""
        return self.mse / self.nominal_mse - 1

    def mean(self) -> tuple[float, float]:
        """Return the mean relative growth and its standard error."""
        pairs = self.growth.reshape(2, -1).mean(0)
        return float(pairs.mean()), float(pairs.std()) / math.sqrt(len(pairs))

    def quantile(self, level: float) -> tuple[float, float]:
        """Return the relative growth below which a fraction `level` of the masks stays, and its standard error.

        The error is half the difference of the order statistics one binomial standard deviation to either side. The two
        draws of a pair count as one, which overestimates it by up to sqrt(2) if the growth is of first order.
        """
        if not 0 < level < 1:
            raise ValueError(f"the level of a quantile is {level}: it must lie between 0 and 1")
        spread = math.sqrt(level * (1 - level) / (len(self.mse) / 2))
        levels = self.growth.new_tensor([level, max(level - spread, 0), min(level + spread, 1)])
        value, low, high = torch.quantile(self.growth, levels).tolist()
        return value, (high - low) / 2

    def __str__(self) -> str:
        (mean, mean_error), (high, high_error) = self.mean(), self.quantile(0.95)
        return (
            f"rms error of positions {self.position_rms:.4g} m, of the diameter {self.diameter_rms:.4g} m, "
            f"{len(self.mse)} masks\n"
            f"mean growth of the MSE    {100 * mean:.3f} +- {100 * mean_error:.3f} %\n"
            f"95 % of masks stay below  {100 * high:.3f} +- {100 * high_error:.3f} %"
        )


@dataclass(frozen=True)
class MachiningTolerance:
    """The rms machining error that is tolerable.

    rms : rms error at which the MSE has grown by `growth` [m]; infinite if it has not at a tenth of the hole diameter
    error : statistical standard error of `rms` [m]
    growth : tolerated relative growth of the MSE
    kind : quantity with errors, "position", "diameter" or "both" with the same rms
    quantile : fraction of masks that must stay below `growth`; None if the mean of all masks must
    """

    rms: float
    error: float
    growth: float
    kind: Kind
    quantile: float | None


def machining_errors(
    criterion: Criterion,
    aperture: SparseAperture,
    position_rms: float = 0.0,
    diameter_rms: float = 0.0,
    n_draws: int = 128,
    generator: torch.Generator | None = None,
) -> MachiningErrors:
    """Return the distribution of the MSE over masks machined with errors.

    Parameters
    ----------
    criterion : callable
        Function from an aperture to its MSE (...), such as `AsymptoticMSE`. Its grid must resolve the OTF of a
        sub-aperture: on a coarse grid, a mask optimised on that grid looks more sensitive than it is.
    aperture : SparseAperture
        One mask, with centres (N, 2).
    position_rms : float
        Rms error of each coordinate of each hole [m], at most a tenth of the hole diameter.
    diameter_rms : float
        Rms error of the common diameter of the holes [m], at most a tenth of it. The number of photons in the criterion
        does not change with it. The criterion is evaluated at seven diameters and interpolated between them, which
        errs by less than a tenth of the growth.
    n_draws : int
        Number of masks to draw, even and at least 16.
    generator : torch.Generator, optional
        Source of randomness.

    Raises
    ------
    ValueError
        If the aperture is a population, an rms error is out of range, or `n_draws` is odd or too small.
    """
    workshop = _Workshop(criterion, aperture, n_draws, generator)
    limit = aperture.subaperture_diameter / 10
    for name, value in (("position_rms", position_rms), ("diameter_rms", diameter_rms)):
        if not (math.isfinite(value) and 0 <= value <= limit * (1 + 1e-9)):
            raise ValueError(f"{name} is {value}: it must be between 0 and a tenth of the hole diameter, {limit:.4g} m")
    return workshop.errors(position_rms, diameter_rms)


def machining_tolerance(
    criterion: Criterion,
    aperture: SparseAperture,
    growth: float = 0.01,
    *,
    kind: Kind = "both",
    quantile: float | None = None,
    n_draws: int = 128,
    generator: torch.Generator | None = None,
    callback: Callback | None = None,
) -> MachiningTolerance:
    """Return the rms machining error at which the MSE has grown by `growth`.

    The same draws are scaled to every size of error that is tried, so the growth is a smooth function of it. For
    `criterion`, `aperture`, `n_draws` and `generator` see `machining_errors`.

    Parameters
    ----------
    growth : float
        Tolerated relative growth of the MSE, positive.
    kind : {"both", "position", "diameter"}
        Quantity with errors: each coordinate of the positions, the common diameter, or both with the same rms.
    quantile : float, optional
        Fraction of the masks, in (0, 1), that must stay below `growth`. By default their mean must.
    callback : callable, optional
        Receives a preparatory `Record` of stage "design/tolerance" after each evaluation of the criterion.

    Raises
    ------
    ValueError
        As `machining_errors` does, and if `growth` is not positive, `kind` is unknown or `quantile` is not in (0, 1).

    Examples
    --------
    >>> from torchmask.design.criterion import AsymptoticMSE
    >>> from torchmask.spectra import NoisePSD, PowerLawPSD
    >>> from torchmask.grid import Grid
    >>> criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 128), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), n_frames=20)
    >>> mask = SparseAperture.from_catalog("golay6", 1.0, 0.15)
    >>> tolerance = machining_tolerance(criterion, mask, kind="position", n_draws=32)
    >>> 0 < tolerance.error < tolerance.rms < 0.1 * mask.subaperture_diameter
    True
    """
    workshop = _Workshop(criterion, aperture, n_draws, generator, callback)
    if kind not in get_args(Kind):
        raise ValueError(f"kind is {kind!r}: known kinds are {', '.join(get_args(Kind))}")
    if not (math.isfinite(growth) and growth > 0):
        raise ValueError(f"growth is {growth}: it must be finite and positive, 0.01 for 1 %")
    if quantile is not None and not 0 < quantile < 1:
        raise ValueError(f"quantile is {quantile}: it must lie between 0 and 1")

    def measure(rms: float) -> tuple[float, float]:
        result = workshop.errors(rms * (kind != "diameter"), rms * (kind != "position"))
        return result.mean() if quantile is None else result.quantile(quantile)

    limit = aperture.subaperture_diameter / 10
    high = limit / 64
    while measure(high)[0] < growth:
        if high >= limit:
            return MachiningTolerance(math.inf, math.nan, growth, kind, quantile)
        high *= 4
    rms = float(brentq(lambda size: measure(size)[0] - growth, 0, high, xtol=1e-3 * high, rtol=1e-3))  # type: ignore[arg-type]
    slope = (measure(1.02 * rms)[0] - measure(0.98 * rms)[0]) / (0.04 * rms)
    return MachiningTolerance(rms, measure(rms)[1] / abs(slope), growth, kind, quantile)


class _Workshop:
    """Draws of unit rms of the errors of one mask, and what the criterion says of them at any size of the errors.

    A population has one diameter, and a new diameter may cost the criterion tables of seconds. So the diameter enters
    by a few values of it alone: M(centers, d) of a draw is M(centers, d') M(nominal, d) / M(nominal, d') with d' the
    nearest of them, and M(nominal, d) is a cubic spline through them.
    """

    def __init__(
        self,
        criterion: Criterion,
        aperture: SparseAperture,
        n_draws: int,
        generator: torch.Generator | None,
        callback: Callback | None = None,
    ) -> None:
        if aperture.centers.ndim != 2:
            shape = tuple(aperture.centers.shape)
            raise ValueError(f"centers has shape {shape}: one mask is needed, (n_subapertures, 2)")
        n_draws = whole_number("n_draws", n_draws, least=16)
        if n_draws % 2 != 0:
            raise ValueError(f"n_draws is {n_draws}: it must be even, since draws come in pairs: take {n_draws + 1}")
        self.criterion: Criterion = criterion
        self.callback: Callback | None = callback
        self.evaluations: int = 0
        self.aperture: SparseAperture = aperture
        centers = aperture.centers
        like = (centers.dtype, centers.device, generator)
        position = draw_normal((n_draws // 2, *centers.shape), *like)
        diameter = draw_normal((n_draws // 2,), *like)
        self.position: Tensor = torch.cat([position, -position])
        self.diameter: Tensor = torch.cat([diameter, -diameter])

    @torch.no_grad()
    def errors(self, position_rms: float, diameter_rms: float) -> MachiningErrors:
        """Return the distribution of the MSE at this size of the errors [m]."""
        centers = self.aperture.centers + position_rms * self.position
        if diameter_rms == 0:
            mse = self._measure(self.aperture.replace(centers=centers))
        else:
            relative = (diameter_rms / self.aperture.subaperture_diameter * self.diameter).cpu().double().numpy()
            nearest = np.abs(relative[:, None] - _DIAMETERS).argmin(1)
            mse = torch.from_numpy(self._of_diameter(relative)).to(centers)
            for node in np.unique(nearest) if position_rms > 0 else ():
                own = torch.from_numpy(nearest == node).to(centers.device)
                moved = self._measure(self._of_size(node).replace(centers=centers[own]))
                mse[own] *= moved / float(self._of_diameter(_DIAMETERS[node]))
        return MachiningErrors(position_rms, diameter_rms, self._nominal, mse)

    def _measure(self, aperture: SparseAperture) -> Tensor:
        """Return the MSE of masks (...), and report how many times that was done."""
        mse = self.criterion(aperture)
        self.evaluations += 1
        if self.callback is not None:
            budget, scalars = max(_USUAL, self.evaluations), {"mse": float(mse.mean())}
            self.callback(Record("design/tolerance", self.evaluations, budget, scalars, preparatory=True))
        return mse

    def _of_size(self, node: int) -> SparseAperture:
        diameter = self.aperture.subaperture_diameter * (1 + float(_DIAMETERS[node]))
        return self.aperture.replace(subaperture_diameter=diameter)

    @cached_property
    def _nominal(self) -> float:
        """The MSE of the mask as designed."""
        return float(self._measure(self.aperture))

    @cached_property
    def _of_diameter(self) -> CubicSpline:
        """The MSE at the nominal positions over the relative error of the diameter."""
        values = [float(self._measure(self._of_size(node))) for node in range(len(_DIAMETERS))]
        return CubicSpline(_DIAMETERS, values)
