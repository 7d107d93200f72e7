"""The task runner: what is on disk when, what is computed again after a kill, and what is refused."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from torchmask.design.sweep import run_tasks

ENVIRONMENT = {**os.environ, "OMP_NUM_THREADS": "2", "RAY_AUTH_MODE": "disabled", "RAY_USAGE_STATS_ENABLED": "0"}

# Tasks leave a mark when they start and when they end, so that what was computed can be counted from outside.
SWEEP = """
import os, signal, sys, time
from pathlib import Path
import torch
from torchmask.design.sweep import run_tasks

marks = Path(sys.argv[2])

def slow(task):
    name = f"{task['x']:g}-{os.getpid()}-{time.time_ns()}"
    (marks / f"{name}.started").touch()
    time.sleep(0.25)
    (marks / f"{name}.ended").touch()
    return {"square": task["x"] ** 2, "threads": torch.get_num_threads(), "pid": os.getpid()}

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background inherit a deaf ear to it
    tasks = [{"x": float(x)} for x in range(10)]
    result = run_tasks(slow, tasks, sys.argv[1], stage="square", backend=sys.argv[3], n_workers=2)
    assert [r["square"] for r in result] == [t["x"] ** 2 for t in tasks]
    assert {r["threads"] for r in result} == {1}
    assert os.getpid() not in {r["pid"] for r in result}
"""


def square(task: dict) -> dict:
    return {"square": task["x"] ** 2}


def start(tmp_path: Path, backend: str) -> subprocess.Popen:
    (tmp_path / "marks").mkdir(exist_ok=True)
    script = tmp_path / "sweep.py"
    script.write_text(SWEEP)
    command = [sys.executable, str(script), str(tmp_path / "sweep"), str(tmp_path / "marks"), backend]
    return subprocess.Popen(command, env=ENVIRONMENT, start_new_session=True, stderr=subprocess.PIPE)


def finished(tmp_path: Path) -> list[Path]:
    return sorted((tmp_path / "sweep").glob("*.json"))


def test_a_killed_sweep_loses_at_most_the_running_tasks(tmp_path):
    process = start(tmp_path, "loky")
    deadline = time.monotonic() + 300  # of a busy machine
    while len(finished(tmp_path)) < 3:
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGKILL)  # no handler, no clean-up
    process.communicate()
    done = finished(tmp_path)
    before = {path: path.stat().st_mtime_ns for path in done}
    assert 3 <= len(done) < 10
    for path in done:
        stored = json.loads(path.read_text())
        assert stored["result"]["square"] == stored["task"]["x"] ** 2

    computed = []

    def count(task: dict) -> dict:
        computed.append(task["x"])
        return square(task)

    tasks = [{"x": float(x)} for x in range(10)]
    resumed = run_tasks(count, tasks, tmp_path / "sweep", stage="square", n_workers=1)
    assert [result["square"] for result in resumed] == [task["x"] ** 2 for task in tasks]
    assert {path: path.stat().st_mtime_ns for path in done} == before  # what was there is read, not computed
    assert len(computed) == 10 - len(done)
    # Computed twice: at most the two running tasks, and two whose results were on the way to a process that waits.
    assert len(list((tmp_path / "marks").glob("*.started"))) <= len(done) + 2 + 2


def test_an_interrupted_sweep_ends_and_keeps_what_is_done(tmp_path):
    process = start(tmp_path, "loky")
    deadline = time.monotonic() + 300  # of a busy machine
    while len(finished(tmp_path)) < 2:
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)  # Ctrl-C reaches the whole group
    _, errors = process.communicate(timeout=300)
    assert b"KeyboardInterrupt" in errors
    assert 2 <= len(finished(tmp_path)) < 10


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("ray") is None, reason="needs Ray: pip install 'torchmask[cluster]'")
def test_a_local_ray_cluster_computes_the_same(tmp_path):
    process = start(tmp_path, "ray")
    deadline = time.monotonic() + 300  # of a busy machine
    while len(finished(tmp_path)) < 2:  # files appear while the sweep runs, not at its end
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert len(list((tmp_path / "marks").glob("*.ended"))) < 10
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    assert len(finished(tmp_path)) == 10
    assert len(list((tmp_path / "marks").glob("*.started"))) == 10


def test_records_count_the_tasks_and_a_finished_sweep_computes_nothing(tmp_path):
    tasks = [{"x": 1.5}, {"x": 2.5}, {"x": 1.5}]
    records = []
    result = run_tasks(square, tasks, tmp_path, stage="square", n_workers=1, callback=records.append)
    assert result == [{"square": 2.25}, {"square": 6.25}, {"square": 2.25}]
    assert [(r.stage, r.step, r.n_steps, r.scalars["square"]) for r in records] == [
        ("square", 1, 2, 2.25),
        ("square", 2, 2, 6.25),
    ]

    def never(task):
        raise AssertionError("computed again")

    assert run_tasks(never, tasks, tmp_path, stage="square", n_workers=1) == result
    longer = run_tasks(square, [*tasks, {"x": 3.0}], tmp_path, stage="square", n_workers=1, callback=records.append)
    assert longer[-1] == {"square": 9.0}
    assert (records[-1].step, records[-1].n_steps, len(records)) == (3, 3, 3)


def test_another_task_another_file(tmp_path):
    run_tasks(square, [{"x": 0.1 + 0.2}], tmp_path, stage="square", n_workers=1)
    run_tasks(square, [{"x": 0.3}], tmp_path, stage="square", n_workers=1)  # differs in the last digit
    run_tasks(square, [{"x": 0.3}], tmp_path, stage="other", n_workers=1)
    assert len(list(tmp_path.glob("*.json"))) == 3


def truncate(text: str) -> str:
    return text[: len(text) // 2]


def change_the_result(text: str) -> str:
    return text.replace("2.25", "2.75")


def change_the_task(text: str) -> str:
    return text.replace('"x": 1.5', '"x": 1.25')


def leave_only_a_list(text: str) -> str:
    return "[1, 2]"


def drop_the_result(text: str) -> str:
    return json.dumps({"task": json.loads(text)["task"]})


@pytest.mark.parametrize(
    "damage", [truncate, change_the_result, change_the_task, leave_only_a_list, drop_the_result, lambda text: ""]
)
def test_a_damaged_file_is_named_and_its_task_computed_again(tmp_path, damage):
    tasks = [{"x": 1.5}, {"x": 2.5}]
    run_tasks(square, tasks, tmp_path, stage="square", n_workers=1)
    path = next(p for p in tmp_path.glob("*.json") if '"x": 1.5' in p.read_text())
    whole = path.read_text()
    path.write_text(damage(whole))
    records = []
    with pytest.warns(RuntimeWarning, match=path.name):
        result = run_tasks(square, tasks, tmp_path, stage="square", n_workers=1, callback=records.append)
    assert result == [{"square": 2.25}, {"square": 6.25}]
    assert len(records) == 1  # the other one was read
    assert path.read_text() == whole


def test_bytes_that_are_no_text_are_damage_too(tmp_path):
    run_tasks(square, [{"x": 1.5}], tmp_path, stage="square", n_workers=1)
    (path,) = tmp_path.glob("*.json")
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.warns(RuntimeWarning, match=path.name):
        assert run_tasks(square, [{"x": 1.5}], tmp_path, stage="square", n_workers=1) == [{"square": 2.25}]


def test_a_failing_task_does_not_end_the_others(tmp_path):
    def picky(task):
        if task["x"] == 2.0:
            raise ZeroDivisionError("two is too much")
        return square(task)

    tasks = [{"x": float(x)} for x in range(4)]
    with pytest.raises(RuntimeError, match=r"(?s)1 of 4 tasks failed.*'x': 2\.0.*two is too much"):
        run_tasks(picky, tasks, tmp_path, stage="square", n_workers=1)
    assert len(list(tmp_path.glob("*.json"))) == 3


def test_the_callers_threads_are_given_back(tmp_path):
    before = torch.get_num_threads()
    run_tasks(lambda task: {"n": torch.get_num_threads()}, [{"x": 1.0}], tmp_path, stage="threads", n_workers=1)
    assert torch.get_num_threads() == before


def test_no_temporary_file_is_left(tmp_path):
    run_tasks(square, [{"x": float(x)} for x in range(3)], tmp_path / "new" / "folder", stage="square", n_workers=1)
    assert all(p.suffix == ".json" for p in (tmp_path / "new" / "folder").iterdir())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"backend": "dask"}, r"backend is 'dask': known backends are loky, ray"),
        ({"n_workers": 0}, r"n_workers is 0: it must be a whole number of at least 1"),
        ({"n_workers": 1.5}, r"n_workers is 1\.5"),
    ],
)
def test_bad_settings_are_refused_before_any_work(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        run_tasks(square, [{"x": 1.0}], tmp_path / "sweep", stage="square", **{"n_workers": 1, **change})
    assert not (tmp_path / "sweep").exists()


def test_a_file_in_place_of_the_folder(tmp_path):
    (tmp_path / "sweep").touch()
    with pytest.raises(ValueError, match="is a file: a sweep needs a folder"):
        run_tasks(square, [{"x": 1.0}], tmp_path / "sweep", stage="square", n_workers=1)


@pytest.mark.parametrize(("module", "extra", "backend"), [("joblib", "design", "loky"), ("ray", "cluster", "ray")])
def test_a_missing_library_is_named_with_its_extra(tmp_path, monkeypatch, module, extra, backend):
    monkeypatch.setitem(sys.modules, module, None)  # import raises ImportError
    with pytest.raises(ValueError, match=rf"torchmask\[{extra}\]"):
        run_tasks(square, [{"x": 1.0}], tmp_path / "sweep", stage="square", backend=backend)
