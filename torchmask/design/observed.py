"""The criterion of an observation: what an instrument, and the light through a mask, say of the error."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from torchmask.design.turbulent import TurbulentMSE
from torchmask.instrument.instrument import Instrument
from torchmask.optics.pixel import SquarePixel


def instrument_criterion(
    instrument: Instrument, area: float, n_pixels: int = 256, turbulence: bool = True
) -> TurbulentMSE:
    """The criterion of all masks that open the same area of an instrument's pupil.

    Parameters
    ----------
    instrument : Instrument
    area : float
        Open area of the pupil [m^2], `aperture.area`, which sets the light.
    n_pixels : int
        Of the grid of frequencies, per side; the noise counts the pixels of the camera.
    turbulence : bool
        False: a random piston for each hole and nothing else, as `AsymptoticMSE`; quick, for a first search.

    Raises
    ------
    ValueError
        If the area is not positive.

    Examples
    --------
    >>> from torchmask.instrument.parts import Camera, Site, Source, Telescope
    >>> instrument = Instrument(
    ...     telescope=Telescope(diameter=1.0),
    ...     source=Source(photon_rate=1e9),
    ...     site=Site(r0=0.15, wind=10.0),
    ...     wavelength=550e-9,
    ...     width=10e-9,
    ...     exposure=2e-3,
    ...     n_frames=20,
    ... )
    >>> criterion = instrument_criterion(instrument, area=0.05, n_pixels=64)
    >>> criterion.n_frames, float(criterion.noise_psd[0, 0])  # 1e9 photons / (s m^2), 0.05 m^2, 2 ms
    (20, 100000.0)
    """
    air: dict[str, Any] = {}
    if turbulence:
        band = instrument.band
        air = asdict(instrument.seeing) | {"wavelengths": band.wavelengths, "weights": band.shares}
    fill = instrument.camera.pixel_fill
    return TurbulentMSE(
        instrument.grid(n_pixels),
        instrument.object_psd(area),
        instrument.noise_psd(area),
        instrument.frames,
        **air,
        pixel=None if fill is None else SquarePixel(fill),
        sky=instrument.sky(area),
    )


def change_light(criterion: TurbulentMSE, instrument: Instrument, area: float) -> None:
    """Make a criterion that of another open area [m^2] of the same instrument, whose turbulence it keeps.

    What takes seconds to compute of turbulence does not depend on the light, and is used again.
    """
    other = instrument_criterion(instrument, area, criterion.grid.shape[0])
    criterion.load_state_dict(other.state_dict())
