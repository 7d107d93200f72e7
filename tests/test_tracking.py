"""A run's log says what happened, in TensorBoard and in plain files, however the run ended."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.metadata import parse_session_start_info_plugin_data

from torchmask import tracking
from torchmask.io import load_npz, read_json
from torchmask.record import Record
from torchmask.tracking import RunLogger, read_metrics


@dataclass(frozen=True)
class Design:
    n_subapertures: int = 11
    fill_factor: float = 0.15
    method: str = "hybrid"


@dataclass(frozen=True)
class Config:
    design: Design = field(default_factory=Design)
    seed: int = 3
    smoke: bool = True
    r0: float | None = None


def events(folder: Path) -> EventAccumulator:
    """Everything in the event file of a run, of which its folder must hold one."""
    assert len(list(folder.glob("events.out.tfevents*"))) == 1
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    return accumulator.Reload()


def record(step: int, stage: str = "restoration/mask", n_steps: int = 40, **arrays: torch.Tensor) -> Record:
    return Record(stage, step, n_steps, {"cost": 1 / step, "misfit": 2.0 * step}, arrays)


def run_and_raise(folder: Path, error: BaseException) -> None:
    with RunLogger(folder) as log:
        log.log_config({"seed": 1})
        for step in range(1, 8):
            log(record(step, object=torch.full((16, 16), float(step)), z=torch.full((3,), float(step))))
        raise error


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_whole_run_is_read_back(tmp_path, dtype):
    folder = tmp_path / "runs" / "first"
    with RunLogger(folder, seed=3) as log:
        log.log_config(Config())
        for step in range(1, 6):
            log(record(step, "design/cma", 5, centers=torch.rand(11, 2, dtype=dtype)))
        for stage in ("restoration/mask", "restoration/full"):
            for step in range(1, 41):
                log(record(step, stage, 40, object=step * torch.eye(20, 24, dtype=dtype)))
        log.scalar("comparison/score_mask", torch.tensor(0.0625, dtype=dtype))
        log.table("comparison/scores", [{"aperture": "mask", "score": 0.0625}])

    read = events(folder)
    for kind, variant, n in (("design", "cma", 5), ("restoration", "mask", 40), ("restoration", "full", 40)):
        points = events(folder / variant).Scalars(f"{kind}/cost")
        assert [point.step for point in points] == list(range(1, n + 1))
        np.testing.assert_allclose([point.value for point in points], [1 / k for k in range(1, n + 1)], rtol=1e-6)
    assert [(p.step, p.value) for p in read.Scalars("comparison/score_mask")] == [(0, 0.0625)]
    assert "comparison/scores/text_summary" in read.Tags()["tensors"]
    table = read.Tensors("comparison/scores/text_summary")[0].tensor_proto.string_val[0].decode()
    assert table.splitlines() == ["| aperture | score |", "| --- | --- |", "| mask | 0.0625 |"]

    images = events(folder / "mask").Images("restoration/object")
    assert [image.step for image in images] == [1, 6, 11, 16, 21, 26, 31, 36, 40]  # at intervals and at the end
    assert (images[0].height, images[0].width) == (20, 24)
    assert not events(folder / "cma").Tags()["images"]  # a table of numbers is no image

    rows = read_metrics(folder)
    assert len(rows) == 5 + 40 + 40 + 1
    assert rows[0]["stage"] == "design/cma"
    assert rows[0]["n_steps"] == 5
    assert rows[6]["scalars"] == {"cost": 0.5, "misfit": 4.0}
    assert [row["seconds"] for row in rows] == sorted(row["seconds"] for row in rows)
    assert read_json(folder / "config.json")["design"] == {
        "n_subapertures": 11,
        "fill_factor": 0.15,
        "method": "hybrid",
    }
    environment = read_json(folder / "environment.json")
    assert environment["seed"] == 3
    assert environment["command"] == sys.argv
    assert environment["versions"]["torch"] == torch.__version__
    assert read_json(folder / "status.json")["status"] == "finished"
    state = load_npz(folder / "checkpoints" / "restoration_full.npz")
    assert state["step"] == 40
    np.testing.assert_array_equal(state["object"], 40 * np.eye(20, 24))
    assert torch.from_numpy(state["object"]).dtype == dtype


def test_alike_stages_are_runs_with_the_same_tags(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        for stage in ("restoration/mask", "restoration/full", "design/cma/7 holes", "fit"):
            log(record(1, stage, object=torch.ones(16, 16)))
        log.scalar("summary/mask/score", 0.1)
        log.image("observation/mask/frame", torch.ones(16, 16))
    curves = ["restoration/cost", "restoration/misfit"]
    tags = {name: events(tmp_path / "run" / name).Tags() for name in ("", "mask", "full", "cma_7_holes")}
    assert {name: tag["scalars"] for name, tag in tags.items()} == {
        "": ["fit/cost", "fit/misfit"],
        "mask": [*curves, "summary/score"],
        "full": curves,
        "cma_7_holes": ["design/cost", "design/misfit"],
    }
    assert sorted(tags["mask"]["images"]) == ["observation/frame", "restoration/object"]


@pytest.mark.parametrize("fails", [False, True])
def test_hyperparameters_stand_in_the_run_itself(tmp_path, fails):
    try:
        with RunLogger(tmp_path / "run") as log:
            log.log_config(Config())
            log.scalar("comparison/score", 0.5)
            assert not fails, "on purpose"
    except AssertionError:
        assert fails
    read = events(tmp_path / "run")
    content = read.SummaryMetadata("_hparams_/session_start_info").plugin_data.content
    values = parse_session_start_info_plugin_data(content).hparams
    assert {name: value.number_value or value.string_value for name, value in values.items()} == {
        "design.n_subapertures": 11,
        "design.fill_factor": 0.15,
        "design.method": "hybrid",
        "seed": 3,
        "smoke": "true",
        "r0": "null",
    }
    hparams = read.PluginTagToContent("hparams")
    assert ("_hparams_/session_end_info" in hparams) is not fails
    assert "_hparams_/experiment" not in hparams  # it would hide what other runs have


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (KeyboardInterrupt(), "interrupted", None),
        (ValueError("r0 is -1"), "failed", "ValueError: r0 is -1"),
        (SystemExit(2), "failed", "SystemExit: 2"),
    ],
)
def test_an_interrupted_run_is_readable_with_what_was_reached(tmp_path, error, status, message):
    with pytest.raises(type(error)):
        run_and_raise(tmp_path / "run", error)
    state = read_json(tmp_path / "run" / "status.json")
    assert (state["status"], state["error"]) == (status, message)
    assert [row["step"] for row in read_metrics(tmp_path / "run")] == list(range(1, 8))
    checkpoint = load_npz(tmp_path / "run" / "checkpoints" / "restoration_mask.npz", ["object", "z", "step"])
    assert checkpoint["step"] == 7
    assert np.all(checkpoint["z"] == 7)
    read = events(tmp_path / "run" / "mask")
    assert len(read.Scalars("restoration/cost")) == 7
    assert read.Images("restoration/object")[-1].step == 7


LOG_FOR_EVER = """
import itertools, signal, sys, torch
from torchmask import tracking
from torchmask.record import Record
signal.signal(signal.SIGINT, signal.default_int_handler)  # tests that run in the background inherit a deaf ear to it
tracking._CHECKPOINT_INTERVAL = 0.05
with tracking.RunLogger(sys.argv[1]) as log:
    for step in itertools.count(1):
        log(Record("fit", step, 10**9, {"loss": 1 / step}, {"x": torch.full((1000,), float(step))}))
"""


def stop_and_listen(process, stop):
    """What a process has printed that is told to stop: again, if it goes on.

    Of 60 interrupts 3 were lost without a word, as C code that asks whether there is an attribute forgets whatever
    exception comes meanwhile.
    """
    for _ in range(4):
        os.kill(process.pid, stop)
        with suppress(subprocess.TimeoutExpired):
            return process.communicate(timeout=15)[1]
    raise AssertionError("the process goes on after four signals")


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_process_leaves_a_readable_folder(tmp_path, stop):
    folder = tmp_path / "run"
    with subprocess.Popen([sys.executable, "-c", LOG_FOR_EVER, folder], stderr=subprocess.PIPE) as process:
        while not (folder / "checkpoints" / "fit.npz").exists():
            assert process.poll() is None, process.stderr.read().decode()
            time.sleep(0.02)
        try:
            printed = stop_and_listen(process, stop)
        finally:
            process.kill()  # what goes on for ever would keep the test waiting
    rows = read_metrics(folder)
    assert [row["step"] for row in rows] == list(range(1, len(rows) + 1))
    state = load_npz(folder / "checkpoints" / "fit.npz", ["x", "step"])
    assert np.all(state["x"] == state["step"])
    if stop is signal.SIGINT:
        assert b"KeyboardInterrupt" in printed
        assert read_json(folder / "status.json")["status"] == "interrupted"
        assert len(rows) - state["step"] in (0, 1)  # the signal may come between the line and the state
    else:
        assert read_json(folder / "status.json")["status"] == "running"  # nobody could say otherwise
        assert state["step"] <= len(rows)


def test_a_line_cut_off_is_dropped_and_a_damaged_one_is_told(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        for step in (1, 2, 3):
            log(record(step))
    path = tmp_path / "run" / "metrics.jsonl"
    content = path.read_text()
    path.write_text(content[:-20])
    assert [row["step"] for row in read_metrics(tmp_path / "run")] == [1, 2]
    path.write_text("{" + content)
    with pytest.raises(ValueError, match=r"metrics\.jsonl is damaged"):
        read_metrics(tmp_path / "run")
    with pytest.raises(ValueError, match="is not a run folder"):
        read_metrics(tmp_path)


def test_lines_are_on_disk_at_once(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        for step in (1, 2):
            log(record(step))
            assert [row["step"] for row in read_metrics(tmp_path / "run")] == list(range(1, step + 1))


def test_the_state_is_copied(tmp_path):
    state = torch.ones(4)
    with RunLogger(tmp_path / "run") as log:
        log(record(1, x=state))
        state += 1  # as an optimiser does that works in place
    assert np.all(load_npz(tmp_path / "run" / "checkpoints" / "restoration_mask.npz")["x"] == 1)


def test_values_that_are_not_finite_stay_strict_json(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        log(Record("fit", 1, 2, {"loss": math.nan, "norm": math.inf, "ok": 1.0}, {"x": torch.full((16, 16), math.nan)}))

    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    line = json.loads((tmp_path / "run" / "metrics.jsonl").read_text(), parse_constant=refuse)
    assert line["scalars"] == {"loss": None, "norm": None, "ok": 1.0}
    read = events(tmp_path / "run")
    assert math.isnan(read.Scalars("fit/loss")[0].value)
    assert math.isinf(read.Scalars("fit/norm")[0].value)


def test_nothing_is_overwritten(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        log(record(1))
    before = {path: path.read_bytes() for path in (tmp_path / "run").iterdir() if path.is_file()}
    (tmp_path / "run-2").mkdir()
    with pytest.raises(ValueError, match=r"run exists and is not overwritten: choose another, such as .*run-3"):
        RunLogger(tmp_path / "run")
    assert {path: path.read_bytes() for path in before} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run-2"]
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="cannot be created"):
        RunLogger(tmp_path / "file" / "run")


def test_the_configuration_is_written_once_or_not_at_all(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        with pytest.raises(TypeError, match="cannot be stored as JSON"):
            log.log_config({"model": object()})
        assert not (tmp_path / "run" / "config.json").exists()
        log.log_config({"n": 1})
        with pytest.raises(ValueError, match="not overwritten"):
            log.log_config({"n": 2})
    assert read_json(tmp_path / "run" / "config.json") == {"n": 1}


def test_figures_are_files_and_events(tmp_path):
    figure = Figure(figsize=(2, 1))
    figure.subplots().plot([1, 2])
    with RunLogger(tmp_path / "run") as log:
        log.figure("restoration/final", figure)
        log.figure("restoration/final", figure, step=1)
    assert (tmp_path / "run" / "restoration_final.png").read_bytes().startswith(b"\x89PNG")
    image = events(tmp_path / "run").Images("figures/restoration/final")
    assert [(i.step, i.width, i.height) for i in image] == [(0, 320, 160), (1, 320, 160)]


def test_wrong_images_and_tables(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        with pytest.raises(ValueError, match=r"image x has shape \(3, 4, 5\)"):
            log.image("x", torch.zeros(3, 4, 5))
        for rows in ([], [{"a": 1}, {"b": 2}]):
            with pytest.raises(ValueError, match="same columns"):
                log.table("t", rows)


def test_the_event_file_of_a_default_run_is_small_and_logging_cheap(tmp_path):
    generator = torch.Generator().manual_seed(0)
    noise = torch.rand(128, 128, generator=generator)  # nothing compresses worse
    start = time.process_time()
    with RunLogger(tmp_path / "run") as log:
        for stage in ("restoration/mask", "restoration/full"):
            for step in range(1, 1001):
                log(record(step, stage, 1000, object=noise, z=torch.zeros(20, 11, 6)))
    per_record = (time.process_time() - start) / 2000
    assert sum(path.stat().st_size for path in (tmp_path / "run").rglob("events*")) < 20e6
    assert per_record < 5e-3  # measured: below 1 ms; an iteration of a restoration takes 50


def test_checkpoints_are_written_during_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "_CHECKPOINT_INTERVAL", 0.0)
    path = tmp_path / "run" / "checkpoints" / "fit_a.npz"
    with RunLogger(tmp_path / "run") as log:
        for step in (1, 2):
            log(record(step, "fit/a", x=torch.tensor([step])))
            assert load_npz(path)["step"] == step
    assert [entry.name for entry in path.parent.iterdir()] == ["fit_a.npz"]


def test_a_training_loop_of_ones_own(tmp_path):
    x = torch.full((3,), 2.0, requires_grad=True)
    optimizer = torch.optim.SGD([x], lr=0.1)
    with RunLogger(tmp_path / "mine") as log:
        for step in range(1, 4):
            loss = (x**2).sum()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            log(Record("fit", step, 3, {"loss": loss}, {"x": x}))  # type: ignore[dict-item]
    losses = [point.value for point in events(tmp_path / "mine").Scalars("fit/loss")]
    np.testing.assert_allclose(losses, [12 * 0.8 ** (2 * k) for k in range(3)], rtol=1e-5)
    np.testing.assert_array_equal(load_npz(tmp_path / "mine" / "checkpoints" / "fit.npz")["x"], x.detach().numpy())


def test_an_array_called_step_is_refused_before_anything_is_written(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        with pytest.raises(ValueError, match="an array is called 'step'"):
            log(Record("restoration/mask", 1, 40, {"cost": 1.0}, {"step": torch.ones(2)}))
        log(record(1, x=torch.ones(2)))
    assert [row["step"] for row in read_metrics(tmp_path / "run")] == [1]
    assert load_npz(tmp_path / "run/checkpoints/restoration_mask.npz")["step"] == 1


@pytest.mark.parametrize("second", ["fit/a_b", "fit/checkpoints", "fit/config.json", "fit/..", "fit_a b"])
def test_stages_that_would_share_files_are_refused_before_anything_is_written(tmp_path, second):
    with RunLogger(tmp_path / "run") as log:
        log(record(1, "fit/a b", x=torch.ones(2)))
        with pytest.raises(ValueError, match=r"would be written to .*: rename"):
            log(record(2, second, x=torch.zeros(2)))
        with pytest.raises(ValueError, match="would be written to a_b, where 'a b' is"):
            log.scalar("fit/a_b/cost", 1.0)
        log(record(3, "fit/a b", x=torch.ones(2)))
    assert [row["step"] for row in read_metrics(tmp_path / "run")] == [1, 3]
    assert len(list((tmp_path / "run" / "checkpoints").iterdir())) == 1
    assert [row.step for row in events(tmp_path / "run" / "a_b").Scalars("fit/cost")] == [1, 3]


def test_two_figures_do_not_share_a_file(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        for _ in range(2):  # the second replaces the first
            log.figure("a b", Figure())
        with pytest.raises(ValueError, match=r"'a_b' would be written to a_b\.png, where 'a b' is"):
            log.figure("a_b", Figure())


def test_closing_twice_is_harmless(tmp_path):
    log = RunLogger(tmp_path / "run")
    log.close()
    log.close("failed")
    assert read_json(tmp_path / "run" / "status.json")["status"] == "finished"


def test_arrays_and_brain_floats_are_kept(tmp_path):
    square = np.arange(256.0).reshape(16, 16)
    given = {"seen": square[::-1], "cast": torch.ones(16, 16, dtype=torch.bfloat16), "list": [1.0, 2.0]}
    with RunLogger(tmp_path / "run") as log:
        log(Record("fit", 1, 1, {"loss": torch.tensor(0.5, dtype=torch.bfloat16), "norm": np.float32(2)}, given))
        log.image("images/cast", given["cast"])
        square += 1  # as an optimiser does that works in place
    stored = load_npz(tmp_path / "run" / "checkpoints" / "fit.npz")
    np.testing.assert_array_equal(stored["seen"], np.arange(256.0).reshape(16, 16)[::-1])
    assert stored["cast"].dtype == np.float32
    assert stored["list"].tolist() == [1, 2]
    assert read_metrics(tmp_path / "run")[0]["scalars"] == {"loss": 0.5, "norm": 2}
    assert len(events(tmp_path / "run").Images("fit/seen")) == 1


def test_nothing_is_logged_after_the_end(tmp_path):
    with RunLogger(tmp_path / "run") as log:
        log(record(1))
    for again in (
        lambda: log(record(2)),
        lambda: log.scalar("fit/loss", 1.0),
        lambda: log.image("x", torch.ones(16, 16)),
        lambda: log.text("run/note", "late"),
        lambda: log.figure("late", Figure()),
    ):
        with pytest.raises(ValueError, match=r"this RunLogger of .*run has been closed: log before that, or start"):
            again()
    assert len(read_metrics(tmp_path / "run")) == 1
    assert not (tmp_path / "run" / "late.png").exists()
