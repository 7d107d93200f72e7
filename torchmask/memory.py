"""Keep memory that an evaluation frees in the process, where the next one can reuse it."""

from __future__ import annotations

import torch

_LARGEST = 2**25 - 2**16  # bytes; glibc does not adapt to blocks of 32 MiB and more


def keep_freed_memory() -> None:
    """Make glibc keep freed memory, which it returns to the system by default.

    Free memory at the end of the heap is returned when it is more than twice the largest block that was ever freed
    (M_TRIM_THRESHOLD in mallopt(3)). The arrays of one evaluation exceed that, so each would request its pages anew,
    which takes up to 40 % of the time of a restoration at 10 x 64 x 64, and some 10 % of that of a criterion. Freeing
    one large block raises the threshold; its pages are never touched. Other allocators are not affected.
    """
    torch.empty(_LARGEST, dtype=torch.uint8, device="cpu")
