"""CUDA graphs: what a function launches on a GPU is captured once and then replayed, one launch in place of hundreds.

Elsewhere functions stay as they are.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar, cast

import torch
from torch import Tensor

_EAGER = 2  # calls before the capture, in which libraries make their plans and workspaces

Made = TypeVar("Made", Tensor, tuple[Tensor, ...])


class Memory(NamedTuple):
    """Memory of several graphs, which `keeper`, a small one, keeps while they come and go, on one stream."""

    keeper: torch.cuda.CUDAGraph
    stream: torch.cuda.Stream


class _Here(threading.local):
    """What the graphs that this thread captures share, if anything."""

    memory: Memory | None = None


_here = _Here()


@contextmanager
def shared_graph_memory(device: torch.device) -> Iterator[None]:
    """Let all graphs that this thread captures on `device` within the context work in the same memory.

    Otherwise each has its own until the device runs out of memory. `Graphed` copies what a graph has made before
    another one is replayed, so they do not disturb each other.
    """
    before = _here.memory
    if device.type == "cuda" and before is None:
        stream = torch.cuda.Stream(device)
        keeper = capture(torch.zeros_like, (torch.zeros(1, device=device),), stream)
        _here.memory = Memory(keeper.graph, stream)
    try:
        yield
    finally:
        _here.memory = before


def graphed(function: Callable[..., Made], device: torch.device) -> Callable[..., Made]:
    """Return a function that gives the same as `function` of tensors on `device`, by a CUDA graph if that is a GPU.

    The third call captures the graph. Shapes have to be the same in all calls, and everything but the arguments has to
    stay where it is: it is not looked up again. A function that reads values of tensors, or makes tensors from numbers
    on the host, cannot be captured, and is called as it is.
    """
    return Graphed(function) if device.type == "cuda" else function


class Graphed(Generic[Made]):
    """A function by the CUDA graph that its third call captures; see `graphed`."""

    def __init__(self, function: Callable[..., Made]) -> None:
        self._function = function
        self._calls = 0
        self._captured: Captured[Made] | None = None

    def __call__(self, *given: Tensor) -> Made:
        if self._calls == _EAGER:
            try:
                self._captured = capture(self._function, given)
            except RuntimeError:  # of CUDA, by what a graph cannot hold
                _here.memory = None  # it may be left in the middle of a capture
        self._calls += 1
        return self._function(*given) if self._captured is None else self._captured(*given)


@dataclass(frozen=True)
class Captured(Generic[Made]):
    """A graph, the tensors from which it takes what it is given, and those into which it writes what it makes."""

    graph: torch.cuda.CUDAGraph
    given: tuple[Tensor, ...]
    made: Made

    def __call__(self, *given: Tensor) -> Made:
        for mine, new in zip(self.given, given, strict=True):
            mine.copy_(new)
        self.graph.replay()
        if isinstance(self.made, Tensor):
            return self.made.clone()
        return cast("Made", tuple(values.clone() for values in self.made))


def capture(
    function: Callable[..., Made], given: tuple[Tensor, ...], stream: torch.cuda.Stream | None = None
) -> Captured[Made]:
    """Capture one call of a function on a GPU, which is not run.

    It is captured on `stream`; None: on that of the shared memory, which serves one stream only, or on any.

    Raises RuntimeError if the function cannot be captured.
    """
    device, given, shared = given[0].device, tuple(values.clone() for values in given), _here.memory
    graph = torch.cuda.CUDAGraph()
    stream = stream or (shared.stream if shared else torch.cuda.Stream(device))
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):
        # As torch.cuda.graph does, which also collects garbage and empties the cache each time. Other threads go on.
        pool = (shared.keeper.pool(),) if shared else ()
        graph.capture_begin(*pool, capture_error_mode="thread_local")
        try:
            made = function(*given)
        finally:
            graph.capture_end()
    torch.cuda.current_stream(device).wait_stream(stream)
    return Captured(graph, given, made)
