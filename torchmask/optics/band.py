"""The band of light that reaches the detector, represented by a few wavelengths."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from torchmask.numbers import require_wavelength, whole_number
from torchmask.optics.passband import Passband, check_curve

MOST_WAVELENGTHS = 32  # largest number of wavelengths, far more than any image needs
_NANOMETRES = 100.0  # from here on wavelengths were meant in nm; below, they may be in the free units of a grid
_NEAR = 1e3  # times the wavelength of a grid: light further from it is in another unit
# Relative width of a band for which one wavelength stands, and for which each one more does: predicted errors are then
# within 4 % of those of nine wavelengths (masks of 6 and 9 holes, fill factors 0.02 to 0.15, D/r0 = 7).
_ALONE, _EACH = 0.05, 0.15


@dataclass(frozen=True)
class Band:
    """Wavelengths [m] and the share of the detected light at each; the shares sum to 1.

    Examples
    --------
    >>> Band.of([500e-9, 600e-9], [1.0, 3.0]).shares
    (0.25, 0.75)
    """

    wavelengths: tuple[float, ...]
    shares: tuple[float, ...]

    @classmethod
    def of(cls, wavelengths: Sequence[float], weights: Sequence[float] | None = None) -> Band:
        """Return the band of these wavelengths [m], with light in proportion to `weights`, equal by default.

        Equal wavelengths become one, with all their light.

        Raises ValueError if there is no wavelength, the numbers differ, or a value is not finite and positive, or
        wavelengths are in nanometres, and TypeError for a single number.
        """
        if np.ndim(wavelengths) == 0:  # type: ignore[arg-type]
            raise TypeError(f"wavelengths is {wavelengths}: a sequence is needed, such as [{wavelengths}]")
        shares = [1.0] * len(wavelengths) if weights is None else [float(weight) for weight in weights]
        if not len(wavelengths) or len(shares) != len(wavelengths):
            raise ValueError(
                f"{len(wavelengths)} wavelengths have {len(shares)} weights: as many, and at least 1, are needed"
            )
        for name, values, unit in (("wavelengths", wavelengths, ", in m"), ("weights", shares, ", in any unit")):
            if not all(math.isfinite(value) and value > 0 for value in values):
                raise ValueError(f"{name} are {list(values)}: they must be finite and positive{unit}")
        if (longest := float(max(wavelengths))) >= _NANOMETRES:
            require_wavelength("the longest of wavelengths", longest)
        total, light = sum(shares), dict.fromkeys(map(float, wavelengths), 0.0)
        for wavelength, share in zip(wavelengths, shares, strict=True):
            light[float(wavelength)] += share / total
        return cls(tuple(light), tuple(light.values()))

    @classmethod
    def given(cls, band: Band | None, wavelength: float) -> Band:
        """Return the band, or if there is none that of the `wavelength` of a grid [the unit of the band's] alone.

        Raises ValueError if the band is so far from the grid's wavelength that they must be in different units.
        """
        if band is None:
            return cls.of([wavelength])
        if not wavelength / _NEAR <= band.mean <= wavelength * _NEAR:
            raise ValueError(
                f"wavelengths are {list(band.wavelengths)}, but that of the grid is {wavelength:g}: give both in m "
                "(550 nm are 550e-9)"
            )
        return band

    @classmethod
    def of_curve(cls, wavelengths: Sequence[float], transmission: Sequence[float], n_wavelengths: int = 5) -> Band:
        """Represent a transmission curve by a few wavelengths, by Gauss quadrature.

        The mean over the band of any polynomial in wavelength of degree 2 n_wavelengths - 1 or less is exact (Golub &
        Welsch, Math. Comp. 23, 221, 1969). An image needs 3 wavelengths for a width of 5 %, and 5 for 15 %.

        Parameters
        ----------
        wavelengths : sequence of float
            Increasing wavelengths of the curve [m], which is linear in between and zero outside.
        transmission : sequence of float
            Relative detected light at each wavelength: transmission of filter, telescope and detector, times the
            spectrum of the object.
        n_wavelengths : int
            Number of wavelengths of the band.

        Raises
        ------
        ValueError
            If the sequences differ in length or have fewer than 2 values, wavelengths are not positive and increasing,
            the transmission is negative, not finite or nowhere positive, or `n_wavelengths` is not a whole number from
            1 to 32.

        Examples
        --------
        >>> band = Band.of_curve([500e-9, 600e-9], [1.0, 1.0], 2)  # Gauss & Legendre: 1 / sqrt(3) to both sides
        >>> [round(1e9 * wavelength, 3) for wavelength in band.wavelengths]
        [521.132, 578.868]
        """
        nodes, weights = np.asarray(wavelengths, dtype=float), np.asarray(transmission, dtype=float)
        check_curve(nodes, weights)
        n_wavelengths = whole_number("n_wavelengths", n_wavelengths, most=MOST_WAVELENGTHS)
        found, shares = _gauss_quadrature(*_fine_samples(nodes, weights), n_wavelengths)
        return cls.of(found.tolist(), shares.tolist())

    @classmethod
    def top_hat(cls, wavelength: float, width: float, n_wavelengths: int = 5) -> Band:
        """Return the top-hat band of `width` [m] around `wavelength` [m]. Raises the errors of `Passband.top_hat`.

        Examples
        --------
        >>> len(Band.top_hat(550e-9, 80e-9, 3).wavelengths)
        3
        """
        return cls.from_filter(Passband.top_hat(wavelength, width), n_wavelengths)

    @classmethod
    def from_filter(cls, name: str | Path | Passband, n_wavelengths: int = 5, temperature: float | None = None) -> Band:
        """Represent a filter by a few wavelengths. Raises the errors of `Passband.find` and `of_curve`.

        Parameters
        ----------
        name : str, path or Passband
            Name of a filter such as "bessell-V" (extra `filters`), or a text file of wavelengths [m] and transmission.
        n_wavelengths : int
            Number of wavelengths of the band.
        temperature : float, optional
            Temperature of a black-body spectrum [K], such as 5772 for sunlight. By default there are equally many
            photons at each wavelength.

        Examples
        --------
        >>> band = Band.from_filter("bessell-V", n_wavelengths=3)
        >>> [round(1e9 * wavelength) for wavelength in band.wavelengths]
        [511, 565, 637]
        """
        passband = name if isinstance(name, Passband) else Passband.find(name)
        wavelengths, light = passband.light(temperature)
        return cls.of_curve(wavelengths.tolist(), light.tolist(), n_wavelengths)

    @property
    def shortest(self) -> float:
        """Shortest wavelength [m], whose image is sampled most coarsely."""
        return min(self.wavelengths)

    @property
    def width(self) -> float:
        """Width [m] of the top hat with the same scatter of wavelengths; 0 for a single one.

        >>> round(1e9 * Band.top_hat(550e-9, 55e-9).width, 6)
        55.0
        """
        mean, pairs = self.mean, zip(self.wavelengths, self.shares, strict=True)
        return math.sqrt(12 * math.fsum(share * (wavelength - mean) ** 2 for wavelength, share in pairs))

    @property
    def relative_width(self) -> float:
        """The width over the mean wavelength.

        >>> round(Band.top_hat(550e-9, 55e-9).relative_width, 6)
        0.1
        """
        return self.width / self.mean

    @property
    def mean(self) -> float:
        """Mean wavelength of the light [m].

        >>> round(1e9 * Band.of([500e-9, 600e-9], [3, 1]).mean, 6)
        525.0
        """
        return math.fsum(share * wavelength for wavelength, share in zip(self.wavelengths, self.shares, strict=True))


def warn_of_few_wavelengths(passband: Passband, n_wavelengths: int, temperature: float | None = None) -> None:
    """Warn if so few wavelengths stand for a filter that predicted errors are wrong, and say how many do.

    The light is that of a black body of `temperature` [K]; None: equally many photons at each wavelength.
    """
    width = Band.from_filter(passband, 2, temperature).relative_width
    enough = 1 + max(0, math.ceil((width - _ALONE) / _EACH - 1e-9))
    if n_wavelengths >= enough:
        return
    warnings.warn(
        f"n_wavelengths is {n_wavelengths} for a band {100 * width:.3g} % wide: predicted errors are wrong by several "
        f"percent; {enough} wavelengths do",
        stacklevel=1,  # one place in all, so that a warning that many copies of an instrument give is shown once
    )


def _fine_samples(wavelengths: np.ndarray, transmission: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return nodes and weights that integrate the piecewise linear curve times a polynomial exactly."""
    places, weights = np.polynomial.legendre.leggauss(MOST_WAVELENGTHS + 1)
    half = np.diff(wavelengths)[:, None] / 2
    nodes = wavelengths[:-1, None] + half * (1 + places)
    return nodes.ravel(), (half * weights * np.interp(nodes, wavelengths, transmission)).ravel()


def _gauss_quadrature(nodes: np.ndarray, weights: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the n nodes and weights of the Gauss quadrature of a measure on many `nodes`, by Lanczos' recurrence."""
    middle, half = (nodes[-1] + nodes[0]) / 2, (nodes[-1] - nodes[0]) / 2
    x, vectors, jacobi = (nodes - middle) / half, [np.sqrt(weights / weights.sum())], np.zeros((n, n))
    for step in range(n):
        following = x * vectors[step]
        jacobi[step, step] = following @ vectors[step]
        for vector in vectors * 2:  # orthogonalising twice removes rounding errors
            following = following - (following @ vector) * vector
        if step + 1 < n:
            jacobi[step, step + 1] = jacobi[step + 1, step] = np.linalg.norm(following)
            vectors.append(following / jacobi[step, step + 1])
    places, rotation = np.linalg.eigh(jacobi)
    return middle + half * places, rotation[0] ** 2


class Filter(NamedTuple):
    """A filter's effective wavelength and its width [m]."""

    wavelength: float
    width: float


# Source: table of the aperture-masking filters in AMICAL (Soulain et al. 2020, SPIE 11446, 1144611), after STScI's
# NIRISS documentation.
FILTERS = {
    ("NIRISS", "F277W"): Filter(2.776e-6, 0.715e-6),
    ("NIRISS", "F380M"): Filter(3.828e-6, 0.205e-6),
    ("NIRISS", "F430M"): Filter(4.286e-6, 0.202e-6),
    ("NIRISS", "F480M"): Filter(4.817e-6, 0.298e-6),
}


def filter_of_header(header: Mapping[str, Any]) -> Filter | None:
    """Return the filter named by the FITS cards INSTRUME and FILTER, or None if it is not in `FILTERS`.

    Examples
    --------
    >>> filter_of_header({"INSTRUME": "NIRISS", "FILTER": "F480M"})
    Filter(wavelength=4.817e-06, width=2.98e-07)
    """
    instrument, name = (str(header.get(card, "")).strip().upper() for card in ("INSTRUME", "FILTER"))
    return FILTERS.get((instrument, name))
