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
from typing import Literal, get_args

import torch
from scipy.optimize import brentq
from torch import Tensor

from torchmask.optics.aperture import Aperture, SparseAperture

Criterion = Callable[[Aperture], Tensor]
Kind = Literal["position", "diameter", "both"]


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
        does not change with it.
    n_draws : int
        Number of masks to draw, even and at least 16.
    generator : torch.Generator, optional
        Source of randomness.

    Raises
    ------
    ValueError
        If the aperture is a population, an rms error is out of range, or `n_draws` is odd or too small.
    """
    _check(aperture, n_draws)
    limit = aperture.subaperture_diameter / 10
    for name, value in (("position_rms", position_rms), ("diameter_rms", diameter_rms)):
        if not (math.isfinite(value) and 0 <= value <= limit * (1 + 1e-9)):
            raise ValueError(f"{name} is {value}: it must be between 0 and a tenth of the hole diameter, {limit:.4g} m")
    errors = _draw(aperture, n_draws, generator)
    return _machined(criterion, aperture, position_rms, diameter_rms, *errors)


def machining_tolerance(
    criterion: Criterion,
    aperture: SparseAperture,
    growth: float = 0.01,
    *,
    kind: Kind = "both",
    quantile: float | None = None,
    n_draws: int = 128,
    generator: torch.Generator | None = None,
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
    _check(aperture, n_draws)
    if kind not in get_args(Kind):
        raise ValueError(f"kind is {kind!r}: known kinds are {', '.join(get_args(Kind))}")
    if not (math.isfinite(growth) and growth > 0):
        raise ValueError(f"growth is {growth}: it must be finite and positive, 0.01 for 1 %")
    if quantile is not None and not 0 < quantile < 1:
        raise ValueError(f"quantile is {quantile}: it must lie between 0 and 1")
    errors = _draw(aperture, n_draws, generator)

    def measure(rms: float) -> tuple[float, float]:
        position, diameter = rms * (kind != "diameter"), rms * (kind != "position")
        result = _machined(criterion, aperture, position, diameter, *errors)
        return result.mean() if quantile is None else result.quantile(quantile)

    limit = aperture.subaperture_diameter / 10
    high = limit / 512
    while measure(high)[0] < growth:
        if high >= limit:
            return MachiningTolerance(math.inf, math.nan, growth, kind, quantile)
        high *= 2
    rms = float(brentq(lambda size: measure(size)[0] - growth, 0, high, xtol=1e-3 * high, rtol=1e-3))  # type: ignore[arg-type]
    slope = (measure(1.02 * rms)[0] - measure(0.98 * rms)[0]) / (0.04 * rms)
    return MachiningTolerance(rms, measure(rms)[1] / abs(slope), growth, kind, quantile)


def _check(aperture: SparseAperture, n_draws: int) -> None:
    if aperture.centers.ndim != 2:
        raise ValueError(f"centers has shape {tuple(aperture.centers.shape)}: one mask is needed, (n_subapertures, 2)")
    if n_draws % 2 != 0 or n_draws < 16:
        raise ValueError(f"n_draws is {n_draws}: it must be an even number of at least 16, since draws come in pairs")


def _draw(aperture: SparseAperture, n_draws: int, generator: torch.Generator | None) -> tuple[Tensor, Tensor]:
    """Draw errors of unit rms, in pairs of opposite sign, of positions (n_draws, N, 2) and diameters (n_draws,)."""
    like = {"dtype": aperture.centers.dtype, "device": aperture.centers.device, "generator": generator}
    position = torch.randn(n_draws // 2, *aperture.centers.shape, **like)
    diameter = torch.randn(n_draws // 2, **like)
    return torch.cat([position, -position]), torch.cat([diameter, -diameter])


def _machined(
    criterion: Criterion,
    aperture: SparseAperture,
    position_rms: float,
    diameter_rms: float,
    position: Tensor,
    diameter: Tensor,
) -> MachiningErrors:
    with torch.no_grad():
        nominal = float(criterion(aperture))
        centers = aperture.centers + position_rms * position
        if diameter_rms == 0:
            mse = criterion(aperture.replace(centers=centers))
        else:  # a population has a single diameter, so masks are evaluated one by one
            diameters = (aperture.subaperture_diameter + diameter_rms * diameter).tolist()
            masks = [aperture.replace(c, d) for c, d in zip(centers, diameters, strict=True)]
            mse = torch.stack([criterion(mask) for mask in masks])
    return MachiningErrors(position_rms, diameter_rms, nominal, mse)
