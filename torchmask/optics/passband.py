"""Transmission curves of filters, files and top-hat bands, and the number of photons that pass."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import constants

from torchmask.io import extra

_AB_ZERO = 3631e-26  # W / (m^2 Hz) of AB magnitude 0: Oke & Gunn, Astrophys. J. 266, 713 (1983), as 3631 Jy
_LIGHT = (1e-8, 1e-2)  # m
_FILES = (".txt", ".dat", ".csv")
_ROUNDING = 1e-6  # by which a curve that was scaled to a peak of 1 may exceed it
_RELATIVE = 1e-3  # a named curve that peaks below has a unit of its own: 2MASS's peak at 4e-5 to 8e-5

# AB - Vega magnitudes: Blanton & Roweis, Astron. J. 133, 734 (2007), table 1.
VEGA_IN_AB = {
    "bessell-U": 0.79,
    "bessell-B": -0.09,
    "bessell-V": 0.02,
    "bessell-R": 0.21,
    "bessell-I": 0.45,
    "twomass-J": 0.91,
    "twomass-H": 1.39,
    "twomass-Ks": 1.85,
}


@dataclass(frozen=True)
class Passband:
    """A transmission curve given at some wavelengths [m], linear in between and zero outside.

    Depending on its source it may include the atmosphere or a camera. The curves of 2MASS, which are published in a
    unit of their own, are scaled to a peak of 1.

    Raises ValueError if the sequences differ in length or have fewer than 2 values, wavelengths do not increase, or the
    transmission is negative or above 1 somewhere, or positive nowhere.

    Examples
    --------
    >>> passband = Passband.top_hat(550e-9, 100e-9)
    >>> round(passband.ab_photons / 1e9, 2)  # 1e9 photons / (s m^2) of a source of AB magnitude 0
    9.99
    """

    wavelengths: tuple[float, ...]
    transmission: tuple[float, ...]

    def __post_init__(self) -> None:
        check_curve(np.asarray(self.wavelengths, dtype=float), np.asarray(self.transmission, dtype=float))
        if (peak := max(self.transmission)) > 1 + _ROUNDING:
            raise ValueError(
                f"the curve's transmission reaches {peak:.4g}: it must be a fraction, at most 1; is it in percent? "
                "then divide by 100"
            )

    @classmethod
    def top_hat(cls, wavelength: float, width: float) -> Passband:
        """Return a transmission of 1 over `width` [m] around `wavelength` [m].

        Raises ValueError unless the width is positive and less than twice the wavelength.
        """
        if not 0 < width < 2 * wavelength:
            raise ValueError(
                f"the band is {width:.3g} m wide around {wavelength:.3g} m: its width must be positive and less than "
                "twice the wavelength"
            )
        return cls((wavelength - width / 2, wavelength + width / 2), (1.0, 1.0))

    @classmethod
    def find(cls, name: str | Path) -> Passband:
        """Return the curve of a filter, by its name or from a file.

        Parameters
        ----------
        name : str or path
            Name in speclite, GROUP-BAND such as "bessell-V", "sdss2010-r" or "twomass-Ks" (extra `filters`), or a text
            file (.txt, .dat, .csv) of two columns: wavelength [m] and transmission.

        Raises
        ------
        ValueError
            If the name is unknown (the message lists the known ones), or the file is missing or has no valid curve.
        ModuleNotFoundError
            If a name is given and speclite is not installed.
        """
        path = Path(name)
        return _read_curve(path) if path.suffix.lower() in _FILES else _named_curve(str(name))

    @property
    def mean_wavelength(self) -> float:
        """Mean wavelength [m] of light with equally many photons at each wavelength."""
        x, y = np.array(self.wavelengths), np.array(self.transmission)
        step, before, after = np.diff(x), y[:-1], y[1:]
        moment = step * (x[:-1] * (2 * before + after) + x[1:] * (before + 2 * after)) / 6
        return float(moment.sum() / (step * (before + after) / 2).sum())

    @property
    def ab_photons(self) -> float:
        """Photons per second and square metre from a source of AB magnitude 0, for any spectrum.

        By definition they are as many as from a source of 3631 Jy at all frequencies:
        3631 Jy / h * integral of transmission / wavelength.
        """
        x, y = np.array(self.wavelengths), np.array(self.transmission)
        slope = np.diff(y) / np.diff(x)
        ratio = np.log(x[1:] / x[:-1])
        return float(_AB_ZERO / constants.h * (slope * np.diff(x) + (y[:-1] - slope * x[:-1]) * ratio).sum())

    def light(self, temperature: float | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return wavelengths [m] and relative numbers of photons from a black body of `temperature` [K] that pass.

        None means equally many photons at each wavelength. Raises ValueError if the temperature is not positive.
        """
        x, y = np.array(self.wavelengths), np.array(self.transmission)
        if temperature is None:
            return x, y
        if not (math.isfinite(temperature) and temperature > 0):
            raise ValueError(f"temperature is {temperature}: it must be finite and positive, in K")
        fine = np.unique(np.concatenate([x, np.linspace(x[0], x[-1], 400)]))
        exponent = constants.h * constants.c / (fine * constants.k * temperature)
        logarithm = -4 * np.log(fine) - np.log(-np.expm1(-exponent)) - exponent  # of Planck's photon spectrum
        return fine, np.interp(fine, x, y) * np.exp(logarithm - logarithm.max())


def check_curve(wavelengths: np.ndarray, transmission: np.ndarray) -> None:
    """Raise ValueError unless these are a transmission curve as `Passband` describes it."""
    if wavelengths.ndim != 1 or wavelengths.shape != transmission.shape or len(wavelengths) < 2:
        raise ValueError(
            f"wavelengths have shape {wavelengths.shape} and transmissions {transmission.shape}: equal numbers, and at "
            "least 2, are needed"
        )
    if not (np.isfinite(wavelengths).all() and wavelengths[0] > 0 and (np.diff(wavelengths) > 0).all()):
        raise ValueError("the curve's wavelengths must be finite, positive and increasing, in m")
    if not (np.isfinite(transmission).all() and transmission.min() >= 0 and transmission.max() > 0):
        raise ValueError("the curve's transmission must be finite, nowhere negative and somewhere positive")


def _read_curve(path: Path) -> Passband:
    if not path.is_file():
        raise ValueError(f"there is no file {path} (needed: two columns, wavelength [m] and transmission)")
    try:
        lines = path.read_text(encoding="utf-8").replace(",", " ").splitlines()
        table = np.loadtxt(lines, ndmin=2)
        if table.shape[1] != 2:
            raise ValueError(f"it has {table.shape[1]} columns, and 2 are needed")
        if not _LIGHT[0] <= table[:, 0].min() <= table[:, 0].max() <= _LIGHT[1]:
            raise ValueError(
                f"its wavelengths run from {table[:, 0].min():g} to {table[:, 0].max():g}, and they must be in m: "
                "multiply nm by 1e-9, Angstrom by 1e-10"
            )
        return Passband(tuple(table[:, 0].tolist()), tuple(table[:, 1].tolist()))
    except ValueError as error:
        raise ValueError(f"{path} holds no transmission curve: {error}") from error


def _named_curve(name: str) -> Passband:
    with extra("filters"):
        from speclite import filters

    try:
        curve = filters.load_filter(name)
    except ValueError as error:
        group = name.partition("-")[0]
        if group in filters.filter_group_names:
            known = f"of {group} they are {', '.join(filters.load_filters(f'{group}-*').names)}"
        else:
            known = f"they are GROUP-BAND, such as bessell-V, with the groups {', '.join(filters.filter_group_names)}"
        raise ValueError(f"there is no filter {name!r}: {known}; or give a file ({', '.join(_FILES)})") from error
    peak = float(curve.response.max())
    response = curve.response / (peak if peak < _RELATIVE else 1.0)
    return Passband(tuple((1e-10 * curve.wavelength).tolist()), tuple(response.tolist()))
