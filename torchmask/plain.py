"""Refusal of values of another type, and of those that say more than numbers: with a unit, or some behind a mask."""

from __future__ import annotations

from typing import Any

import numpy as np

_WANTED = ("m", "rad", "s", "electron")  # SI, and electrons for images


def require_plain(name: str, values: Any) -> None:
    """Raise an error if values have a unit of astropy, or are a masked array of NumPy that hides some of them.

    Both would be lost without a word where they become a tensor or a number.

    Raises
    ------
    TypeError
        If the values have a unit; the message says which is wanted.
    ValueError
        If a mask hides values.

    Examples
    --------
    >>> require_plain("dark", np.ma.masked_greater(np.array([1.0, 9.0]), 5.0))
    Traceback (most recent call last):
    ValueError: dark hides 1 of 2 values behind a mask: give dark.filled(0), with valid=~dark.mask for frames
    """
    unit = getattr(values, "unit", None)
    if unit is not None and hasattr(values, "to_value"):
        wanted = next((f"to_value({known!r})" for known in _WANTED if unit.is_equivalent(known)), "value")
        raise TypeError(f"{name} has the unit {unit}: plain numbers are needed, give {name}.{wanted}")
    hidden = int(np.ma.getmaskarray(values).sum()) if isinstance(values, np.ma.MaskedArray) else 0
    if hidden:
        raise ValueError(
            f"{name} hides {hidden} of {values.size} values behind a mask: give {name}.filled(0), with "
            f"valid=~{name}.mask for frames"
        )


def require_type(name: str, value: Any, kind: type, example: str = "") -> None:
    """Raise TypeError unless a value is of a type; the message can give an example.

    Examples
    --------
    >>> require_type("n_frames", "20", int)
    Traceback (most recent call last):
    TypeError: n_frames is of type str: it must be of type int
    """
    if not isinstance(value, kind):
        such = f", such as {example}" if example else ""
        raise TypeError(f"{name} is of type {type(value).__name__}: it must be of type {kind.__name__}{such}")
