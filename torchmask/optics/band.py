"""The band of light that reaches the detector: as a few wavelengths, or by the name of a filter."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple


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
        """The band of these wavelengths [m], with light in proportion to `weights` (None: equal).

        Raises ValueError if there is no wavelength, the weights are not as many, or one is not finite and positive.
        """
        shares = [1.0] * len(wavelengths) if weights is None else [float(weight) for weight in weights]
        if not len(wavelengths) or len(shares) != len(wavelengths):
            raise ValueError(
                f"{len(wavelengths)} wavelengths have {len(shares)} weights: as many, and at least 1, are needed"
            )
        for name, values in (("wavelengths", wavelengths), ("weights", shares)):
            if not all(math.isfinite(value) and value > 0 for value in values):
                raise ValueError(f"{name} are {list(values)}: they must be finite and positive")
        total = sum(shares)
        return cls(tuple(float(value) for value in wavelengths), tuple(share / total for share in shares))

    @property
    def shortest(self) -> float:
        """The shortest wavelength [m], which samples the image most coarsely."""
        return min(self.wavelengths)


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
    """The filter that the FITS cards INSTRUME and FILTER name; None if it is not in `FILTERS`.

    Examples
    --------
    >>> filter_of_header({"INSTRUME": "NIRISS", "FILTER": "F480M"})
    Filter(wavelength=4.817e-06, width=2.98e-07)
    """
    instrument, name = (str(header.get(card, "")).strip().upper() for card in ("INSTRUME", "FILTER"))
    return FILTERS.get((instrument, name))
