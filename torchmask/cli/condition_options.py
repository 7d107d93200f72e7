"""Options of the conditions under which frames are simulated: turbulence, sky, clouds and band."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.cli.band_options import FilterOptions
from torchmask.instrument.instrument import Instrument
from torchmask.numbers import require_r0, require_within
from torchmask.optics.band import Band, warn_of_few_wavelengths
from torchmask.optics.passband import Passband
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.wavefronts import Turbulence

_DEFAULT_R0 = 0.15  # [m]


@dataclass(frozen=True)
class TurbulenceOptions:
    """Layers, wind and timing of the turbulence."""

    profile: str | None = None
    """Profile of layers at the zenith: hv57, las_campanas or mauna_kea; None: all turbulence at the pupil."""
    layers: int = 8
    """Number of layers into which the profile is grouped; theta0 and tau0 do not depend on it."""
    wind: tuple[float, float] | None = None
    """Wind speed towards +x and +y [m/s]; None: the winds of the profile, or no wind without one."""
    frame_interval: float | None = None
    """Time from the start of one frame to the next [s], for drifting turbulence; None: independent frames."""
    exposure_time: float = 0.0
    """Exposure time of a frame [s]; needs a wind."""

    def make(self, r0: float | None, wavelength: float, outer_scale: float) -> Turbulence:
        """Return the turbulence with Fried parameter `r0` [m], of which the option tells what None and inf mean."""
        if self.wind is not None:
            speed = math.hypot(*self.wind)
            require_within("--turbulence.wind", speed, 0.0, 200.0, " m/s", "calm air to the fastest jet streams")
        if r0 == math.inf:
            return None
        require_r0("--r0", r0)
        if self.profile is not None:
            layers = named_layers(self.profile, self.layers)
            if r0 is not None or self.wind is not None:
                winds = layers.winds if self.wind is None else [self.wind] * len(layers.heights)
                layers = Layers.from_fractions(
                    layers.r0(wavelength) if r0 is None else r0, wavelength, layers.heights, layers.strengths, winds
                )
            return LayeredPhase(layers, wavelength, outer_scale, self.frame_interval)
        r0 = _DEFAULT_R0 if r0 is None else r0
        if self.wind is None:
            if self.frame_interval is not None:
                raise ValueError("--turbulence.frame-interval needs --turbulence.wind or --turbulence.profile")
            if self.exposure_time > 0:
                raise ValueError("--turbulence.exposure-time needs --turbulence.wind or --turbulence.profile")
            return TurbulencePhase(r0, outer_scale)
        layers = Layers.from_fractions(r0, wavelength, [0.0], [1.0], [self.wind])
        return LayeredPhase(layers, wavelength, outer_scale, self.frame_interval)


@dataclass(frozen=True, kw_only=True)
class ConditionOptions(FilterOptions):
    """Observing conditions: sky, clouds and band."""

    sky: float | None = None
    """Sky background [electrons per pixel and frame]; None: from --instrument, or else 0."""
    transparency_scatter: float = 0.0
    """Standard deviation of the logarithm of each frame's transmission, due to clouds."""
    band_width: float | None = None
    """Width of a top-hat band around the wavelength, instead of a filter [m]; None: that of --instrument, or else 0,
    one wavelength."""

    def following(self, used: Instrument, area: float) -> ConditionOptions:
        """Return the same with the sky through an open area [m^2] and the band of an instrument, unless given."""
        sky = used.sky(area) if self.sky is None else self.sky
        if self.band_width == 0 and self.filter is None:  # one wavelength is asked for
            return replace(self, sky=sky)
        temperature = used.source.temperature
        return replace(self, sky=sky, filter=used.filter, band_width=used.width, temperature=temperature)

    def make(self, exposure_time: float, wavelength: float) -> Conditions:
        """Return the conditions for `simulate_observation`. Raises ValueError if a value is out of range."""
        width = self.band_width or 0.0
        if not (math.isfinite(width) and 0 <= width < 2 * wavelength):
            raise ValueError(
                f"--conditions.band-width is {width}: it must be at least 0 m and below twice the wavelength"
            )
        if width and self.filter is not None:
            raise ValueError("--conditions.band-width and --conditions.filter are both given: give only one of them")
        if self.temperature is not None and not width and self.filter is None:
            raise ValueError(
                "--conditions.temperature is that of light in a band: give --conditions.filter or "
                "--conditions.band-width, or leave it out"
            )
        band, passband = self.filter_band(wavelength), None if self.filter is None else Passband.find(self.filter)
        if width:
            passband = Passband.top_hat(wavelength, width)
            band = Band.from_filter(passband, self.n_wavelengths, self.temperature)
        if passband is not None:
            warn_of_few_wavelengths(passband, self.n_wavelengths, self.temperature)
        return Conditions(
            sky=self.sky or 0.0,
            transparency_scatter=self.transparency_scatter,
            exposure_time=exposure_time,
            band=band,
        )
