"""Process frames in parallel on the processor's cores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import torch

from torchmask.restoration.cuda_graphs import shared_graph_memory

Map = Callable[[Callable[[Any], Any], Iterable[Any]], Iterable[Any]]


@contextmanager
def each_on_a_core(device: torch.device) -> Iterator[Map]:
    """Provide a `map` whose calls run on as many threads as torch may use, one core each.

    The arrays of a few frames are too small for torch's own threads, which cost more time than they save. Within the
    context torch uses one thread, so that results do not depend on the number of threads. A GPU takes many frames at
    once: for it the `map` is Python's, and the CUDA graphs of all calls work in the same memory.
    """
    n_threads = torch.get_num_threads()
    if device.type != "cpu" or n_threads == 1:
        with shared_graph_memory(device):
            yield map
        return
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(n_threads, initializer=torch.set_num_threads, initargs=(1,)) as pool:
            yield pool.map
    finally:
        torch.set_num_threads(n_threads)
