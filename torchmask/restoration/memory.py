"""Memory that an evaluation gives back stays with the process, where the next one finds it."""

from __future__ import annotations

import torch

_LARGEST = 2**25 - 2**16  # bytes; glibc learns nothing from blocks of 32 MiB and more


def keep_freed_memory() -> None:
    """Make glibc keep the memory that is freed, where it hands it back to the system by default.

    What is free at the heap's end goes back as soon as it is more than twice the largest block that was ever freed
    (M_TRIM_THRESHOLD in mallopt(3)). The arrays of one evaluation together are more, so that each would ask the system
    for its pages anew, which takes up to 40 % of the time at 10 x 64 x 64. One large block that is freed moves the
    limit; its pages are never touched. Other allocators are not harmed by it.
    """
    torch.empty(_LARGEST, dtype=torch.uint8, device="cpu")
