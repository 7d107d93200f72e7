"""Options of a broad band, given by a filter, by wavelengths, or by an instrument."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchmask.cli.instrument_used import UsedInstrumentOptions
from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require_wavelength
from torchmask.optics.band import Band
from torchmask.optics.passband import Passband


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """A broad band, given by a filter."""

    filter: str | None = None
    """Filter: its name (bessell-V, twomass-Ks, ...), or a text file with columns wavelength [m] and transmission; None:
    that of --instrument, or else none."""
    n_wavelengths: int = 5
    """Number of wavelengths that represent the band: 3 suffice for a width of 5 percent of the wavelength, 5 for 15."""
    temperature: float | None = None
    """Temperature of the source's black-body spectrum inside the band [K]; None: that of --instrument, or else equally
    many photons at each wavelength."""

    def told_wavelength(self, given: float | None) -> float | None:
        """Return the wavelength [m] that is given, or else the mean of the filter; None if there is neither."""
        require_wavelength("--wavelength", given)
        if given is not None:
            return given
        return None if self.filter is None else Passband.find(self.filter).mean_wavelength

    def filter_band(self, wavelength: float) -> Band | None:
        """Return the band of the filter, None without one. Raises ValueError if it does not pass `wavelength` [m]."""
        if self.filter is None:
            return None
        passband = Passband.find(self.filter)
        first, last = passband.wavelengths[0], passband.wavelengths[-1]
        if not first < wavelength < last:
            raise ValueError(
                f"filter {self.filter} passes {first:.4g} to {last:.4g} m, and not the wavelength {wavelength:.4g} m, "
                f"at which r0 is quoted: give one in between, such as its mean, {passband.mean_wavelength:.4g} m"
            )
        return Band.from_filter(passband, self.n_wavelengths, self.temperature)


@dataclass(frozen=True, kw_only=True)
class BandOptions(FilterOptions, UsedInstrumentOptions):
    """A broad band, given by a filter, by wavelengths, or by an instrument."""

    wavelengths: tuple[float, ...] = ()
    """Wavelengths that represent a broad band, instead of a filter [m]; none: --filter or --instrument, or else
    --wavelength alone."""
    weights: tuple[float, ...] = ()
    """Relative amount of light at each of --wavelengths, any positive numbers; none: equal amounts."""

    def beside_file(self) -> dict[str, Any]:
        """Return the values of options that say something of an instrument, whose band stays beside --wavelengths."""
        return {"filter": self.filter, "n_wavelengths": self.n_wavelengths, "temperature": self.temperature}

    def told_width(self) -> float | None:
        """Return the width of the band [m]; None if there is none. Raises ValueError for an unknown filter."""
        if self.wavelengths:
            return Band.of(self.wavelengths, self.weights or None).width or None
        if (used := self.used_instrument()) is not None:
            return used.band.width or None
        if self.filter is None:
            return None
        return Band.from_filter(self.filter, self.n_wavelengths, self.temperature).width or None

    def band(self, wavelength: float) -> dict[str, Any]:
        """Return the band as `MyopicDeconvolution` takes it.

        Raises ValueError for two bands, another filter, or wavelengths that are not of light in m.
        """
        if self.weights and not self.wavelengths:
            raise ValueError("--weights are those of --wavelengths: give both")
        for one in self.wavelengths:
            require_wavelength("--wavelengths", one)
        band = self.filter_band(wavelength)
        if band is not None and self.wavelengths:
            raise ValueError("--filter and --wavelengths are both given: give only one of them")
        used = None if self.wavelengths else self.used_instrument()
        band = band if used is None else used.band
        if band is not None:
            return {"wavelengths": band.wavelengths, "weights": band.shares}
        if self.temperature is not None:
            raise ValueError("--temperature is that of light through --filter: give one, or leave it out")
        return {"wavelengths": self.wavelengths or None, "weights": self.weights or None}


def band_of_instrument(known: Instrument) -> dict[str, Any]:
    """Return the values of `BandOptions` that an instrument gives: what they do not say follows from its file."""
    return {"n_wavelengths": known.n_wavelengths}
