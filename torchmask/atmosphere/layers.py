"""Layers of turbulence with heights, strengths and winds, and the scales r0, theta0 and tau0 that follow from them.

The scales are those of Kolmogorov turbulence in closed form (Fried, J. Opt. Soc. Am. 56, 1372, 1966, and 72, 52, 1982;
Greenwood, J. Opt. Soc. Am. 67, 390, 1977; Roddier, Progress in Optics 19, 281, 1981, sections 7 and 8), with constants
that follow from the definition of r0. Propagation is geometrical: scintillation is neglected.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT, von_karman_structure_function
from torchmask.grid import ARCSEC
from torchmask.numbers import whole_number

_PATH = (
    math.sqrt(math.pi) * math.gamma(-5 / 6) / math.gamma(-1 / 3)
)  # 2.9144, the constant of D(r) = 2.91 k^2 r^(5/3) C_n^2 dh
_SERVO = (math.gamma(8 / 3) / 2) ** (3 / 5) / (2 * math.pi)  # 0.134, Greenwood frequency times tau0

Vector = tuple[float, float]


@dataclass(frozen=True)
class Layers:
    """Thin layers of turbulence between a telescope and the sky.

    Parameters
    ----------
    heights : sequence of L floats
        Distance of each layer from the telescope along the line of sight [m].
    strengths : sequence of L floats
        C_n^2 dh of each layer [m^(1/3)].
    winds : sequence of L pairs (vx, vy), optional
        Wind velocity of each layer across the line of sight [m/s]; positive values carry the phase towards +x and +y.
        By default there is no wind.

    Raises
    ------
    ValueError
        If there is no layer, the lengths differ, a number is not finite, a height is negative or a strength is not
        positive.

    Examples
    --------
    >>> from torchmask.atmosphere.profiles import named_layers
    >>> layers = named_layers("hv57")
    >>> f"r0 {100 * layers.r0(500e-9):.2f} cm, theta0 {1e6 * layers.theta0(500e-9):.2f} microrad"
    'r0 4.96 cm, theta0 6.89 microrad'
    >>> f"{100 * layers.at_airmass(2.0).r0(500e-9):.2f} cm at 60 degrees from the zenith"
    '3.27 cm at 60 degrees from the zenith'
    """

    heights: Sequence[float]
    strengths: Sequence[float]
    winds: Sequence[Vector] = ()

    def __post_init__(self) -> None:
        heights, strengths = (tuple(float(v) for v in values) for values in (self.heights, self.strengths))
        still = [(0.0, 0.0)] * len(heights)
        winds = tuple((float(vx), float(vy)) for vx, vy in (self.winds if len(self.winds) else still))
        if not len(heights) == len(strengths) == len(winds) > 0:
            given = f"{len(heights)} heights, {len(strengths)} strengths and {len(winds)} winds"
            raise ValueError(f"got {given}: give one of each for every layer, and at least one layer")
        for name, values, fits, unit in (
            ("heights", heights, lambda v: v >= 0, "at least 0, in m"),
            ("strengths", strengths, lambda v: v > 0, "positive, in m^(1/3)"),
            ("winds", sum(winds, ()), lambda v: True, "pairs (vx, vy), in m/s"),
        ):
            if not all(math.isfinite(v) and fits(v) for v in values):
                raise ValueError(f"{name} are {getattr(self, name)}: they must be finite and {unit}")
        object.__setattr__(self, "heights", heights)
        object.__setattr__(self, "strengths", strengths)
        object.__setattr__(self, "winds", winds)

    @classmethod
    def from_fractions(
        cls,
        r0: float,
        wavelength: float,
        heights: Sequence[float],
        fractions: Sequence[float],
        winds: Sequence[Vector] = (),
    ) -> Layers:
        """Create layers from their fractions of the strength and the Fried parameter `r0` [m] at `wavelength` [m].

        Fractions need not add up to 1: only their ratios matter. Raises ValueError as the constructor does, and if
        `r0`, `wavelength` or the sum of the fractions is not finite and positive.
        """
        known = (
            ("r0", r0, ", in m"),
            ("wavelength", wavelength, ", in m"),
            ("sum of fractions", math.fsum(fractions), ""),
        )
        for name, value, unit in known:
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"{name} is {value}: it must be finite and positive{unit}")
        total = STRUCTURE_CONSTANT / _PATH * (wavelength / (2 * math.pi)) ** 2 * r0 ** (-5 / 3)
        return cls(heights, [total * share / math.fsum(fractions) for share in fractions], winds)

    def at_airmass(self, airmass: float) -> Layers:
        """Return the same layers seen at `airmass` = 1 / cos(zenith distance), which scales heights and strengths.

        Heights become distances along the line of sight. Winds are kept, as their components across the line of sight
        depend on the azimuth. Raises ValueError if `airmass` is not finite or is below 1.
        """
        if not (math.isfinite(airmass) and airmass >= 1):
            raise ValueError(f"airmass is {airmass}: it must be finite and at least 1, which is the zenith")
        return Layers([airmass * h for h in self.heights], [airmass * s for s in self.strengths], self.winds)

    def grouped(self, n_layers: int) -> Layers:
        """Merge neighbouring layers into at most `n_layers`, preserving r0, theta0 and tau0 exactly.

        Every group has about the same share of the turbulence, where half of the share is strength and half is the
        contribution to theta0. The height and the wind speed of a group are 5/3-power means over its members, weighted
        by strength; its wind has the direction of their mean wind.

        Raises ValueError if `n_layers` is not a whole number of at least 1.
        """
        n_layers = whole_number("n_layers", n_layers)
        if n_layers >= len(self.heights):
            return self
        order = np.argsort(self.heights, kind="stable")
        height, strength = np.array(self.heights)[order], np.array(self.strengths)[order]
        wind = np.array(self.winds)[order]
        high = strength * height ** (5 / 3)
        share = strength / strength.sum() + high / max(high.sum(), np.finfo(float).tiny)
        middle = (np.cumsum(share) - share / 2) / share.sum()
        group = np.minimum((middle * n_layers).astype(int), n_layers - 1)
        merged = []
        for members in (group == g for g in np.unique(group)):
            weight = strength[members] / strength[members].sum()
            mean = weight @ wind[members]
            speed = (weight @ np.hypot(*wind[members].T) ** (5 / 3)) ** 0.6
            way = mean / np.hypot(*mean) if mean.any() else np.array([1.0, 0.0])
            merged.append(((weight @ height[members] ** (5 / 3)) ** 0.6, strength[members].sum(), tuple(speed * way)))
        heights, strengths, winds = zip(*merged, strict=True)
        return Layers(heights, strengths, winds)

    def _coherent(self, wavelength: float, lengths: Sequence[float]) -> float:
        """Return the factor on `lengths`, one for each layer, at which two rays differ by 1 rad^2 in phase."""
        if not (math.isfinite(wavelength) and wavelength > 0):
            raise ValueError(f"wavelength is {wavelength}: it must be finite and positive, in m")
        total = math.fsum(s * x ** (5 / 3) for s, x in zip(self.strengths, lengths, strict=True))
        return (_PATH * (2 * math.pi / wavelength) ** 2 * total) ** -0.6 if total > 0 else math.inf

    def r0(self, wavelength: float) -> float:
        """Return the Fried parameter [m] at `wavelength` [m]: (0.423 k^2 sum C_n^2 dh)^(-3/5), k = 2 pi/wavelength."""
        return STRUCTURE_CONSTANT**0.6 * self._coherent(wavelength, [1.0] * len(self.heights))

    def layer_r0(self, wavelength: float) -> tuple[float, ...]:
        """Return the Fried parameter of each layer alone [m]; their -5/3 powers add up to that of the total r0."""
        return tuple(Layers([h], [s]).r0(wavelength) for h, s in zip(self.heights, self.strengths, strict=True))

    def theta0(self, wavelength: float) -> float:
        """Return the isoplanatic angle [rad] at `wavelength` [m]: [2.91 k^2 sum C_n^2 dh h^(5/3)]^(-3/5).

        The mean square phase difference of two stars at this angle is 1 rad^2 if the outer scale is infinite.
        """
        return self._coherent(wavelength, self.heights)

    def tau0(self, wavelength: float) -> float:
        """Return the coherence time [s] at `wavelength` [m]: [2.91 k^2 sum C_n^2 dh v^(5/3)]^(-3/5).

        In this time the phase at a point of the pupil changes by 1 rad^2, mean square, if the outer scale is infinite.
        """
        return self._coherent(wavelength, [math.hypot(*wind) for wind in self.winds])

    def greenwood_frequency(self, wavelength: float) -> float:
        """Return the Greenwood frequency [Hz] at `wavelength` [m]: 0.134 / tau0.

        It is the bandwidth at which a first-order servo leaves a residual phase variance of 1 rad^2.
        """
        return _SERVO / self.tau0(wavelength)

    def structure_function(
        self,
        wavelength: float,
        outer_scale: float = math.inf,
        *,
        baseline: Tensor | Vector = (0.0, 0.0),
        direction: Tensor | Vector = (0.0, 0.0),
        delay: Tensor | float = 0.0,
    ) -> Tensor:
        """Return the mean square phase difference [rad^2] of two rays under frozen flow.

        Parameters
        ----------
        wavelength : float
            Wavelength of the light [m].
        outer_scale : float
            Outer scale of the turbulence [m]; infinite, the default, for Kolmogorov turbulence.
        baseline : (..., 2) tensor or (x, y)
            Separation of the two rays in the pupil [m].
        direction : (..., 2) tensor or (x, y)
            Angle between the stars from which the rays come [rad].
        delay : (...) tensor or float
            Time between the two rays [s].

        Returns
        -------
        Tensor
            (...), float64: the sum over the layers of D(|baseline + h direction - v delay|). It is computed on the CPU
            and not differentiable.

        Examples
        --------
        >>> from torchmask.atmosphere.profiles import named_layers
        >>> layers = named_layers("hv57")
        >>> theta0 = layers.theta0(500e-9)
        >>> round(float(layers.structure_function(500e-9, direction=(theta0, 0.0))), 6)
        1.0
        >>> round(float(layers.structure_function(500e-9, 20.0, direction=(theta0, 0.0))), 2)
        0.77
        """
        like = {"dtype": torch.float64, "device": "cpu"}
        start, angle = (torch.as_tensor(v, **like)[..., None, :] for v in (baseline, direction))
        later = torch.as_tensor(delay, **like)[..., None, None]
        heights, winds = (torch.tensor(values, **like) for values in (self.heights, self.winds))
        distance = torch.linalg.vector_norm(start + heights[:, None] * angle - winds * later, dim=-1)  # (..., L)
        total = torch.zeros(distance.shape[:-1], **like)
        for away, r0 in zip(distance.unbind(-1), self.layer_r0(wavelength), strict=True):
            if math.isinf(outer_scale):
                total += STRUCTURE_CONSTANT * (away / r0) ** (5 / 3)
            else:
                total += von_karman_structure_function(away, r0, outer_scale)
        return total

    def describe(self, wavelength: float) -> str:
        """Return Markdown tables of the layers and of their scales at `wavelength` [m]."""
        rows = [("height", "share", "wind"), ("---", "---", "---")]
        for h, s, wind in zip(self.heights, self.strengths, self.winds, strict=True):
            rows.append((f"{h:.0f} m", f"{s / math.fsum(self.strengths):.3f}", f"{math.hypot(*wind):.1f} m/s"))
        theta0 = self.theta0(wavelength)
        rows += [("", "", ""), ("quantity", "value", "of"), ("---", "---", "---")]
        rows += [
            ("r0", f"{100 * self.r0(wavelength):.4g} cm", "Fried parameter"),
            ("theta0", f"{1e6 * theta0:.4g} microrad = {theta0 / ARCSEC:.4g} arcsec", "isoplanatic angle"),
            ("tau0", f"{1e3 * self.tau0(wavelength):.4g} ms", "coherence time"),
            ("f_G", f"{self.greenwood_frequency(wavelength):.4g} Hz", "Greenwood frequency"),
        ]
        return "\n".join(f"| {' | '.join(row)} |" if any(row) else "" for row in rows)
