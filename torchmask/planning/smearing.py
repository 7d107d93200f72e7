"""What restorations attain in long exposures and wide bands, over what is predicted: measured tables, interpolated.

The tables are `smearing_mask.json` and `smearing_full.json` beside this file, written by
`experiments/smearing_map.py`; each holds its own conditions.
Smearing by time and by bandwidth is what interferometry calls the loss of fringe contrast by either.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import get_args

import numpy as np

from torchmask.planning.lattice import Axis, interpolate, locate
from torchmask.planning.success import THROUGH, BlindOutlook, Pupil


def phase_spread(width: float, d_over_r0: float) -> float:
    """Return how far the phase difference of turbulence over the baseline D spreads across a band [rad rms].

    That is width / wavelength times the root of Kolmogorov's structure function, 6.88 (D / r0)^(5/3).

    >>> round(phase_spread(width=0.1, d_over_r0=4.0), 2)
    0.83
    """
    return width * math.sqrt(6.88) * d_over_r0 ** (5 / 6)


@dataclass(frozen=True, eq=False)
class SmearingMap:
    """Restorations over photons per frame and exposure, and over photons per frame and width of the band.

    n_photons, exposures, spreads : the values measured, in rising order, at least two each; exposures over tau0,
        `phase_spread` of the bands [rad]
    exposure_ratio, band_ratio : restored score over the one that `TurbulentMSE` predicts for instants in narrow light
        times `BlindOutlook.cost` and `SuccessMap.level`, indexed [photons, exposures] and [photons, spreads]; the
        exposures were in narrow light, the bands those of instants
    conditions : what all restorations share, in a sentence
    pupil : what they were through

    Raises ValueError if a shape or an order is wrong, or a ratio is not finite and positive.

    Examples
    --------
    >>> instants = BlindOutlook(cost=1.2, success=0.75, low=0.5, high=0.9)
    >>> short, long = (smearing_map().outlook(instants, n_photons=1e6, exposure=t, spread=0.2) for t in (0.5, 8.0))
    >>> short.restored < long.restored
    True
    """

    n_photons: Sequence[float]
    exposures: Sequence[float]
    spreads: Sequence[float]
    exposure_ratio: np.ndarray
    band_ratio: np.ndarray
    conditions: str = ""
    pupil: Pupil = "mask"

    def __post_init__(self) -> None:
        photons, exposures, spreads = self._axes
        for name, axis in (("exposure_ratio", exposures), ("band_ratio", spreads)):
            table, shape = np.asarray(getattr(self, name), float), (len(photons.values), len(axis.values))
            if table.shape != shape or not ((table > 0) & np.isfinite(table)).all():
                raise ValueError(f"{name} is {table.tolist()}: finite positive numbers of shape {shape} are needed")
            object.__setattr__(self, name, table)

    @property
    def _axes(self) -> tuple[Axis, Axis, Axis]:
        return (
            Axis("n_photons", "photons per frame", self.n_photons, logarithmic=True),
            Axis("exposure", "exposures over tau0", self.exposures, may_be_zero=True, harder=True),
            Axis("spread", "spreads of the phase across the band in rad", self.spreads, may_be_zero=True, harder=True),
        )

    def outlook(self, instants: BlindOutlook, *, n_photons: float, exposure: float, spread: float) -> BlindOutlook:
        """Return what to expect of long exposures in a wide band, from what to expect of instants in narrow light.

        The ratio of the exposure is multiplied by that of the band, over the mean of their first points, which both are
        instants in narrow light. All means are geometric. Tables are interpolated in their logarithm, over the
        logarithm of the photons and over exposure or spread; below its first point each is what it is there.

        Parameters
        ----------
        instants : BlindOutlook
            What `SuccessMap.outlook` returns.
        n_photons : float
            Electrons per frame through the aperture.
        exposure : float
            Exposure time of a frame, T / tau0.
        spread : float
            `phase_spread` of the band, `Band.relative_width`, and the telescope's D / r0 [rad].

        Raises
        ------
        ValueError
            If the photons are not finite and positive, or another number is negative or not finite.

        Warns
        -----
        UserWarning
            If the point lies outside the tables in what `instants` does not; the nearest edge is taken.
        """
        if exposure >= 0:
            exposure = max(exposure, self.exposures[0])
        if spread >= 0:
            spread = max(spread, self.spreads[0])
        (light, long, wide), outside, harder = locate(
            self._axes, (n_photons, exposure, spread), THROUGH[self.pupil], instants.outside
        )
        logarithm = 0.0
        for ratio, place in ((self.exposure_ratio, long), (self.band_ratio, wide)):
            logarithm += interpolate(np.log(ratio), (light, place)) - interpolate(np.log(ratio), (light, 0)) / 2
        outside = tuple(dict.fromkeys((*instants.outside, *outside)))
        restored = instants.restored * math.exp(logarithm)
        return replace(instants, restored=restored, outside=outside, harder=(*instants.harder, *harder))


@functools.cache
def smearing_map(pupil: Pupil = "mask") -> SmearingMap:
    """Return the tables that come with the library, of masks ("mask") or of the full pupil ("full").

    Raises ValueError for any other kind of pupil.

    >>> smearing_map() is smearing_map()  # they are read once
    True
    """
    if pupil not in get_args(Pupil):
        raise ValueError(f"pupil is {pupil!r}: maps are known of {' and '.join(get_args(Pupil))}")
    table = files("torchmask.planning").joinpath(f"smearing_{pupil}.json")
    return SmearingMap(**json.loads(table.read_text(encoding="utf-8")), pupil=pupil)
