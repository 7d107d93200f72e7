"""Agreement of a stack with the file of its instrument, which fills in what the stack lacks."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from torchmask.atmosphere.seeing import Seeing
from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.observation import Observation
from torchmask.optics.pixel import SquarePixel


@dataclass(frozen=True)
class Statement:
    """What a stack and an instrument say of one quantity.

    option : name of the option that decides between them
    seen, planned : values of the stack and of the instrument; None: it says nothing
    unit : their unit
    tolerance : relative difference that is no contradiction
    """

    option: str
    seen: float | None
    planned: float | None
    unit: str
    tolerance: float = 0.01

    @property
    def contradicts(self) -> bool:
        """Whether both say something, and not the same."""
        if self.seen is None or self.planned is None:
            return False
        return abs(self.seen - self.planned) > self.tolerance * max(abs(self.seen), abs(self.planned))

    def __str__(self) -> str:
        return f"--{self.option.replace('_', '-')} ({self.seen:.4g} against {self.planned:.4g} {self.unit})"


def complete(observation: Observation, known: Instrument, given: Collection[str], path: Path) -> Observation:
    """Return the observation with read-out noise and pixels of an instrument, where it lacks them.

    `given` names the options that were given, which win. Raises ValueError, which names all contradictions and the
    options that decide, if stack and instrument disagree on anything else.
    """
    camera, pixel = known.camera, observation.pixel
    statements = [
        Statement("wavelength", observation.grid.wavelength, known.mean_wavelength, "m"),
        Statement("pixel_scale_arcsec", observation.grid.pixel_scale / ARCSEC, camera.pixel_scale, "arcsec"),
        Statement("readout_noise", observation.readout_noise, camera.readout_noise, "electrons", 0.1),
    ]
    if isinstance(pixel, SquarePixel):
        statements.append(Statement("pixel_fill", pixel.fill_factor, camera.pixel_fill, "of the area"))
    require_agreement([item for item in statements if item.option not in given], path)
    noise = camera.readout_noise if observation.readout_noise is None else observation.readout_noise
    if pixel is None and "pixel_fill" not in given:
        pixel = camera.pixel
    return replace(observation, readout_noise=noise, pixel=pixel)


def require_agreement(statements: Collection[Statement], path: str | Path) -> None:
    """Raise ValueError if a stack and an instrument contradict each other."""
    wrong = [str(item) for item in statements if item.contradicts]
    if wrong:
        raise ValueError(
            f"{path} and --instrument disagree on {' and '.join(wrong)}: give {'these options' if wrong[1:] else 'it'} "
            "to say what is right"
        )


def planned_scale(known: Instrument) -> float | None:
    """Return the angle of a pixel [rad] if an instrument says it, None if it follows from the telescope."""
    return None if known.camera.pixel_scale is None else known.pixel_scale


def require_time(seconds: float) -> None:
    """Raise ValueError unless this can be an exposure time [s]."""
    if not 0 < seconds < float("inf"):
        raise ValueError(f"--exposure-time is {seconds:g}: it must be finite and positive, in s")


def exposure_in_tau0(
    observation: Observation,
    known: Instrument | None,
    exposure_time: float | None,
    wind: float | None,
    r0: float | None,
) -> float:
    """Return the exposure time of a frame [tau0]; 0, for snapshots, if no wind is known.

    `exposure_time` [s], `wind` [m/s] and `r0` [m] are those that were given, and otherwise those of the stack and the
    instrument. Raises ValueError if a wind is known without the others, or stack and instrument contradict each other.
    """
    if known is not None:
        wind = known.site.wind if wind is None else wind
        r0 = known.site.r0 if r0 is None else r0
        seen = observation.exposure_time
        if exposure_time is None:
            require_agreement([Statement("exposure_time", seen, known.exposure, "s")], "the stack")
            exposure_time = known.exposure
    if wind is None:
        return 0.0
    time = observation.exposure_time if exposure_time is None else exposure_time
    if r0 is None:
        raise ValueError("--wind says how fast turbulence moves; how much it changes meanwhile needs --r0 too [m]")
    if time is None:
        raise ValueError("--wind says how fast turbulence moves; for how long needs --exposure-time too [s]")
    return time / Seeing(r0, wind=wind).tau0
