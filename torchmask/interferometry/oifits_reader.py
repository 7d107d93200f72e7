"""Read OIFITS files of this library and of other instruments as measurements.

Versions 1 and 2 of the standard are read (Pauls et al. 2005, PASP 117, 1255; Duvert et al. 2017, A&A 597, A8).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.oifits_correlations import correlation_of, read_correlations, shared_sides
from torchmask.io import extra
from torchmask.numbers import require_wavelength

_SIDES = ("U1COORD", "V1COORD", "U2COORD", "V2COORD")
_LONGEST = 1e4  # [m], beyond any interferometer of light, and below baselines that were divided by its wavelength


@dataclass(frozen=True)
class _Rows:
    """Measurements of all tables of a kind, with a row for each number.

    columns : (M, ...) values
    stations : (M, 2 or 3) stations of the baseline or triangle, -1 where unknown
    exposure : (M, 3) number of its table, exposure and wavelength
    corrname : (M,) name of the number's matrix of correlations
    place : (M,) index in that matrix, 0 if it is in none
    unusable : number of those that are left out though no flag says so
    """

    columns: dict[str, np.ndarray]
    wavelength: np.ndarray
    stations: np.ndarray
    exposure: np.ndarray
    corrname: np.ndarray
    place: np.ndarray
    unusable: int


def load_oifits(path: str | Path, target: str | None = None) -> Measurements:
    """Read squared visibilities and closure phases of an OIFITS file, with the correlations of their errors.

    Parameters
    ----------
    path : str or Path
        OIFITS file, with one or more instruments, times and wavelengths.
    target : str, optional
        Name of the target, for a file with several.

    Returns
    -------
    Measurements
        Values of OI_VIS2 and OI_T3, ordered by table, row and wavelength, without those that are flagged, are not
        finite, at a place or wavelength that is not, or have no positive error. Correlations are those of OI_CORR.
        Without it, closure phases are taken as sums of phases of equally noisy baselines: if two triangles share a
        baseline their correlation is 1/3, or -1/3 if they traverse it in opposite directions. As independent values
        they would be counted several times, since only (N - 1)(N - 2)/2 of the N (N - 1)(N - 2)/6 closure phases of N
        holes are independent.

    Raises
    ------
    ValueError
        If the file is missing, cut off or is not OIFITS, a table lacks a column or its OI_WAVELENGTH or has not as many
        values as that, wavelengths or baselines are in another unit than m, phases in rad, the target is not in the
        file or not named although there are several, or no valid measurement is left.

    Warns
    -----
    UserWarning
        If measurements that are not flagged are left out.

    Examples
    --------
    The file of `save_oifits`:

    >>> import tempfile
    >>> from torchmask.grid import Grid
    >>> from torchmask.interferometry.fringes import frame_observables
    >>> from torchmask.interferometry.oifits import save_oifits
    >>> from torchmask.observation import Observation
    >>> from torchmask.optics.aperture import SparseAperture
    >>> frames = torch.rand(4, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 1e4
    >>> mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)
    >>> observation = Observation(frames, mask, Grid.nyquist(1.0, 550e-9, 64), readout_noise=1.0)
    >>> observables = frame_observables(observation)
    >>> path = tempfile.mkdtemp() + "/seen.oifits"
    >>> save_oifits(path, observables, observation, bandwidth=30e-9)
    >>> seen = load_oifits(path)
    >>> bool(torch.allclose(seen.vis2, observables.vis2)), len(seen.closure_phases)
    (True, 1)
    """
    with extra("oifits"):
        from astropy.io import fits
        from astropy.utils.exceptions import AstropyUserWarning

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}: an OIFITS file is needed")
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("error", "File may have been truncated", AstropyUserWarning)
            with fits.open(path, memmap=False) as hdus:
                return _read(path, hdus, target)
    except (OSError, TypeError, KeyError, AstropyUserWarning) as error:
        raise ValueError(f"{path} is not an OIFITS file, or is damaged: {error}") from error


def _read(path: Path, hdus: Any, target: str | None) -> Measurements:
    chosen = _target_numbers(path, hdus, target)
    waves = {
        str(hdu.header["INSNAME"]).strip(): np.asarray(hdu.data["EFF_WAVE"], dtype=float).ravel()
        for hdu in hdus
        if hdu.name == "OI_WAVELENGTH"
    }
    triplets = read_correlations(hdus)
    vis2 = _gather(path, hdus, "OI_VIS2", ("VIS2DATA", "VIS2ERR"), ("UCOORD", "VCOORD"), chosen, waves)
    t3 = _gather(path, hdus, "OI_T3", ("T3PHI", "T3PHIERR"), _SIDES, chosen, waves)
    if not len(vis2.wavelength) and not len(t3.wavelength):
        raise ValueError(
            f"{path} has no squared visibility and no closure phase that is finite and not flagged: give an OIFITS "
            "file with OI_VIS2 or OI_T3 tables, such as `torchmask restore --oifits` writes"
        )
    _check_units(path, vis2, t3)
    _warn_of_unusable(path, vis2, t3)
    triangles = _tensor(t3, *_SIDES).view(-1, 2, 2)
    closure_correlation = correlation_of(t3.corrname, t3.place, triplets)
    if closure_correlation is None:
        closure_correlation = shared_sides(t3.stations, triangles, t3.exposure)
    return Measurements(
        baselines=_tensor(vis2, "UCOORD", "VCOORD"),
        wavelengths=torch.as_tensor(vis2.wavelength),
        vis2=torch.as_tensor(vis2.columns["VIS2DATA"]),
        vis2_errors=torch.as_tensor(vis2.columns["VIS2ERR"]),
        vis2_correlation=correlation_of(vis2.corrname, vis2.place, triplets),
        triangles=triangles,
        triangle_wavelengths=torch.as_tensor(t3.wavelength),
        closure_phases=torch.as_tensor(t3.columns["T3PHI"]).deg2rad(),
        closure_errors=torch.as_tensor(t3.columns["T3PHIERR"]).deg2rad(),
        closure_correlation=closure_correlation,
    )


def _check_units(path: Path, *kinds: _Rows) -> None:
    """Raise ValueError, which names the file, unless wavelengths and baselines are of light, in m."""
    for rows in kinds:
        for wavelength in np.unique(rows.wavelength).tolist():
            require_wavelength(f"{path}: EFF_WAVE", wavelength)
        for name, values in rows.columns.items():
            if name.endswith("COORD") and (longest := np.abs(values).max(initial=0.0)) > _LONGEST:
                raise ValueError(f"{path}: {name} reaches {longest:.4g}: it must be in m, not divided by wavelength")


def _warn_of_unusable(path: Path, vis2: _Rows, t3: _Rows) -> None:
    kinds = {"|V|^2": vis2, "closure phases": t3}
    told = [
        f"{rows.unusable} of {rows.unusable + len(rows.wavelength)} {name}"
        for name, rows in kinds.items()
        if rows.unusable
    ]
    if told:
        warnings.warn(
            f"{path}: {' and '.join(told)} are left out, as they are not finite or have no positive error",
            stacklevel=4,
        )


def _target_numbers(path: Path, hdus: Any, target: str | None) -> list[int] | None:
    """Return every TARGET_ID of the target; None if the file names none."""
    rows = [
        (str(row["TARGET"]).strip(), int(row["TARGET_ID"]))
        for hdu in hdus
        if hdu.name == "OI_TARGET"
        for row in hdu.data
    ]
    names = list(dict.fromkeys(name for name, _ in rows))
    if target is not None and target not in names:
        raise ValueError(f"{path} has no target {target!r}: it has {', '.join(names) or 'none with a name'}")
    if target is None and len(names) > 1:
        raise ValueError(f"{path} holds several targets: say which of {', '.join(names)} is meant")
    return [number for name, number in rows if target in (None, name)] or None


def _gather(
    path: Path,
    hdus: Any,
    kind: str,
    measured: tuple[str, str],
    places: tuple[str, ...],
    target: list[int] | None,
    waves: dict[str, np.ndarray],
) -> _Rows:
    """Read all valid numbers of the tables of a kind; `measured` names the columns of values and errors."""
    parts: list[_Rows] = []
    for hdu in hdus:
        if hdu.name != kind or not len(hdu.data):
            continue
        instrument = str(hdu.header["INSNAME"]).strip()
        if instrument not in waves:
            raise ValueError(f"{path}: {kind} is of instrument {instrument}, which has no OI_WAVELENGTH")
        for name in measured:
            unit = (hdu.columns[name].unit or "").strip().lower()
            if unit.startswith(("rad", "mrad")):
                raise ValueError(f"{path}: {name} is in {unit} by its TUNIT: OIFITS phases must be in deg")
            if hdu.data[name].size != len(hdu.data) * len(waves[instrument]):
                raise ValueError(
                    f"{path}: {kind} has {hdu.data[name].size} values of {name} in {len(hdu.data)} rows, and the "
                    f"OI_WAVELENGTH of its instrument {instrument} {len(waves[instrument])} wavelengths: each row must "
                    "have a value for each wavelength"
                )
        parts.append(_good_rows(hdu, len(parts), measured, places, target, waves[instrument]))
    if not parts:
        none = np.zeros(0)
        columns = dict.fromkeys((*measured, *places), none)
        nowhere = np.zeros((0, 3), dtype=int)
        return _Rows(columns, none, nowhere, nowhere, none.astype(str), none.astype(int), 0)
    return _Rows(
        {name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns},
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("wavelength", "stations", "exposure", "corrname", "place")
        ),
        unusable=sum(part.unusable for part in parts),
    )


def _good_rows(
    hdu: Any, table: int, measured: tuple[str, str], places: tuple[str, ...], target: list[int] | None, wave: np.ndarray
) -> _Rows:
    data, n = hdu.data, len(wave)
    shape = (len(data), n)
    values, errors = (np.asarray(data[name], dtype=float).reshape(shape) for name in measured)
    good = np.isfinite(values) & np.isfinite(errors) & (errors > 0) & np.isfinite(wave)
    for name in places:
        good &= np.isfinite(np.asarray(data[name], dtype=float)).reshape(-1, 1)
    meant = ~np.asarray(data["FLAG"], dtype=bool).reshape(shape)
    if target is not None:
        meant &= np.isin(np.asarray(data["TARGET_ID"]).reshape(-1, 1), target)
    unusable = int((meant & ~good).sum())
    good &= meant

    def spread(column: Any) -> np.ndarray:
        """Return a column's value of the row of each valid number."""
        return np.broadcast_to(np.asarray(column).reshape(-1, 1), shape)[good]

    columns = {measured[0]: values[good], measured[1]: errors[good]}
    columns |= {name: spread(np.asarray(data[name], dtype=float)) for name in places}
    channels = np.broadcast_to(np.arange(n), shape)
    clocks = [np.asarray(data[name], dtype=float) for name in ("MJD", "TIME") if name in hdu.columns.names]
    _, times = np.unique(np.stack(clocks, 1), axis=0, return_inverse=True)
    exposure = np.stack([np.full(good.sum(), table), spread(times), channels[good]], 1)
    holes = np.asarray(data["STA_INDEX"], dtype=int).reshape(len(data), -1)
    stations = np.broadcast_to(holes[:, None], (*shape, holes.shape[1]))[good]
    index = f"CORRINDX_{measured[0]}"
    first = np.asarray(data[index]).reshape(-1, 1) if index in hdu.columns.names else np.zeros((len(data), 1), int)
    place = np.where(first > 0, first + channels, 0)[good].astype(int)
    corrname = np.full(good.sum(), str(hdu.header.get("CORRNAME", "")).strip())
    return _Rows(columns, np.broadcast_to(wave, shape)[good], stations, exposure, corrname, place, unusable)


def _tensor(rows: _Rows, *names: str) -> Tensor:
    return torch.as_tensor(np.stack([rows.columns[name] for name in names], 1))
