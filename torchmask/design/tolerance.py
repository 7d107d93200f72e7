"""How well a mask must be machined: Monte Carlo of hole position and diameter errors.

Positions err independently, hole by hole, by a Gaussian of the same rms on either axis. The diameter error is common to
all holes of a mask and Gaussian from mask to mask: one tool or one etching cuts them all, and the criterion knows one
diameter a mask. Independent errors of N diameters act through their mean to first order, so they do about sqrt(N)
times less harm: the common error is the cautious choice.
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
    """What machining errors of a given size do to the error of the restoration; `print` shows the main numbers.

    position_rms, diameter_rms : rms error of each coordinate of a hole, and of the diameter common to all [m]
    nominal_mse : of the mask as designed
    mse : (n_draws,) of the masks as machined; the second half has the errors of the first with the sign reversed, so
        that effects of first order leave the mean exactly
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
        """Mean relative growth and its standard error."""
        pairs = self.growth.reshape(2, -1).mean(0)
        return float(pairs.mean()), float(pairs.std()) / math.sqrt(len(pairs))

    def quantile(self, level: float) -> tuple[float, float]:
        """Relative growth that a fraction `level` of the masks stays below, and its standard error.

        The error is half the distance of the order statistics one binomial standard deviation to either side, the two
        draws of a pair counted as one: cautious by up to sqrt(2) where the growth is of first order.
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
    """The rms machining error that the MSE bears.

    rms : at which the MSE has grown by `growth` [m]; infinite if it has not at a tenth of the hole diameter
    error : statistical standard error of `rms` [m]
    growth : relative growth of the MSE allowed
    kind : what errs: "position", "diameter" or "both", with the same rms
    quantile : the fraction of masks that is to stay below the growth; None: the mean of all masks is
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
    """Distribution of the MSE over masks machined with errors.

    Parameters
    ----------
    criterion : callable
        aperture -> MSE (...), such as `AsymptoticMSE`, on a grid that resolves a sub-aperture's OTF: on a coarse one a
        mask optimised there loses its place on the grid points and looks more delicate than it is.
    aperture : SparseAperture
        One mask, centres (N, 2).
    position_rms : float
        Rms error of each coordinate of each hole [m].
    diameter_rms : float
        Rms error of the diameter, common to all holes of a mask [m], at most a tenth of it. The criterion keeps its
        number of photons; that of light through the hole is not in it.
    n_draws : int
        Masks drawn, an even number of at least 16.
    generator : torch.Generator, optional

    Raises
    ------
    ValueError
        For a population of masks, sizes of errors that are negative, not finite or too large, and too few draws.
    """
    _check(aperture, n_draws)
    limit = aperture.subaperture_diameter / 10
    for name, value in (("position_rms", position_rms), ("diameter_rms", diameter_rms)):
        if not (math.isfinite(value) and 0 <= value <= limit * (1 + 1e-9)):
            raise ValueError(f"{name} is {value}: it lies between 0 and a tenth of the hole diameter, {limit:.4g} m")
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
    """The rms machining error at which the MSE has grown by `growth`.

    The same draws, scaled, serve every size of error that is tried, so their growth is a smooth function of it.

    Parameters
    ----------
    criterion, aperture, n_draws, generator
        As for `machining_errors`.
    growth : float
        Relative, positive.
    kind : {"both", "position", "diameter"}
        What errs: positions (each coordinate), the common diameter, or both with the same rms.
    quantile : float, optional
        Between 0 and 1: let this fraction of the masks stay below the growth rather than their mean.

    Raises
    ------
    ValueError
        As `machining_errors`, and for a growth that is not positive, an unknown kind or a quantile outside (0, 1).

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
    """Errors of unit rms, in pairs of either sign: of positions (n_draws, N, 2), of the common diameter (n_draws,)."""
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
        else:  # an aperture has one diameter for its whole population
            diameters = (aperture.subaperture_diameter + diameter_rms * diameter).tolist()
            masks = [aperture.replace(c, d) for c, d in zip(centers, diameters, strict=True)]
            mse = torch.stack([criterion(mask) for mask in masks])
    return MachiningErrors(position_rms, diameter_rms, nominal, mse)
