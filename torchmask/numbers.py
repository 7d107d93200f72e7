"""The check of a number that a user gives."""

from __future__ import annotations

import math


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
