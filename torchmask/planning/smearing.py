"""What long exposures and wide bands cost a blind restoration beyond what is predicted: measured tables, interpolated.

The tables are `smearing.json` beside this file, written by `experiments/smearing_map.py`; it holds its own conditions.
Smearing by time and by bandwidth is what interferometry calls the loss of fringe contrast by either.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.resources import files

import numpy as np

from torchmask.planning.lattice import Axis, interpolate, locate
from torchmask.planning.success import BlindOutlook


@dataclass(frozen=True, eq=False)
class SmearingMap:
    """Restorations over photons per frame and exposure, and over photons per frame and width of the band.

    n_photons, exposures, widths : the values measured, in rising order, at least two each; exposures over tau0, widths
        over the wavelength
    exposure_cost, width_cost : factor by which the score grows beyond that predicted for known PSFs, against the first
        exposure or width at the same photons, indexed [photons, exposures] and [photons, widths]
    conditions : what all restorations share, in a sentence

    Raises ValueError if a shape or an order is wrong, or a cost is not positive.

    Examples
    --------
    >>> instants = BlindOutlook(cost=1.2, success=0.75, low=0.5, high=0.9)
    >>> smearing_map().outlook(instants, n_photons=1e6, exposure=4.0, width=0.0).smearing > 1
    True
    """

    n_photons: Sequence[float]
    exposures: Sequence[float]
    widths: Sequence[float]
    exposure_cost: np.ndarray
    width_cost: np.ndarray
    conditions: str = ""

    def __post_init__(self) -> None:
        photons, exposures, widths = self._axes
        for name, axis in (("exposure_cost", exposures), ("width_cost", widths)):
            table, shape = np.asarray(getattr(self, name), float), (len(photons.values), len(axis.values))
            if table.shape != shape or not (table > 0).all():
                raise ValueError(f"{name} is {table.tolist()}: positive numbers of shape {shape} are needed")
            object.__setattr__(self, name, table)

    @property
    def _axes(self) -> tuple[Axis, Axis, Axis]:
        return (
            Axis("n_photons", "photons per frame", self.n_photons, logarithmic=True),
            Axis("exposure", "exposures over tau0", self.exposures, may_be_zero=True),
            Axis("width", "widths of the band over the wavelength", self.widths, may_be_zero=True),
        )

    def outlook(self, instants: BlindOutlook, *, n_photons: float, exposure: float, width: float) -> BlindOutlook:
        """Return what to expect of long exposures in a wide band, from what to expect of instants in narrow light.

        The two factors are multiplied. Each is geometric between the points of its table, in the logarithm of the
        photons and in the exposure or the width, and that of the first point below it.

        Parameters
        ----------
        instants : BlindOutlook
            What `SuccessMap.outlook` returns.
        n_photons : float
            Electrons per frame through the mask.
        exposure : float
            Exposure time of a frame, T / tau0.
        width : float
            Width of the band over the wavelength, `Band.relative_width`.

        Raises
        ------
        ValueError
            If the photons are not finite and positive, or another number is negative or not finite.

        Warns
        -----
        UserWarning
            If the point lies outside the tables, whose nearest edge is taken.
        """
        if exposure >= 0:
            exposure = max(exposure, self.exposures[0])
        if width >= 0:
            width = max(width, self.widths[0])
        (light, long, wide), outside = locate(self._axes, (n_photons, exposure, width))
        logarithm = interpolate(np.log(self.exposure_cost), (light, long))
        logarithm += interpolate(np.log(self.width_cost), (light, wide))
        return replace(
            instants, smearing=math.exp(logarithm), outside=tuple(dict.fromkeys((*instants.outside, *outside)))
        )


@functools.cache
def smearing_map() -> SmearingMap:
    """Return the tables that come with the library.

    >>> smearing_map() is smearing_map()  # they are read once
    True
    """
    return SmearingMap(**json.loads(files("torchmask.planning").joinpath("smearing.json").read_text(encoding="utf-8")))
