"""What all programs share: options by falling priority, exit status, one line for a mistake."""

import os
import signal
import subprocess
import sys
import threading
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from torchmask.cli.program import NOT_EXPLAINED, parse, run_script


@dataclass(frozen=True)
class Inner:
    """Nested, and with a mind of its own."""

    size: float = 0.7
    count: int | None = None

    def __post_init__(self) -> None:
        if self.size <= 0:
            raise ValueError(f"size is {self.size}: it must be positive")


@dataclass(frozen=True, kw_only=True)
class Options:
    """Of a program."""

    inner: Inner = field(default_factory=Inner)
    wavelength: float = 550e-9
    kind: Literal["cma", "hybrid"] = "cma"
    config: Path | None = None
    debug: bool = False


def status(run, *argv):
    return run_script("program", run, Options, "What it is for.", argv)


def fails(error):
    def run(_):
        raise error

    return run


def test_the_command_line_wins_over_the_file_and_the_file_over_defaults(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("wavelength: 1e-6\nkind: hybrid\ninner: {count: 3}\n")
    found = parse(Options, "test", ["--config", str(path), "--kind", "cma", "--inner.size", "0.5"], prog="test")
    assert found == Options(config=path, wavelength=1e-6, kind="cma", inner=Inner(size=0.5, count=3))
    assert parse(Options, "test", [f"--config={path}"], prog="test").kind == "hybrid"
    assert parse(Options, "test", [], prog="test") == Options()


def test_a_script_gets_its_options_and_ends_with_0(capsys):
    seen = []
    assert status(seen.append, "--wavelength", "1e-6") == 0
    assert seen == [Options(wavelength=1e-6)]
    assert capsys.readouterr() == ("", "")


def test_help_says_what_it_is_for(capsys):
    with pytest.raises(SystemExit) as end:
        status(fails(AssertionError()), "--help")
    assert end.value.code == 0
    out = capsys.readouterr().out
    assert "usage: program" in out
    assert "What it is for." in out
    assert "--config" in out


@pytest.mark.parametrize(
    "argv", [["--wavelenght", "1"], ["--wavelength", "long"], ["--kind", "nelder"], ["--config"], ["1"]]
)
def test_wrong_usage_is_2(capsys, argv):
    with pytest.raises(SystemExit) as end:
        status(fails(AssertionError()), *argv)
    assert end.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


def test_an_option_that_a_program_lacks_is_wrong_usage_before_any_file_is_looked_for(capsys):
    with pytest.raises(SystemExit) as end:
        status(fails(AssertionError()), "--resume", "nowhere")
    assert end.value.code == 2
    assert "nowhere/config.yaml" not in capsys.readouterr().err


@pytest.mark.parametrize("error", [ValueError("holes\n   overlap"), FileNotFoundError("holes overlap")])
def test_a_mistake_is_one_line_and_1_and_a_traceback_with_debug(capsys, error):
    assert status(fails(error)) == 1
    assert capsys.readouterr() == ("", "program: error: holes overlap\n")
    with pytest.raises(type(error), match="overlap"):
        status(fails(error), "--debug")


@pytest.mark.parametrize("error", [MemoryError("8 TiB"), RuntimeError("can't allocate memory: you tried 8 TiB")])
def test_too_little_memory_is_one_line_and_1(capsys, error):
    assert status(fails(error)) == 1
    err = capsys.readouterr().err
    assert err.startswith("program: error: memory is short, take fewer or smaller frames")
    assert err.endswith("8 TiB\n")
    with pytest.raises(type(error), match="8 TiB"):
        status(fails(error), "--debug")
    with pytest.raises(RuntimeError, match="no convergence"):
        status(fails(RuntimeError("no convergence")))


def test_a_mistake_of_the_program_itself_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        status(fails(ZeroDivisionError()))


@pytest.mark.parametrize("argv", [["--inner.size", "-1"], ["--config", "FILE"]])
def test_a_value_that_a_group_of_options_refuses_is_a_mistake_and_no_wrong_usage(tmp_path, capsys, argv):
    (tmp_path / "c.yaml").write_text("inner: {size: -1}")
    argv = [str(tmp_path / "c.yaml") if word == "FILE" else word for word in argv]
    assert status(fails(AssertionError()), *argv) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("program: error: ")
    assert err.endswith("size is -1.0: it must be positive\n")
    assert err.count("\n") == 1
    with pytest.raises(ValueError, match=r"size is -1\.0"):
        Inner(size=-1.0)  # it checks itself as before


def test_of_wrong_usage_and_a_mistake_wrong_usage_is_told(capsys):
    with pytest.raises(SystemExit) as end:
        status(fails(AssertionError()), "--inner.size", "-1", "--kind", "nelder")
    assert end.value.code == 2
    with pytest.raises(ValueError, match=r"size is -1\.0"):
        Inner(size=-1.0)


def test_an_interruption_is_130(capsys):
    assert status(fails(KeyboardInterrupt())) == 130
    assert capsys.readouterr().err == "program: interrupted\n"
    with pytest.raises(KeyboardInterrupt):
        status(fails(KeyboardInterrupt()), "--debug")


def test_a_program_may_have_a_status_to_tell():
    assert status(lambda _: None) == 0
    assert status(lambda _: NOT_EXPLAINED) == 3


def test_termination_interrupts_as_well(capsys):
    before = signal.getsignal(signal.SIGTERM)
    assert status(lambda _: os.kill(os.getpid(), signal.SIGTERM)) == 130
    assert capsys.readouterr().err == "program: interrupted\n"
    assert signal.getsignal(signal.SIGTERM) is before


def test_a_program_runs_in_any_thread():
    ended = []
    thread = threading.Thread(target=lambda: ended.append(status(lambda _: None)))
    thread.start()
    thread.join()
    assert ended == [0]


@pytest.mark.filterwarnings("default::UserWarning")
def test_a_warning_is_one_line(capsys):
    def run(_):
        warnings.warn("the noise\n   is high", stacklevel=1)

    shown = warnings.showwarning
    assert status(run) == 0
    assert capsys.readouterr().err == "program: warning: the noise is high\n"
    assert warnings.showwarning is shown


@pytest.mark.filterwarnings("default::UserWarning")
def test_a_warning_is_told_once_whatever_filters_are_set_in_between(capsys):
    def run(_):
        for _ in range(3):
            warnings.warn("the noise is high", stacklevel=1)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")

    assert status(run) == 0
    assert capsys.readouterr().err == "program: warning: the noise is high\n"


def test_a_package_that_is_missing_is_named_with_its_extra_and_others_are_mistakes_of_the_program(capsys):
    assert status(fails(ModuleNotFoundError("no", name="ezdxf.units"))) == 1
    assert "needs ezdxf" in capsys.readouterr().err
    with pytest.raises(ModuleNotFoundError):
        status(fails(ModuleNotFoundError("no", name="torchmask.nonsense")))


def test_a_reader_that_has_read_enough_is_no_error():
    program = """
import sys
from dataclasses import dataclass
from torchmask.cli.program import run_script

@dataclass
class Options:
    pass

def run(_):
    for number in range(100000):
        print(number)

sys.exit(run_script("program", run, Options, None))
"""
    done = subprocess.run(
        f"{sys.executable} -c '{program}' | head -n 1", shell=True, capture_output=True, text=True, check=False
    )
    assert done.stdout == "0\n"
    assert done.stderr == ""


def test_a_seed_that_no_generator_takes_is_refused_before_any_work(capsys):
    @dataclass(frozen=True)
    class Seeds:
        seed: tuple[int, ...] = (0,)

    def work(_):
        raise AssertionError

    assert run_script("program", work, Seeds, "", ["--seed", "1", str(10**20)]) == 1
    assert f"--seed is {10**20}: it must be a whole number from 0 to {2**63 - 1}" in capsys.readouterr().err
    assert run_script("program", lambda _: 0, Seeds, "", ["--seed", str(2**63 - 1)]) == 0


def test_a_run_to_go_on_with_that_is_not_there_is_named_as_a_folder(tmp_path, capsys):
    @dataclass(frozen=True)
    class Resumable:
        resume: Path | None = None

    def work(_):
        raise AssertionError

    assert run_script("program", work, Resumable, "", ["--resume", str(tmp_path / "rs")]) == 1
    assert f"program: error: there is no folder {tmp_path / 'rs'}: --resume goes on" in capsys.readouterr().err
