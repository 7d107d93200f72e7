"""Tables that numpy and scipy make, apart from what is in force where they are first needed."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Made = TypeVar("Made")


def make_apart(make: Callable[..., Made], *arguments: object) -> Made:
    """Return `make(*arguments)`, called in a thread of its own.

    There neither a default device nor inference mode is in force, nor a transform such as `torch.func.jacrev`, within
    which tensors have no numbers that numpy could read.
    """
    with ThreadPoolExecutor(1) as own:
        return own.submit(make, *arguments).result()
