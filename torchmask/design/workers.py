"""Parallel execution of independent calls, on the cores of this machine or on a Ray cluster."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from torchmask.numbers import whole_number

BACKENDS = ("loky", "ray")
Key = TypeVar("Key")


@dataclass(frozen=True)
class Outcome(Generic[Key]):
    """Outcome of one call: its value, or the error that it raised and its traceback."""

    key: Key
    value: Any = None
    error: Exception | None = None
    traceback: str = ""


def require_backend(backend: str, n_workers: int | None) -> None:
    """Raise ValueError unless `run_side_by_side` can use this backend with this number of workers."""
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}: known backends are {', '.join(BACKENDS)}")
    if n_workers is not None:
        whole_number("n_workers", n_workers, note=", or None for all cores")
    try:
        import joblib  # noqa: F401
    except ImportError as error:
        raise ValueError("work on several cores needs joblib: pip install 'torchmask[design]'") from error
    if backend == "ray":
        try:
            import ray  # noqa: F401
        except ImportError as error:
            raise ValueError("backend 'ray' needs Ray: pip install 'torchmask[cluster]'") from error


def run_side_by_side(
    function: Callable[[Any], Any], arguments: Mapping[Key, Any], backend: str = "loky", n_workers: int | None = None
) -> Iterator[Outcome[Key]]:
    """Yield the outcome of `function(argument)` for every argument as it finishes, each on one torch thread.

    Parameters
    ----------
    function : callable
        Function to call. It must be picklable, and so must its arguments and values.
    arguments : mapping
        Argument of each call, with any name for the call as its key.
    backend : {"loky", "ray"}
        Processes on this machine, or a Ray cluster (that of `ray.init` or RAY_ADDRESS, or else a local one).
    n_workers : int, optional
        Number of calls that run at a time; by default one per core (of the cluster). With 1 and "loky" they run in this
        process.

    Notes
    -----
    An error ends only the call that raised it. If a process dies, all unfinished calls have that as their error.

    Examples
    --------
    >>> outcomes = run_side_by_side(lambda x: 1 / x, {"two": 2.0, "zero": 0.0}, n_workers=1)
    >>> {outcome.key: outcome.value or type(outcome.error).__name__ for outcome in outcomes}
    {'two': 0.5, 'zero': 'ZeroDivisionError'}
    """
    import joblib

    if not arguments:
        return
    left = set(arguments)
    with _registered(backend) as cores:
        n_jobs = min(int(n_workers or cores), len(arguments))
        # Without batches, because a batch would be returned only as a whole.
        options: dict[str, Any] = {"batch_size": 1, "pre_dispatch": "n_jobs", "return_as": "generator_unordered"}
        parallel: Any = joblib.Parallel(n_jobs, backend=backend, **options)
        try:
            for outcome in parallel(joblib.delayed(_guarded)(function, *item) for item in arguments.items()):
                left.remove(outcome.key)
                yield outcome
        except Exception as error:
            if type(error).__name__ not in _DEATHS:
                raise
            yield from (Outcome(key, None, error, traceback.format_exc()) for key in arguments if key in left)


_DEATHS = ("TerminatedWorkerError", "BrokenProcessPool", "RayActorError", "ActorDiedError")  # a worker process died


def _guarded(function: Callable[[Any], Any], key: Key, argument: Any) -> Outcome[Key]:
    """Make one call on one thread, and return an error as a value so that it does not end the others."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return Outcome(key, function(argument))
    except Exception as error:
        return Outcome(key, None, _that_travels(error), traceback.format_exc())
    finally:
        torch.set_num_threads(threads)


def _that_travels(error: Exception) -> Exception:
    """Return the error itself, or one with the same message if it cannot be pickled."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


@contextmanager
def _registered(backend: str) -> Iterator[int]:
    """Register a backend with joblib and yield its number of cores."""
    import joblib

    if backend == "loky":
        yield joblib.cpu_count()
        return
    import ray
    from ray.util.joblib.ray_backend import RayBackend

    class Backend(RayBackend):
        # joblib inherits False from a pool of local processes, which may wait for ever for one that died, but Ray's
        # actors report their death.
        supports_return_generator = True

    joblib.register_parallel_backend("ray", Backend)
    ours = not ray.is_initialized()
    if ours:
        ray.init(log_to_driver=False)
    try:
        yield int(ray.cluster_resources()["CPU"])
    finally:
        if ours:
            ray.shutdown()
