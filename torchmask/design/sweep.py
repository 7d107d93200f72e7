"""Many independent tasks on many cores, each on disk as soon as it is done, so that a killed sweep goes on.

A task is a mapping of plain values that says all that its result depends on. Its file is named after a digest of
that mapping: the same task is never computed twice in one folder, and another sweep in the folder shares it.
The process that starts the sweep writes the files, so that a cluster needs no common disk.
"""

from __future__ import annotations

import hashlib
import json
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchmask.design.workers import require_backend, run_side_by_side
from torchmask.io import read_json, to_json, write_json
from torchmask.record import Callback, Record

Task = Mapping[str, Any]


def run_tasks(
    function: Callable[[dict[str, Any]], Mapping[str, Any]],
    tasks: Sequence[Task],
    folder: str | Path,
    *,
    stage: str,
    backend: str = "loky",
    n_workers: int | None = None,
    callback: Callback | None = None,
) -> list[dict[str, Any]]:
    """`function(task)` of every task, in order; those whose file is in `folder` are read instead of computed.

    Parameters
    ----------
    function : callable
        Takes a task as JSON gives it back and returns a mapping that JSON can hold. Must be picklable.
    tasks : sequence of mappings
        Equal tasks are computed once.
    folder : path
        Made if needed. One file per finished task, "<stage>-<digest>.json", whole or absent.
    stage : str
        The kind of task, such as "design/table/search"; names the files and the records.
    backend : {"loky", "ray"}
        Processes on this machine, or a Ray cluster: the one `ray.init` or RAY_ADDRESS says, or else a local one.
    n_workers : int, optional
        How many tasks run at once, each on one torch thread; by default one per core (of the cluster). With 1 and
        "loky" they run in this process.
    callback : callable, optional
        Gets a Record after each task; its scalars are the numbers of the result.

    Raises
    ------
    ValueError
        Before any work: unknown backend, n_workers not a whole number of at least 1, folder is a file, missing joblib
        or ray.
    RuntimeError
        If tasks failed, after all others are done; names the tasks and gives the first traceback.

    Warns
    -----
    RuntimeWarning
        For a damaged file of a task, by name; the task is computed again.

    Examples
    --------
    >>> import tempfile
    >>> folder = tempfile.mkdtemp()
    >>> tasks = [{"x": 2.0}, {"x": 3.0}]
    >>> run_tasks(lambda task: {"square": task["x"] ** 2}, tasks, folder, stage="square", n_workers=1)
    [{'square': 4.0}, {'square': 9.0}]
    """
    require_backend(backend, n_workers)
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: a sweep needs a folder")
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{stage.replace('/', '-')}-{_digest(task)}.json" for task in tasks]
    pending = dict(zip(paths, map(to_json, tasks), strict=True))
    results = {path: result for path, task in pending.items() if (result := _load(path, task)) is not None}
    n_tasks = len(pending)
    pending = {path: task for path, task in pending.items() if path not in results}
    failures = []
    for outcome in run_side_by_side(function, pending, backend, n_workers):
        path = outcome.key
        if outcome.error is not None:
            failures.append(f"{pending[path]}\n{outcome.traceback}")
            continue
        result = to_json(outcome.value)
        write_json(path, {"task": pending[path], "result": result, "sha256": _digest(result)}, replace=True)
        results[path] = result
        if callback is not None:
            scalars = {key: float(value) for key, value in result.items() if isinstance(value, int | float)}
            callback(Record(stage, len(results), n_tasks, scalars))
    if failures:
        raise RuntimeError(f"{len(failures)} of {n_tasks} tasks failed, the others are in {folder}: {failures[0]}")
    return [results[path] for path in paths]


def _digest(value: Any) -> str:
    """A name for what JSON holds, equal for equal values."""
    text = json.dumps(to_json(value), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _load(path: Path, task: Task) -> dict[str, Any] | None:
    """The stored result of `task`; None, with a warning if there is a file, when it has to be computed."""
    if not path.exists():
        return None
    try:
        stored = read_json(path)
        if stored["task"] != task or stored["sha256"] != _digest(stored["result"]):
            raise ValueError(f"{path} does not hold what was written to it")
        return stored["result"]
    except (ValueError, KeyError, TypeError) as error:
        warnings.warn(f"the file {path} is damaged ({error}): its task is computed again", RuntimeWarning, stacklevel=3)
        return None
