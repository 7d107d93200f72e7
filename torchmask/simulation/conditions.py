"""What an observation adds to snapshots of one wavelength through a perfect instrument: each effect and its checks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torchmask.optics.band import Band
from torchmask.optics.pixel import PixelResponse


@dataclass(frozen=True, kw_only=True)
class Conditions:
    """How exposures are taken. The defaults are snapshots of one wavelength by pixels that are points, on a black sky.

    sky : float
        Electrons per pixel and frame that no object sends.
    transparency_scatter : float
        Standard deviation of the logarithm of each frame's transmission, which is log-normal with mean 1, so the light
        of the object varies from frame to frame while the sky does not.
    exposure_time : float
        How long a frame lasts, while the wind carries the turbulence on [s].
    band : Band, optional
        Wavelengths and the share of the light at each; the path differences of turbulence are the same for all. None:
        the wavelength of the grid alone.
    pixel : PixelResponse, optional
        How the detector's pixels blur the image; None: pixels are points.

    Raises
    ------
    ValueError
        If a number is negative or not finite.

    Examples
    --------
    >>> from torchmask.optics.pixel import SquarePixel
    >>> Conditions(sky=12.5, exposure_time=2e-3, pixel=SquarePixel()).sky
    12.5
    """

    sky: float = 0.0
    transparency_scatter: float = 0.0
    exposure_time: float = 0.0
    band: Band | None = None
    pixel: PixelResponse | None = None

    def __post_init__(self) -> None:
        for name, unit in (
            ("sky", "electrons per pixel and frame"),
            ("transparency_scatter", "of the logarithm of the transmission"),
            ("exposure_time", "in s"),
        ):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"{name} is {value}: it must be finite and at least 0, {unit}")
