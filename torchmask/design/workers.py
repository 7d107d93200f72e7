"""Independent calls side by side: on the cores of this machine, or on a Ray cluster."""

from __future__ import annotations

import pickle
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

BACKENDS = ("loky", "ray")
Key = TypeVar("Key")


@dataclass(frozen=True)
class Outcome(Generic[Key]):
    """What one call came to: its value, or the error that it ended with and where that was raised."""

    key: Key
    value: Any = None
    error: Exception | None = None
    traceback: str = ""


def require_backend(backend: str, n_workers: int | None) -> None:
    """Raise ValueError unless `run_side_by_side` can work there."""
    if backend not in BACKENDS:
        raise ValueError(f"backend is {backend!r}: known backends are {', '.join(BACKENDS)}")
    if n_workers is not None and (n_workers != int(n_workers) or n_workers < 1):
        raise ValueError(f"n_workers is {n_workers}: it must be a whole number of at least 1, or None for all cores")
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
    """`function(argument)` of every argument, each on one torch thread; outcomes come as calls end.

    Parameters
    ----------
    function : callable
        Must be picklable, as must arguments and values.
    arguments : mapping
        From any name of a call to its argument.
    backend : {"loky", "ray"}
        Processes on this machine, or a Ray cluster: the one `ray.init` or RAY_ADDRESS says, or else a local one.
    n_workers : int, optional
        How many calls run at once; by default one per core (of the cluster). With 1 and "loky" they run in this
        process.

    An error ends the call that raised it and no other; if a process dies, all calls that have not ended have that as
    their error.

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
        n_jobs = min(n_workers or cores, len(arguments))
        # one call at a time: a batch would come back as a whole
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


_DEATHS = ("TerminatedWorkerError", "BrokenProcessPool", "RayActorError", "ActorDiedError")  # of a worker's process


def _guarded(function: Callable[[Any], Any], key: Key, argument: Any) -> Outcome[Key]:
    """One call on one thread; a failure travels as a value, so that it does not end the others."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        return Outcome(key, function(argument))
    except Exception as error:
        return Outcome(key, None, _that_travels(error), traceback.format_exc())
    finally:
        torch.set_num_threads(threads)


def _that_travels(error: Exception) -> Exception:
    """The error itself, or one with its words where it cannot go from process to process."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")
    return error


@contextmanager
def _registered(backend: str) -> Iterator[int]:
    """The number of cores behind a backend, made known to joblib."""
    import joblib

    if backend == "loky":
        yield joblib.cpu_count()
        return
    import ray
    from ray.util.joblib.ray_backend import RayBackend

    class Backend(RayBackend):
        # joblib takes this from its parent, a pool of local processes that may wait for ever for one that died.
        # Ray's actors report their death.
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
