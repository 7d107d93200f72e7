"""The design criterion for an observation, from an instrument and the light through a mask."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from torchmask.design.conditions import ExposureConditions
from torchmask.design.turbulent import TurbulentMSE
from torchmask.instrument.instrument import Instrument


def instrument_criterion(
    instrument: Instrument, area: float, n_pixels: int = 256, turbulence: bool = True
) -> TurbulentMSE:
    """Return the criterion for all masks with the same open area of an instrument's pupil.

    Parameters
    ----------
    instrument : Instrument
        Instrument, source and turbulence.
    area : float
        Open area of the pupil [m^2], `aperture.area`, which sets the light.
    n_pixels : int
        Number of samples per side of the frequency grid. The noise is that of the camera's pixels regardless.
    turbulence : bool
        False: only a random piston for each hole, as in `AsymptoticMSE`, which is quick and suits a first search.

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
    site = instrument.site
    known = ExposureConditions.of_instrument(instrument, area).keywords(site.r0, site.outer_scale)
    if not turbulence:
        known = {name: known[name] for name in ("pixel", "sky")}
    return _criterion(instrument, area, n_pixels, known)


def instant_criterion(instrument: Instrument, area: float, n_pixels: int = 256) -> TurbulentMSE:
    """Return `instrument_criterion` with all the light of a frame in one instant and at one wavelength.

    >>> from torchmask.instrument.parts import Site, Source, Telescope
    >>> known = {"telescope": Telescope(diameter=1.0), "site": Site(r0=0.15, wind=10.0)}
    >>> known |= {"source": Source(photon_rate=1e9), "wavelength": 550e-9, "width": 10e-9, "exposure": 2e-3}
    >>> instrument = Instrument(**known, n_frames=20)
    >>> criterion = instant_criterion(instrument, area=0.05, n_pixels=64)
    >>> criterion.seeing.exposure, criterion.band, float(criterion.noise_psd[0, 0])
    (0.0, None, 100000.0)
    """
    conditions = ExposureConditions.of_instrument(instrument, area)
    still = replace(conditions, exposure=0.0, wind=0.0, wavelengths=None, weights=None)
    return _criterion(instrument, area, n_pixels, still.keywords(instrument.site.r0, instrument.site.outer_scale))


def _criterion(instrument: Instrument, area: float, n_pixels: int, known: dict[str, Any]) -> TurbulentMSE:
    return TurbulentMSE(
        instrument.grid(n_pixels), instrument.object_psd(area), instrument.noise_psd(area), instrument.frames, **known
    )


def change_light(criterion: TurbulentMSE, instrument: Instrument, area: float) -> None:
    """Change a criterion in place to the light and the number of frames of an instrument and open area [m^2].

    The effect of turbulence, which takes seconds to compute, does not depend on them and is kept.
    """
    criterion.n_frames = instrument.frames
    other = instrument_criterion(instrument, area, criterion.grid.shape[0])
    criterion.load_state_dict(other.state_dict())
