"""Memory: refuse what exceeds that of this machine, keep what an evaluation frees, and size work by the device."""

from __future__ import annotations

import math
import os
from typing import NamedTuple

import torch

_LARGEST = 2**25 - 2**16  # bytes; glibc does not adapt to blocks of 32 MiB and more


class AtATime(NamedTuple):
    """How much to work on at a time: what the cache of a processor holds, or what makes up for the launches of a GPU.

    Examples
    --------
    >>> AtATime(processor=2**18, gpu=2**24).on(torch.device("cpu")) == 2**18
    True
    """

    processor: int
    gpu: int

    def on(self, device: torch.device) -> int:
        """Return the number for a device."""
        return self.processor if device.type == "cpu" else self.gpu


def keep_freed_memory() -> None:
    """Make glibc keep freed memory, which it returns to the system by default.

    Free memory at the end of the heap is returned when it is more than twice the largest block that was ever freed
    (M_TRIM_THRESHOLD in mallopt(3)). The arrays of one evaluation exceed that, so each would request its pages anew,
    which takes up to 40 % of the time of a restoration at 10 x 64 x 64, and some 10 % of that of a criterion. Freeing
    one large block raises the threshold; its pages are never touched. Other allocators are not affected.
    """
    torch.empty(_LARGEST, dtype=torch.uint8, device="cpu")


def require_memory(name: str, value: float, n_bytes: float, power: int = 1) -> None:
    """Raise ValueError if arrays exceed the memory of this machine; the message says what of `value` it would hold.

    Parameters
    ----------
    name : str
        Name of the number on which the size of the arrays depends.
    value : float
        That number.
    n_bytes : float
        Size of the arrays, or a lower limit on it [bytes].
    power : int
        Power of the number with which the size grows.

    Examples
    --------
    >>> require_memory("n_pixels", 1000, 8.0 * 1000**2, power=2)
    """
    held = _machine_memory()
    if n_bytes <= held:
        return
    most = value * (held / n_bytes) ** (1 / power)
    told, fits = (value, math.floor(most)) if isinstance(value, int) else (f"{value:.6g}", f"{0.9995 * most:.4g}")
    raise ValueError(
        f"{name} is {told}: that takes at least {n_bytes / 2**30:.4g} GiB of memory, and this machine has "
        f"{held / 2**30:.4g} GiB, enough for {fits} at most"
    )


def _machine_memory() -> float:
    """Return the memory of this machine [bytes], infinite where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):  # Windows has no sysconf
        return math.inf
