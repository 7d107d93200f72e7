"""Published profiles of turbulence and wind with height, as layers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from torchmask.atmosphere.layers import Layers

_TOP = 40e3  # [m], above which no model has turbulence
_CELLS = 2000  # cells that sample a continuous profile before it is grouped, thinner near the ground


def named_layers(name: str, n_layers: int = 8) -> Layers:
    """Return a published profile as at most `n_layers` layers, for a telescope on the ground pointing at the zenith.

    Parameters
    ----------
    name : str
        Name of the profile.

        "hv57" is the Hufnagel-Valley model with an upper-altitude wind of 21 m/s rms and a ground strength of
        1.7e-14 m^(-2/3), named after its r0 of 5 cm and its theta0 of 7 microrad at 500 nm (Tyson, Principles of
        Adaptive Optics, section 2.1; Hardy, Adaptive Optics for Astronomical Telescopes, section 3.6). Its wind is
        Bufton's, 5 m/s at the ground and 35 m/s at 9.4 km (Appl. Opt. 12, 1785, 1973). The r0 of the same profile is
        4.98 cm where the constant 0.4234 of `Layers.r0` is rounded to 0.42, and 4.96 cm where it is not.

        "las_campanas" has seven layers and an r0 of 16 cm at 500 nm (Males & Guyon, J. Astron. Telesc. Instrum.
        Syst. 4, 019001, 2018, after Prieto et al., Proc. SPIE 7733, 77334O, 2010).

        "mauna_kea" has six layers with winds of 10 m/s and an r0 of 20 cm at 500 nm (Guyon, Astrophys. J. 629, 592,
        2005, after Tokovinin et al., Publ. Astron. Soc. Pac. 117, 395, 2005).
    n_layers : int
        Largest number of layers. Grouping preserves r0, theta0 and tau0; see `Layers.grouped`.

    Returns
    -------
    Layers
        Layers whose winds all blow towards +x, because the sources give speeds without directions.

    Raises
    ------
    ValueError
        If the name is unknown (the message lists the known ones) or `n_layers` is below 1.

    Examples
    --------
    >>> print(named_layers("hv57", n_layers=3).describe(500e-9))
    | height | share | wind |
    | --- | --- | --- |
    | 78 m | 0.664 | 5.7 m/s |
    | 2516 m | 0.304 | 10.9 m/s |
    | 13453 m | 0.032 | 23.3 m/s |
    <BLANKLINE>
    | quantity | value | of |
    | --- | --- | --- |
    | r0 | 4.958 cm | Fried parameter |
    | theta0 | 6.894 microrad = 1.422 arcsec | isoplanatic angle |
    | tau0 | 1.861 ms | coherence time |
    | f_G | 72.08 Hz | Greenwood frequency |
    """
    if name not in PROFILES:
        raise ValueError(f"profile {name!r} is unknown: known ones are {', '.join(sorted(PROFILES))}")
    return PROFILES[name]().grouped(n_layers)


def _hufnagel_valley() -> Layers:
    edges = _TOP * np.linspace(0, 1, _CELLS + 1) ** 3
    height, depth = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    density = (
        0.00594 * (21 / 27) ** 2 * (1e-5 * height) ** 10 * np.exp(-height / 1000)
        + 2.7e-16 * np.exp(-height / 1500)
        + 1.7e-14 * np.exp(-height / 100)
    )
    speed = 5 + 30 * np.exp(-(((height - 9400) / 4800) ** 2))
    return Layers(height.tolist(), (density * depth).tolist(), [(v, 0.0) for v in speed.tolist()])


def _las_campanas() -> Layers:
    return Layers.from_fractions(
        0.16,
        500e-9,
        heights=[250, 500, 1000, 2000, 4000, 8000, 16000],
        fractions=[0.42, 0.03, 0.06, 0.16, 0.11, 0.10, 0.12],
        winds=[(v, 0.0) for v in (10, 10, 20, 20, 25, 30, 25)],
    )


def _mauna_kea() -> Layers:
    return Layers.from_fractions(
        0.2,
        500e-9,
        heights=[500, 1000, 2000, 4000, 8000, 16000],
        fractions=[0.2283, 0.0883, 0.0666, 0.1458, 0.3350, 0.1350],
        winds=[(10.0, 0.0)] * 6,
    )


PROFILES: dict[str, Callable[[], Layers]] = {
    "hv57": _hufnagel_valley,
    "las_campanas": _las_campanas,
    "mauna_kea": _mauna_kea,
}
"""Functions that return the ungrouped profiles, by name."""
