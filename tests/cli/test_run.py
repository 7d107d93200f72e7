"""The folder of a run: what it holds, and what becomes of it however the run ends."""

import json
import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchmask.cli.config import load_config
from torchmask.cli.options import RunOptions, SweepOptions
from torchmask.cli.run import new_run
from torchmask.record import Record

RECORD = Record("fit", 1, 2, {"loss": 0.5})


def fail(options, error, *records):
    """A run that ends with an error after some records."""

    def work():
        with new_run("program", options) as output:
            output.summary.append("half of it is done")
            for record in records:
                output.callback(record)
            raise error

    with pytest.raises(type(error)):
        work()


def status(folder):
    return json.loads((folder / "status.json").read_text())["status"]


def test_the_folder_tells_how_to_do_it_again_and_what_came_out(tmp_path, capsys):
    options = SweepOptions(out=tmp_path / "runs" / "first", smoke=True, workers=3)
    with new_run("program", options, seed=7) as output:
        output.callback(RECORD)
        output.report("result", {"rows": [1, 2]}, "# Result\n", Figure())
        output.summary.append("all of it is done")
    folder = tmp_path / "runs" / "first"
    assert capsys.readouterr().out == f"written to {folder}\nall of it is done\n"
    assert load_config(folder / "config.yaml", SweepOptions, "program") == SweepOptions(smoke=True)
    assert json.loads((folder / "environment.json").read_text())["seed"] == 7
    assert json.loads((folder / "result.json").read_text()) == {"rows": [1, 2]}
    assert (folder / "result.md").read_text() == "# Result\n"
    assert (folder / "result.png").read_bytes().startswith(b"\x89PNG")
    events = EventAccumulator(str(folder), size_guidance={"images": 0, "scalars": 0})
    events.Reload()
    assert "fit/loss" in events.Tags()["scalars"]
    assert "figures/result" in events.Tags()["images"]


def test_a_report_need_not_have_a_figure(tmp_path):
    with new_run("program", RunOptions(out=tmp_path / "run")) as output:
        output.report("result", {}, "")
    assert not list((tmp_path / "run").glob("*.png"))


def test_without_a_name_it_is_that_of_the_program_and_the_time(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with new_run("program", RunOptions()) as output:
        assert output.directory.parent == Path("runs")
        assert re.fullmatch(r"program-\d{8}-\d{6}", output.directory.name)


def test_what_is_refused_before_any_work_leaves_nothing(tmp_path, capsys):
    for error in (ValueError("no such mask"), MemoryError(), RuntimeError("can't allocate memory")):
        fail(RunOptions(out=tmp_path / "new" / "run"), error)
        assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr() == ("", "")


def test_folders_that_were_there_stay(tmp_path):
    (tmp_path / "runs").mkdir()
    fail(RunOptions(out=tmp_path / "runs" / "new" / "run"), ValueError("no such mask"))
    assert list(tmp_path.iterdir()) == [tmp_path / "runs"]
    assert list((tmp_path / "runs").iterdir()) == []


def test_an_error_on_the_way_leaves_what_was_reached_and_says_where(tmp_path, capsys):
    fail(RunOptions(out=tmp_path / "run"), ValueError("the light is gone"), RECORD)
    assert status(tmp_path / "run") == "failed"
    assert capsys.readouterr().err == f"half of it is done\nthe results so far are in {tmp_path / 'run'}\n"


def test_an_interruption_leaves_what_was_reached_and_a_sweep_says_how_to_go_on(tmp_path, capsys):
    fail(RunOptions(out=tmp_path / "run"), KeyboardInterrupt(), RECORD)
    assert status(tmp_path / "run") == "interrupted"
    assert capsys.readouterr().err == f"\nthe results so far are in {tmp_path / 'run'}\n"
    fail(SweepOptions(out=tmp_path / "other", sweep=tmp_path / "sweep"), KeyboardInterrupt(), RECORD)
    assert f"with --sweep {tmp_path / 'sweep'} the next run goes on from there" in capsys.readouterr().err


def test_a_folder_that_exists_is_not_touched(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "mine").touch()
    run = new_run("program", RunOptions(out=tmp_path / "run"))
    with pytest.raises(ValueError, match=r"run exists and is not overwritten: choose another, such as .*run-2"):
        run.__enter__()
    assert list((tmp_path / "run").iterdir()) == [tmp_path / "run" / "mine"]
    assert capsys.readouterr() == ("", "")
