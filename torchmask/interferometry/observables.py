"""Interferometric observables of every baseline and triangle of a mask.

Signs, as in OIFITS (Pauls et al. 2005, PASP 117, 1255; Duvert et al. 2017, A&A 597, A8): the visibility of a brightness
I(E, N), east and north in radians, on the baseline (u, v) metres is

    V = integral I exp(-2 pi i (u E + v N) / wavelength) / integral I,

(u, v) of the pair (i, j) is centre j minus centre i, turned from the axes of the image to those of the sky, and the
closure phase of the triangle (i, j, k) is arg(V_ij V_jk V_ki).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchmask.interferometry.measurements import SAME, Measurements, correlation, known_disc, warn_of_faint_star
from torchmask.record import Brief


@dataclass(frozen=True, eq=False, repr=False)
class Observables(Brief):
    """Visibilities of B = N (N - 1) / 2 baselines and closure phases of C = N (N - 1) (N - 2) / 6 triangles.

    pairs : (B, 2) holes i < j of each baseline
    triangles : (C, 3) holes i < j < k of each triangle
    stations : (N, 2) centres of the holes, (u, v) towards east and north [m]
    visibilities : (B,) complex visibilities, which include pistons if measured on frames
    visibility_errors : (B,) rms error of the amplitude, and of the phase times the amplitude
    vis2 : (B,) squared visibilities |V|^2
    vis2_covariance : (B, B) covariance of |V|^2
    closure_phases : (C,) closure phases [rad]
    closure_covariance : (C, C) covariance of the closure phases; triangles share baselines, so that for four or more
        holes it is singular unless each triangle has independent noise
    triple_amplitudes : (C,) amplitudes |V_ij V_jk V_ki|
    triple_covariance : (C, C) covariance of the triple amplitudes

    Examples
    --------
    >>> stations = torch.tensor([[0.0, 0.4], [-0.35, -0.2]], dtype=torch.float64)
    >>> one, none = torch.ones(1, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    >>> point = Observables(
    ...     torch.tensor([[0, 1]]), torch.zeros(0, 3, dtype=torch.int64), stations, one + 0j, 0.01 * one,
    ...     one, 0.0004 * one[:, None], none, none[:, None], none, none[:, None])
    >>> float(point.vis2[0]), float(point.vis2_errors[0])
    (1.0, 0.02)
    """

    pairs: Tensor
    triangles: Tensor
    stations: Tensor
    visibilities: Tensor
    visibility_errors: Tensor
    vis2: Tensor
    vis2_covariance: Tensor
    closure_phases: Tensor
    closure_covariance: Tensor
    triple_amplitudes: Tensor
    triple_covariance: Tensor

    @property
    def vis2_errors(self) -> Tensor:
        """Rms errors of |V|^2 (B,)."""
        return self.vis2_covariance.diagonal().sqrt()

    @property
    def closure_errors(self) -> Tensor:
        """Rms errors of the closure phases (C,) [rad]."""
        return self.closure_covariance.diagonal().sqrt()

    @property
    def triple_errors(self) -> Tensor:
        """Rms errors of the triple amplitudes (C,)."""
        return self.triple_covariance.diagonal().sqrt()

    @property
    def baselines(self) -> Tensor:
        """Baseline (u, v) of each pair (B, 2) [m]."""
        return self.stations[self.pairs[:, 1]] - self.stations[self.pairs[:, 0]]

    def measurements(self, wavelength: float) -> Measurements:
        """Return |V|^2 and closure phases as `Measurements`, as `load_oifits` reads them from a file.

        Raises ValueError if the wavelength [m] or an error is not positive.
        """
        first, second, third = (self.stations[self.triangles[:, side]] for side in range(3))
        return Measurements(
            baselines=self.baselines,
            wavelengths=torch.full_like(self.vis2, wavelength),
            vis2=self.vis2,
            vis2_errors=self.vis2_errors,
            vis2_correlation=correlation(self.vis2_covariance),
            triangles=torch.stack([second - first, third - second], 1),
            triangle_wavelengths=torch.full_like(self.closure_phases, wavelength),
            closure_phases=self.closure_phases,
            closure_errors=self.closure_errors,
            closure_correlation=correlation(self.closure_covariance),
        )

    def calibrate(
        self, star: Observables, diameter: float = 0.0, diameter_error: float = 0.0, wavelength: float | None = None
    ) -> Observables:
        """Calibrate with the observables of a star of known diameter, which removes losses of contrast common to both.

        |V|^2 and triple amplitudes are divided by the star's, as a point would have them, and its closure phases are
        subtracted. Complex visibilities are divided too, which is meaningful only for stable pistons. Errors and
        covariances of both are propagated to first order. Directions on the sky are those of the object.

        Parameters
        ----------
        star : Observables
            Observables of a star with the same mask and band, by the same function.
        diameter, diameter_error : float
            Angular diameter of the star, a uniform disc, and its rms error [rad], which all baselines share.
        wavelength : float, optional
            Wavelength of the light [m], which a diameter needs.

        Raises
        ------
        ValueError
            If the star was observed with another mask, or has no fringes on some baseline, or its diameter has no
            wavelength, is negative or so large that a disc shows no fringes.

        Warns
        -----
        UserWarning
            If |V|^2 of the star is known to less than four of its errors on some baseline (`warn_of_faint_star`).

        Examples
        --------
        >>> stations = torch.tensor([[0.0, 0.4], [-0.35, -0.2]], dtype=torch.float64)
        >>> one, none = torch.ones(1, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
        >>> def seen(vis2):
        ...     return Observables(
        ...         torch.tensor([[0, 1]]), torch.zeros(0, 3, dtype=torch.int64), stations, (vis2 * one).sqrt() + 0j,
        ...         0.01 * one, vis2 * one, 1e-4 * one[:, None], none, none[:, None], none, none[:, None])
        >>> binary = seen(0.4).calibrate(seen(0.8))
        >>> round(float(binary.vis2[0]), 6), round(float(binary.vis2_errors[0]), 6)  # (0.01 / 0.8) (1 + 0.5^2)^(1/2)
        (0.5, 0.013975)
        """
        self._require_same_mask(star)
        dark = (star.vis2 <= 0).nonzero().flatten().tolist()
        if dark:
            names = ", ".join("-".join(map(str, self.pairs[index].tolist())) for index in dark)
            raise ValueError(f"the star shows no fringes of holes {names}: use a brighter star, or more frames of it")
        warn_of_faint_star(star.vis2, star.vis2_errors, stacklevel=2)
        star = star._as_point(diameter, diameter_error, wavelength)
        vis2, vis2_covariance = _divide(self.vis2, self.vis2_covariance, star.vis2, star.vis2_covariance)
        triple, triple_covariance = _divide(
            self.triple_amplitudes, self.triple_covariance, star.triple_amplitudes, star.triple_covariance
        )
        phases = self.closure_phases - star.closure_phases
        size = star.visibilities.abs()
        values = self.visibilities / star.visibilities
        return replace(
            self,
            visibilities=values,
            visibility_errors=torch.hypot(self.visibility_errors, values.abs() * star.visibility_errors) / size,
            vis2=vis2,
            vis2_covariance=vis2_covariance,
            closure_phases=torch.atan2(phases.sin(), phases.cos()),
            closure_covariance=self.closure_covariance + star.closure_covariance,
            triple_amplitudes=triple,
            triple_covariance=triple_covariance,
        )

    def _as_point(self, diameter: float, error: float, wavelength: float | None) -> Observables:
        """Return the observables divided by those of a uniform disc, whose error all of them share."""
        if diameter == error == 0:
            return self
        if wavelength is None:
            raise ValueError("the star's diameter needs the wavelength [m]: give it too")
        visibilities, errors = known_disc(self.baselines / wavelength, diameter, error)
        relative = errors / visibilities
        index = {tuple(pair): number for number, pair in enumerate(self.pairs.tolist())}
        sides = [[index[i, j], index[j, k], index[i, k]] for i, j, k in self.triangles.tolist()]
        of_triangle = torch.tensor(sides, dtype=torch.int64).view(-1, 3)
        triple = visibilities[of_triangle].prod(1)
        return replace(
            self,
            visibilities=self.visibilities / visibilities,
            visibility_errors=torch.hypot(self.visibility_errors, self.visibilities.abs() * relative) / visibilities,
            vis2=self.vis2 / visibilities**2,
            vis2_covariance=_widen(self.vis2, self.vis2_covariance, visibilities**2, 2 * relative),
            triple_amplitudes=self.triple_amplitudes / triple,
            triple_covariance=_widen(
                self.triple_amplitudes, self.triple_covariance, triple, relative[of_triangle].sum(1)
            ),
        )

    def _require_same_mask(self, star: Observables) -> None:
        lengths = [torch.linalg.vector_norm(each.baselines, dim=1) for each in (self, star)]
        same = torch.equal(self.pairs, star.pairs) and torch.equal(self.triangles, star.triangles)
        if not (same and torch.allclose(*lengths, rtol=SAME, atol=0)):
            raise ValueError(
                f"the star was seen through another mask: its {len(star.stations)} holes and the "
                f"{len(self.stations)} of the object must be the same, in the same order"
            )


def _divide(values: Tensor, covariance: Tensor, by: Tensor, by_covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Return values / by (M,) and its covariance (M, M), to first order."""
    ratio, outer = values / by, by[:, None] * by
    return ratio, (covariance + ratio[:, None] * ratio * by_covariance) / outer


def _widen(values: Tensor, covariance: Tensor, by: Tensor, relative: Tensor) -> Tensor:
    """Return the covariance (M, M) of values / by (M,), where `by` has `relative` errors (M,) of one cause."""
    common = values * relative
    return (covariance + common[:, None] * common) / (by[:, None] * by)
