"""Options of a broad band, given by a filter, by wavelengths, or by an instrument."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require_wavelength
from torchmask.optics.band import Band
from torchmask.optics.passband import Passband


@dataclass(frozen=True, kw_only=True)
class FilterOptions:
    """A broad band, given by a filter."""

    filter: str | None = None
    """Filter: its name (bessell-V, twomass-Ks, ...), or a text file with columns wavelength [m] and transmission."""
    n_wavelengths: int = 5
    """Number of wavelengths that represent the band: 3 suffice for a width of 5 percent of the wavelength, 5 for 15."""
    temperature: float | None = None
    """Temperature of the source's black-body spectrum inside the filter [K]; None: equally many photons at each
    wavelength."""

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
class BandOptions(FilterOptions):
    """A broad band, given by a filter or by wavelengths."""

    wavelengths: tuple[float, ...] = ()
    """Wavelengths that represent a broad band, instead of a filter [m]; none: --filter, or --wavelength alone."""
    weights: tuple[float, ...] = ()
    """Relative amount of light at each of --wavelengths, any positive numbers; none: equal amounts."""

    def told_width(self) -> float | None:
        """Return the width of the band [m]; None if there is none. Raises ValueError for an unknown filter."""
        if self.filter is not None:
            return Band.from_filter(self.filter, self.n_wavelengths, self.temperature).width or None
        return Band.of(self.wavelengths, self.weights or None).width or None if self.wavelengths else None

    def band(self, wavelength: float) -> dict[str, Any]:
        """Return the band as `MyopicDeconvolution` takes it.

        Raises ValueError for two bands, another filter, or wavelengths that are not of light in m.
        """
        if self.weights and not self.wavelengths:
            raise ValueError("--weights are those of --wavelengths: give both")
        for one in self.wavelengths:
            require_wavelength("--wavelengths", one)
        band = self.filter_band(wavelength)
        if band is None:
            if self.temperature is not None:
                raise ValueError("--temperature is that of light through --filter: give one, or leave it out")
            return {"wavelengths": self.wavelengths or None, "weights": self.weights or None}
        if self.wavelengths or self.weights:
            raise ValueError("--filter and --wavelengths are both given: give only one of them")
        return {"wavelengths": band.wavelengths, "weights": band.shares}


def band_of_instrument(known: Instrument) -> dict[str, Any]:
    """Return the values of `BandOptions` that an instrument gives."""
    band, filtered = known.band, known.filter is not None
    return {
        "filter": known.filter,
        "temperature": known.source.temperature if filtered else None,
        "n_wavelengths": known.n_wavelengths,
        "wavelengths": () if filtered else band.wavelengths,
        "weights": () if filtered else band.shares,
    }
