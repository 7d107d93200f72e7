"""Write visibilities and closure phases to OIFITS files, for other programs of interferometry.

Files follow version 2 of the standard (Duvert, Young & Hummel 2017, A&A 597, A8), with one row of OI_ARRAY per hole.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.observables import Observables
from torchmask.interferometry.oifits_correlations import correlation_triplets
from torchmask.io import as_array, atomic_write, extra
from torchmask.observation import Observation
from torchmask.optics.band import filter_of_header

_ARRAY = "MASK"
_CORRELATIONS = "MASK"


def save_oifits(
    path: str | Path, observables: Observables, observation: Observation, bandwidth: float | None = None
) -> None:
    """Write OI_TARGET, OI_ARRAY, OI_WAVELENGTH, OI_VIS, OI_VIS2, OI_T3 and OI_CORR to a new OIFITS file.

    Parameters
    ----------
    path : str or Path
        Name of the new file, which ends in .fits or .oifits. Existing files are not overwritten, and a file that cannot
        be written completely is not left behind.
    observables : Observables
        Result of `frame_observables` or `restored_observables`.
    observation : Observation
        Observation that they come from. Its header gives target, telescope, date and orientation; without sky
        coordinates u is along the columns and v along the rows of the image, and a COMMENT says so. INT_TIME is the
        exposure time of a frame, 0 if it is not known, times their number.
    bandwidth : float, optional
        Width of the band [m], EFF_BAND. None: that of the header's FILTER, if it is known.

    Raises
    ------
    ValueError
        If the width of the band is neither given nor known, the observables belong to another mask, the file exists,
        its folder does not exist, or its name has another ending.

    Notes
    -----
    Signs are those of `torchmask.interferometry.observables`. STA_INDEX counts holes from 1, in the order of the
    centres; U1COORD, V1COORD belong to the first pair of a triangle (i, j), U2COORD, V2COORD to the second (j, k).
    STAXYZ are the holes' positions in the pupil, towards east and north, FRAME = 'SKY'. Values that are not finite are
    flagged.

    Examples
    --------
    >>> import tempfile, torch
    >>> from torchmask.interferometry.fringes import frame_observables
    >>> from torchmask.grid import Grid
    >>> from torchmask.optics.aperture import SparseAperture
    >>> frames = torch.rand(4, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 1e4
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> observation = Observation(frames, mask, Grid.nyquist(1.0, 550e-9, 64), readout_noise=1.0)
    >>> path = tempfile.mkdtemp() + "/seen.oifits"
    >>> save_oifits(path, frame_observables(observation), observation, bandwidth=30e-9)
    """
    with extra("oifits"):
        from astropy.io import fits

    path = Path(path)
    if path.suffix not in (".fits", ".oifits"):
        raise ValueError(f"{path} ends neither in .fits nor in .oifits")
    n = observation.aperture.n_subapertures
    if len(observables.stations) != n:
        raise ValueError(f"the observables are of {len(observables.stations)} holes and the observation's mask has {n}")
    header = observation.header
    if bandwidth is None:
        band = filter_of_header(header)
        if band is None:
            raise ValueError("the header has no known FILTER, which gives the width of the band: give bandwidth [m]")
        bandwidth = band.width
    if not (math.isfinite(bandwidth) and bandwidth > 0):
        raise ValueError(f"bandwidth is {bandwidth}: it must be finite and positive, in m")

    date, mjd = _date(header)
    common = {"DATE-OBS": date[:10], "ARRNAME": _ARRAY, "INSNAME": _text(header, "INSTRUME")}
    seconds = (observation.exposure_time or 0.0) * len(observation.frames)
    hdus = fits.HDUList([_primary(header, date)])
    hdus.append(_target(header))
    hdus.append(_array(observables, observation))
    wave = {"EFF_WAVE": ("1E", "m", [observation.grid.wavelength]), "EFF_BAND": ("1E", "m", [bandwidth])}
    hdus.append(_table("OI_WAVELENGTH", {"INSNAME": common["INSNAME"]}, wave))
    for table in [*_measurements(observables, common, mjd, seconds), _correlations(observables)]:
        hdus.append(table)
    content = BytesIO()  # astropy does not know the mode that atomic_write opens files in
    hdus.writeto(content, checksum=True)
    with atomic_write(path) as file:
        file.write(content.getvalue())


def _measurements(observables: Observables, common: Mapping[str, str], mjd: float, seconds: float) -> list[Any]:
    """Return the tables OI_VIS, OI_VIS2 and, for three holes or more, OI_T3."""
    values, errors = observables.visibilities, observables.visibility_errors
    u, v = observables.baselines.T
    uv = {"UCOORD": ("1D", "m", u), "VCOORD": ("1D", "m", v)}
    pairs, triangles = observables.pairs, observables.triangles
    vis = {
        "VISAMP": ("1D", None, values.abs()),
        "VISAMPERR": ("1D", None, errors),
        "VISPHI": ("1D", "deg", values.angle().rad2deg()),
        "VISPHIERR": ("1D", "deg", (errors / values.abs()).rad2deg()),
    }
    vis2 = {"VIS2DATA": ("1D", None, observables.vis2), "VIS2ERR": ("1D", None, observables.vis2_errors)}
    absolute, correlated = {"AMPTYP": "absolute", "PHITYP": "absolute"}, {**common, "CORRNAME": _CORRELATIONS}
    n, first = len(pairs), len(pairs) + len(triangles)  # number of data before those of a table in OI_CORR
    tables = [
        _table("OI_VIS", {**common, **absolute}, _rows(vis, uv, pairs, mjd, seconds)),
        _table("OI_VIS2", correlated, _rows(vis2, uv | _places_of("VIS2DATA", 0, n), pairs, mjd, seconds)),
    ]
    if len(triangles):
        i, j, k = (observables.stations[triangles[:, side]] for side in range(3))
        sides = {"U1COORD": (j - i)[:, 0], "V1COORD": (j - i)[:, 1], "U2COORD": (k - j)[:, 0], "V2COORD": (k - j)[:, 1]}
        t3 = {
            "T3AMP": ("1D", None, observables.triple_amplitudes),
            "T3AMPERR": ("1D", None, observables.triple_errors),
            "T3PHI": ("1D", "deg", observables.closure_phases.rad2deg()),
            "T3PHIERR": ("1D", "deg", observables.closure_errors.rad2deg()),
        }
        places = {name: ("1D", "m", side) for name, side in sides.items()}
        places |= _places_of("T3AMP", n, len(triangles)) | _places_of("T3PHI", first, len(triangles))
        tables.append(_table("OI_T3", correlated, _rows(t3, places, triangles, mjd, seconds)))
    return tables


def _places_of(name: str, before: int, count: int) -> dict[str, Any]:
    """Return the column with the indices of data in OI_CORR."""
    return {f"CORRINDX_{name}": ("1J", None, np.arange(before + 1, before + 1 + count, dtype=np.int32))}


def _correlations(observables: Observables) -> Any:
    """Return the table OI_CORR of |V|^2, triple amplitudes and closure phases."""
    covariances = (observables.vis2_covariance, observables.triple_covariance, observables.closure_covariance)
    i, j, values = correlation_triplets(covariances)
    columns = {"IINDX": ("1J", None, i), "JINDX": ("1J", None, j), "CORR": ("1D", None, values)}
    cards = {"CORRNAME": _CORRELATIONS, "NDATA": sum(map(len, covariances))}
    return _table("OI_CORR", {**cards, "OI_REVN": 1}, columns)


def _rows(
    measured: dict[str, Any], places: dict[str, Any], holes: Tensor, mjd: float, seconds: float
) -> dict[str, Any]:
    """Return the columns of a table of measurements: those that all tables share, around its own."""
    n = len(holes)
    bad = ~np.all([np.isfinite(as_array(values)) for _, _, values in measured.values()], axis=0)
    return {
        "TARGET_ID": ("1I", None, np.ones(n, dtype=np.int16)),
        "TIME": ("1D", "s", np.zeros(n)),
        "MJD": ("1D", "d", np.full(n, mjd)),
        "INT_TIME": ("1D", "s", np.full(n, seconds)),
        **{name: (code, unit, _spectrum(values)) for name, (code, unit, values) in measured.items()},
        **places,
        "STA_INDEX": (f"{holes.shape[1]}I", None, as_array(holes).astype(np.int16) + 1),
        "FLAG": ("1L", None, _spectrum(bad)),
    }


def _spectrum(values: Any) -> np.ndarray:
    """Return values as (n, 1), with one column for the single wavelength."""
    return as_array(values)[:, None]


def _table(name: str, cards: Mapping[str, Any], columns: Mapping[str, tuple[str, str | None, Any]]) -> Any:
    """Return a binary table of revision 2 from {column: (format, unit, values)}."""
    with extra("oifits"):
        from astropy.io import fits

    arrays = {column: (code, unit, as_array(values)) for column, (code, unit, values) in columns.items()}
    table = fits.BinTableHDU.from_columns(
        [
            # without TDIM, readers take a spectrum of one wavelength for a scalar
            fits.Column(
                name=column, format=code, unit=unit, array=values, dim="(1)" if values.shape[1:] == (1,) else None
            )
            for column, (code, unit, values) in arrays.items()
        ],
        name=name,
    )
    for card, value in {"OI_REVN": 2, **cards}.items():  # the newest revision of most tables
        table.header[card] = value
    return table


def _primary(header: Mapping[str, Any], date: str) -> Any:
    with extra("oifits"):
        from astropy.io import fits

    hdu = fits.PrimaryHDU()
    cards = {
        "ORIGIN": "torchmask",
        "DATE": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%S"),
        "DATE-OBS": date,
        "CONTENT": "OIFITS2",
        "TELESCOP": _text(header, "TELESCOP"),
        "INSTRUME": _text(header, "INSTRUME"),
        "OBSERVER": _text(header, "OBSERVER"),
        "OBJECT": _target_name(header),
        "INSMODE": "NRM",
        "PROCSOFT": "torchmask",
        "FILT": _text(header, "FILTER"),
    }
    for name, value in cards.items():
        hdu.header[name] = value
    if "CTYPE1" not in header:
        hdu.header.add_comment("no sky coordinates are known: u runs along the columns of the image, v along its rows")
    if not any(name in header for name in ("MJD-AVG", "MJD-OBS", "DATE-OBS")):
        hdu.header.add_comment("the date is not known")
    return hdu


def _target(header: Mapping[str, Any]) -> Any:
    sky = str(header.get("CTYPE1", "")).startswith("RA")
    place = []
    for names in (("TARG_RA", "RA", "CRVAL1" if sky else ""), ("TARG_DEC", "DEC", "CRVAL2" if sky else "")):
        numbers = [header[name] for name in names if isinstance(header.get(name), int | float)]
        place.append(float(numbers[0]) if numbers else 0.0)
    numbers = {"RAEP0": place[0], "DECEP0": place[1]}
    zero = dict.fromkeys(("RA_ERR", "DEC_ERR"), 0.0)
    motion = dict.fromkeys(("PMRA", "PMDEC", "PMRA_ERR", "PMDEC_ERR"), 0.0)
    columns = {"TARGET_ID": ("1I", None, [1]), "TARGET": ("32A", None, [_target_name(header)])}
    columns |= {name: ("1D", "deg", [value]) for name, value in numbers.items()}
    columns["EQUINOX"] = ("1E", "yr", [2000.0])
    columns |= {name: ("1D", "deg", [value]) for name, value in zero.items()}
    columns["SYSVEL"] = ("1D", "m/s", [0.0])
    columns |= {name: ("8A", None, ["UNKNOWN"]) for name in ("VELTYP", "VELDEF")}
    columns |= {name: ("1D", "deg/yr", [value]) for name, value in motion.items()}
    columns |= {name: ("1E", "deg", [0.0]) for name in ("PARALLAX", "PARA_ERR")}
    columns["SPECTYP"] = ("32A", None, ["UNKNOWN"])
    columns["CATEGORY"] = ("3A", None, ["SCI"])
    return _table("OI_TARGET", {}, columns)


def _array(observables: Observables, observation: Observation) -> Any:
    """Return OI_ARRAY with one row per hole; the field of view is the width of a hole's diffraction pattern."""
    n, aperture = len(observables.stations), observation.aperture
    names = [f"H{index + 1}" for index in range(n)]
    places = np.concatenate([as_array(observables.stations), np.zeros((n, 1))], axis=1)
    field = observation.grid.wavelength / aperture.subaperture_diameter / ARCSEC
    columns = {
        "TEL_NAME": ("16A", None, names),
        "STA_NAME": ("16A", None, names),
        "STA_INDEX": ("1I", None, np.arange(1, n + 1, dtype=np.int16)),
        "DIAMETER": ("1E", "m", np.full(n, aperture.subaperture_diameter)),
        "STAXYZ": ("3D", "m", places),
        "FOV": ("1D", "arcsec", np.full(n, field)),
        "FOVTYPE": ("6A", None, ["FWHM"] * n),
    }
    return _table("OI_ARRAY", {"ARRNAME": _ARRAY, "FRAME": "SKY", "ARRAYX": 0.0, "ARRAYY": 0.0, "ARRAYZ": 0.0}, columns)


def _target_name(header: Mapping[str, Any]) -> str:
    return str(header.get("TARGNAME", header.get("OBJECT", "UNKNOWN")))[:32]


def _text(header: Mapping[str, Any], name: str) -> str:
    return str(header.get(name, "UNKNOWN")).strip() or "UNKNOWN"


def _date(header: Mapping[str, Any]) -> tuple[str, float]:
    """Return date and time (ISO) and MJD of the observation, from MJD-AVG, MJD-OBS or DATE-OBS, or else MJD 0."""
    with extra("oifits"):
        from astropy.time import Time

    time: Any = None
    for name in ("MJD-AVG", "MJD-OBS"):
        if time is None and isinstance(header.get(name), int | float):
            time = Time(header[name], format="mjd")
    if time is None and "DATE-OBS" not in header:
        return "1858-11-17T00:00:00", 0.0
    if time is None:
        text = str(header["DATE-OBS"])
        if "T" not in text and "TIME-OBS" in header:
            text = f"{text}T{header['TIME-OBS']}"
        try:
            time = Time(text)
        except ValueError as error:
            raise ValueError(f"DATE-OBS is {text!r}: a date such as 2025-01-31 is needed") from error
    return time.isot[:19], float(time.mjd)
