"""Checks of numbers that a user gives."""

from __future__ import annotations

import math
from numbers import Real

WIDEST = 1000.0  # [m], diameter of a telescope
THROUGH_AIR = 1e-7, 5e-5  # [m] of an observation, from the ultraviolet to beyond the last window of the infrared


def require(name: str, value: float | None, unit: str = "", zero: bool = False, most: float = math.inf) -> None:
    """Raise ValueError unless the number is None, or finite, positive (or `zero`) and no more than `most`.

    >>> require("diameter", -1.0, ", in m")
    Traceback (most recent call last):
    ValueError: diameter is -1.0: it must be finite and positive, in m
    """
    if value is None or (math.isfinite(value) and (value > 0 or (zero and value == 0)) and value <= most):
        return
    least = "at least 0" if zero else "positive"
    raise ValueError(
        f"{name} is {value}: it must be finite and {least}{f', at most {most:g}' * (most < math.inf)}{unit}"
    )


def require_within(name: str, value: float | None, least: float, most: float, unit: str, reason: str) -> None:
    """Raise ValueError unless the number is None, or possible: from `least` to `most`.

    >>> require_within("wind", 1e30, 0.01, 200.0, " m/s", "calm air to the fastest jet streams")
    Traceback (most recent call last):
    ValueError: wind is 1e+30: it must be from 0.01 to 200 m/s (calm air to the fastest jet streams); the nearest \
possible is 200 m/s
    """
    if value is None or least <= value <= most:
        return
    nearest = "" if math.isnan(value) else f"; the nearest possible is {min(max(value, least), most):g}{unit}"
    raise ValueError(f"{name} is {value}: it must be from {least:g} to {most:g}{unit} ({reason}){nearest}")


def require_wavelength(name: str, metres: float | None, least: float = 1e-8, most: float = 1e-2) -> None:
    """Raise ValueError unless this is None or a wavelength of light in metres; the message recognises other units.

    >>> require_wavelength("wavelength", 550.0)
    Traceback (most recent call last):
    ValueError: wavelength is 550: it must be a wavelength of light in m, from 1e-08 to 0.01; 550 nm are 550e-9
    """
    if metres is None or least <= metres <= most:
        return
    meant = "550 nm are 550e-9"
    for unit, power, low, high in (("nm", "e-9", 100, 1e5), ("micrometres", "e-6", 0.1, 100)):
        if low <= metres < high:
            meant = f"{metres:g} {unit} are {metres:g}{power}"
    need = f"it must be a wavelength of light in m, from {least:g} to {most:g}"
    raise ValueError(f"{name} is {metres:g}: {need}; {meant}")


def require_r0(name: str, r0: float | None) -> None:
    """Raise ValueError unless this is None or a Fried parameter [m] of air above a telescope.

    From 1 mm, of visible light along the ground, to 20 m, of 40 micrometres on the best nights. What laboratories make
    is not of this range; `TurbulencePhase` takes any.
    """
    require_within(name, r0, 1e-3, 20.0, " m", "visible light along the ground to 40 micrometres on the best nights")


def require_diameter(name: str, metres: float | None) -> None:
    """Raise ValueError unless this is None or the diameter [m] of a telescope or a mask; millimetres are recognised.

    >>> require_diameter("mask_diameter", 8200.0)
    Traceback (most recent call last):
    ValueError: mask_diameter is 8200.0: it must be from 0.001 to 1000 m (a mask on a bench to the largest telescope \
thought of; in m, so 8.2 m are 8.2); the nearest possible is 1000 m
    """
    require_within(
        *(name, metres, 1e-3, WIDEST, " m"),
        "a mask on a bench to the largest telescope thought of; in m, so 8.2 m are 8.2",
    )


def whole_number(name: str, value: float, least: int = 1, most: float = math.inf, note: str = "") -> int:
    """Return a count as an int; floats without a fraction pass, as arithmetic makes them.

    Raises ValueError unless it is a whole number from `least` to `most`, and TypeError if it is no number at all; a
    note ends the message.

    >>> whole_number("n_frames", 20.0)
    20
    >>> whole_number("n_frames", 2.5)
    Traceback (most recent call last):
    ValueError: n_frames is 2.5: it must be a whole number of at least 1
    """
    if isinstance(value, bool) or not isinstance(value, Real):
        raise TypeError(f"{name} is {value!r}: it must be a whole number{note}")
    if float(value).is_integer() and least <= value <= most:
        return int(value)
    among = f"of at least {least}" if math.isinf(most) else f"from {least} to {most:g}"
    raise ValueError(f"{name} is {value}: it must be a whole number {among}{note}")
