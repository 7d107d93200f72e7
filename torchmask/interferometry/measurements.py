"""Squared visibilities and closure phases of any instrument, as lists of numbers with baselines on the sky.

Signs are those of `torchmask.interferometry.observables`.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.interferometry.disc_visibility import FIRST_NULL, disc_slopes, disc_visibilities
from torchmask.record import Brief

_CERTAIN = 4.0  # errors to which a divisor is known, so that first order holds
SAME = 1e-3  # relative tolerance for equal baselines and wavelengths, as an array's projection differs between stars


@dataclass(frozen=True, eq=False, repr=False)
class Measurements(Brief):
    """B squared visibilities and C closure phases, each with its own baselines and wavelength.

    baselines : (B, 2) u and v, towards east and north [m]
    wavelengths : (B,) wavelength of each squared visibility [m]
    vis2 : (B,) squared visibilities |V|^2
    vis2_errors : (B,) their rms errors
    vis2_correlation : (B, B) correlation of the errors, or None if they are independent
    triangles : (C, 2, 2) first and second baseline of each triangle [m]; the third closes it
    triangle_wavelengths : (C,) wavelength of each closure phase [m]
    closure_phases : (C,) closure phases [rad]
    closure_errors : (C,) their rms errors [rad]
    closure_correlation : (C, C) correlation of the errors, or None if they are independent

    Raises ValueError if they disagree in shape, are not finite, or a wavelength or an error is not positive.

    Examples
    --------
    >>> none = torch.zeros(0, dtype=torch.float64)
    >>> one = torch.ones(1, dtype=torch.float64)
    >>> seen = Measurements(
    ...     torch.tensor([[3.0, 4.0]]), 2e-6 * one, 0.8 * one, 0.02 * one, None,
    ...     none.view(0, 2, 2), none, none, none, None)
    >>> bool(seen.finest == 2e-6 / 5)
    True
    """

    baselines: Tensor
    wavelengths: Tensor
    vis2: Tensor
    vis2_errors: Tensor
    vis2_correlation: Tensor | None
    triangles: Tensor
    triangle_wavelengths: Tensor
    closure_phases: Tensor
    closure_errors: Tensor
    closure_correlation: Tensor | None

    def __post_init__(self) -> None:
        n, m = len(self.vis2), len(self.closure_phases)
        shapes = {"baselines": (n, 2), "wavelengths": (n,), "vis2": (n,), "vis2_errors": (n,)}
        shapes |= {"vis2_correlation": (n, n), "triangles": (m, 2, 2), "triangle_wavelengths": (m,)}
        shapes |= {"closure_phases": (m,), "closure_errors": (m,), "closure_correlation": (m, m)}
        for name, shape in shapes.items():
            values = getattr(self, name)
            if values is None:
                continue
            if tuple(values.shape) != shape:
                raise ValueError(f"{name} has shape {tuple(values.shape)}: it must be {shape}")
            if not bool(torch.isfinite(values).all()):
                raise ValueError(f"{name} holds values that are not finite: leave those measurements out")
        for name in ("wavelengths", "triangle_wavelengths", "vis2_errors", "closure_errors"):
            values = getattr(self, name)
            if not bool((values > 0).all()):
                raise ValueError(f"{name} holds {float(values.min()):g}: all must be positive")

    @property
    def frequencies(self) -> Tensor:
        """Spatial frequencies (B, 2) of the baselines [cycles per radian]."""
        return self.baselines / self.wavelengths[:, None]

    @property
    def triangle_frequencies(self) -> Tensor:
        """Spatial frequencies (C, 3, 2) of the three baselines of every triangle [cycles per radian], of sum 0."""
        sides = torch.cat([self.triangles, -self.triangles.sum(1, keepdim=True)], 1)
        return sides / self.triangle_wavelengths[:, None, None]

    @property
    def finest(self) -> float:
        """Smallest wavelength over baseline length of all measurements [rad]."""
        return 1 / float(self._lengths().max())

    @property
    def widest(self) -> float:
        """Largest wavelength over baseline length of all measurements [rad]."""
        return 1 / float(self._lengths().min())

    def _lengths(self) -> Tensor:
        """Return moduli of the spatial frequencies of all baselines [cycles per radian]."""
        every = torch.cat([self.frequencies, self.triangle_frequencies.flatten(0, 1)])
        return torch.linalg.vector_norm(every, dim=1)

    def closures_only(self) -> Measurements:
        """Return the closure phases alone, which need no calibration of the contrast."""
        none = slice(0, 0)
        return replace(
            self,
            baselines=self.baselines[none],
            wavelengths=self.wavelengths[none],
            vis2=self.vis2[none],
            vis2_errors=self.vis2_errors[none],
            vis2_correlation=None,
        )

    def calibrate(self, star: Measurements, diameter: float = 0.0, diameter_error: float = 0.0) -> Measurements:
        """Calibrate with the measurements of a star of known diameter, and propagate the errors of both.

        |V|^2 is divided by the star's, as a point would have them, and its closure phases are subtracted. Baselines are
        those of the object.

        Parameters
        ----------
        star : Measurements
            Measurements of a star on the same baselines.
        diameter, diameter_error : float
            Angular diameter of the star, a uniform disc, and its rms error [rad], which all |V|^2 share.

        Raises
        ------
        ValueError
            If the star was not seen on the same baselines and at the same wavelengths in the same order, or shows no
            fringes on one of them, or the diameter is negative or so large that a disc shows none.

        Warns
        -----
        UserWarning
            As `warn_of_faint_star` does.
        """
        _require_same(self, star)
        visibilities, slopes = known_disc(star.frequencies, diameter, diameter_error)
        dark = int((star.vis2 <= 0).sum())
        if dark:
            raise ValueError(
                f"the star shows no fringes on {dark} of {len(star.vis2)} baselines: use a brighter star, or more "
                "frames of it"
            )
        warn_of_faint_star(star.vis2, star.vis2_errors, stacklevel=2)
        point = star.vis2 / visibilities**2
        ratio, common = self.vis2 / point, 2 * slopes / visibilities
        own, its = (_covariance(each.vis2_errors, each.vis2_correlation) for each in (self, star))
        its = its / (star.vis2[:, None] * star.vis2) + common[:, None] * common
        vis2 = own / (point[:, None] * point) + ratio[:, None] * ratio * its
        one, other = (_covariance(each.closure_errors, each.closure_correlation) for each in (self, star))
        closure = one + other
        phases = self.closure_phases - star.closure_phases
        return replace(
            self,
            vis2=ratio,
            vis2_errors=vis2.diagonal().sqrt(),
            vis2_correlation=correlation(vis2),
            closure_phases=torch.atan2(phases.sin(), phases.cos()),
            closure_errors=closure.diagonal().sqrt(),
            closure_correlation=correlation(closure),
        )


def join(measurements: Sequence[Measurements]) -> Measurements:
    """Join sets of measurements, with independent errors between sets. Raises ValueError if there are none."""
    if not measurements:
        raise ValueError("measurements is empty: give at least one")
    names = ("baselines", "wavelengths", "vis2", "vis2_errors")
    names += ("triangles", "triangle_wavelengths", "closure_phases", "closure_errors")
    together = {name: torch.cat([getattr(each, name) for each in measurements]) for name in names}
    return Measurements(
        **together,
        vis2_correlation=_blocks([(len(each.vis2), each.vis2_correlation) for each in measurements]),
        closure_correlation=_blocks([(len(each.closure_phases), each.closure_correlation) for each in measurements]),
    )


def known_disc(frequencies: Tensor, diameter: float, error: float) -> tuple[Tensor, Tensor]:
    """Return visibilities (F,) of a uniform disc at frequencies (F, 2) [cycles per rad], and their common error (F,).

    Raises ValueError unless diameter and error [rad] are not negative, and all baselines are within its first null.
    """
    if not (diameter >= 0 and error >= 0):
        raise ValueError(f"the star's diameter is {diameter:g} +- {error:g} rad: neither must be negative")
    null = FIRST_NULL / float(torch.linalg.vector_norm(frequencies, dim=1).max()) if len(frequencies) else math.inf
    if not diameter + error < null:
        raise ValueError(
            f"the star's diameter is {diameter:g} +- {error:g} rad: a disc of {null:.3g} shows no fringes on the "
            "longest baseline, so a smaller star is needed"
        )
    return disc_visibilities(frequencies, diameter), error * disc_slopes(frequencies, diameter)


def warn_of_faint_star(vis2: Tensor, errors: Tensor, stacklevel: int) -> None:
    """Warn if |V|^2 (B,) of a star, by which others are divided, is known to less than four of its errors somewhere.

    The error of a quotient is that to first order, which no longer holds. The warning is issued as if `stacklevel`
    calls above.
    """
    faint = int((vis2 < _CERTAIN * errors).sum())
    if faint:
        warnings.warn(
            f"|V|^2 of the star is known to fewer than {_CERTAIN:g} of its errors on {faint} of {len(vis2)} baselines: "
            "what is divided by it has errors that are too small, and may show companions that are not there, so use "
            "a brighter star, more frames of it, or closure phases alone",
            stacklevel=stacklevel + 1,
        )


def correlation(covariance: Tensor) -> Tensor | None:
    """Return the correlation of a covariance (M, M) with a positive diagonal; None if that is diagonal."""
    scale = covariance.diagonal().rsqrt()
    found = covariance * scale[:, None] * scale
    return None if bool((found == found.diagonal().diag()).all()) else found


def _blocks(parts: Sequence[tuple[int, Tensor | None]]) -> Tensor | None:
    if all(part is None for _, part in parts):
        return None
    return torch.block_diag(*(torch.eye(n, dtype=torch.float64) if part is None else part for n, part in parts))


def _covariance(errors: Tensor, correlations: Tensor | None) -> Tensor:
    return (errors**2).diag() if correlations is None else errors[:, None] * errors * correlations


def _require_same(seen: Measurements, star: Measurements) -> None:
    for name in ("frequencies", "triangle_frequencies"):
        lengths = [torch.linalg.vector_norm(getattr(each, name), dim=-1) for each in (seen, star)]
        if lengths[0].shape != lengths[1].shape or not torch.allclose(*lengths, rtol=SAME, atol=0):
            raise ValueError(
                f"the star was observed differently: its {len(star.vis2)} baselines and {len(star.closure_phases)} "
                f"triangles and the {len(seen.vis2)} and {len(seen.closure_phases)} of the object must be the same, at "
                "the same wavelengths, in the same order"
            )
