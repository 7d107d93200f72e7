"""Tables that numpy and scipy make, apart from what is in force where they are first needed."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Made = TypeVar("Made")


class _Stopped(BaseException):
    """Ends a call that nobody waits for any more; nothing that handles errors takes it for one."""


def make_apart(make: Callable[..., Made], *arguments: object) -> Made:
    """Return `make(*arguments)`, called in a thread of its own.

    There neither a default device nor inference mode is in force, nor a transform such as `torch.func.jacrev`, within
    which tensors have no numbers that numpy could read. An interruption, such as Ctrl-C, ends the call at its next
    step.
    """
    with ThreadPoolExecutor(1) as own:
        thread = own.submit(threading.get_ident).result()
        made = own.submit(make, *arguments)
        try:
            return made.result()
        except BaseException:
            if not made.done():  # leaving the block would wait for it, for minutes
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(_Stopped))
            raise
