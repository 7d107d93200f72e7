"""Independent tasks on many cores, with every result saved at once, so that an interrupted sweep can continue.

A task is a mapping of plain values that contains everything its result depends on. Its file is named after a digest of
that mapping, so a task is computed only once in a folder, and other sweeps in the folder share it. The process that
starts the sweep writes the files, so a cluster needs no shared disk.
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
    """Return `function(task)` for every task, in order, reading results that are already in `folder`.

    Parameters
    ----------
    function : callable
        Picklable function that takes a task, as read from JSON, and returns a mapping that JSON can represent.
    tasks : sequence of mappings
        Tasks. Equal ones are computed once.
    folder : path
        Folder for one file per finished task, "<stage>-<digest>.json"; created if needed.
    stage : str
        Kind of task, such as "design/table/search", used in the names of files and in records.
    backend : {"loky", "ray"}
        Processes on this machine, or a Ray cluster (that of `ray.init` or RAY_ADDRESS, or else a local one).
    n_workers : int, optional
        Number of tasks that run at a time, each on one torch thread; by default one per core (of the cluster). With 1
        and "loky" they run in this process.
    callback : callable, optional
        Receives a `Record` after each task, whose scalars are the numbers of the result.

    Raises
    ------
    ValueError
        Before any work, if the backend is unknown or not installed, `n_workers` is not a whole number of at least 1, or
        `folder` is a file.
    RuntimeError
        If tasks failed, after all others are done; the message gives the first task that failed and its traceback.

    Warns
    -----
    RuntimeWarning
        If the file of a task is damaged; the task is computed again.

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
    """Return a hash of a value that JSON can represent."""
    text = json.dumps(to_json(value), sort_keys=True, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:24]


def _load(path: Path, task: Task) -> dict[str, Any] | None:
    """Return the stored result of `task`, or None if it must be computed, with a warning if its file is damaged."""
    if not path.exists():
        return None
    try:
        stored = read_json(path)
        if stored["task"] != task or stored["sha256"] != _digest(stored["result"]):
            raise ValueError("its content does not match its task or checksum")
        return stored["result"]
    except (ValueError, KeyError, TypeError) as error:
        warnings.warn(f"the file {path} is damaged ({error}): its task is computed again", RuntimeWarning, stacklevel=3)
        return None
