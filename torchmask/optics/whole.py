"""The check of whole numbers that a user gives."""

from __future__ import annotations

import math


def whole_number(name: str, value: float, least: int = 1, most: float = math.inf, note: str = "") -> int:
    """Return a count as an int; floats without a fraction pass, as arithmetic makes them.

    Raises ValueError unless it is a whole number from `least` to `most`; a note ends the message.

    >>> whole_number("n_frames", 20.0)
    20
    >>> whole_number("n_frames", 2.5)
    Traceback (most recent call last):
    ValueError: n_frames is 2.5: it must be a whole number of at least 1
    """
    if float(value).is_integer() and least <= value <= most:
        return int(value)
    among = f"of at least {least}" if math.isinf(most) else f"from {least} to {most:g}"
    raise ValueError(f"{name} is {value}: it must be a whole number {among}{note}")
