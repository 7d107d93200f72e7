"""What every script of experiments/ and the benchmark of peers promise: help, exit status, a config that comes back."""

import dataclasses
import importlib
from pathlib import Path

import pytest

from torchmask.cli.config import load_config, save_config
from torchmask.cli.options import ConfigOptions

FOLDERS = [Path(__file__).parents[2] / name for name in ("experiments", "benchmarks")]
NAMES = sorted(path.stem for folder in FOLDERS for path in folder.glob("*.py") if "run_script(" in path.read_text())


@pytest.fixture(params=NAMES)
def script(request):
    return importlib.import_module(request.param)


def ends(script, *argv):
    """How it ends while it parses its options."""
    with pytest.raises(SystemExit) as end:
        script.main(list(argv))
    return end.value.code


def test_help_shows_what_the_script_says_of_itself(script, capsys):
    assert ends(script, "--help") == 0
    out = " ".join(capsys.readouterr().out.split())
    assert f"usage: {script.__name__} " in out
    assert script.__doc__.splitlines()[0] in out
    assert "--debug" in out


def test_wrong_usage_is_2(script, capsys):
    assert ends(script, "--nonsense", "1") == 2
    err = capsys.readouterr().err
    assert f"{script.__name__} --help" in err
    assert "Traceback" not in err


def options_of(script):
    found = [
        value
        for value in vars(script).values()
        if isinstance(value, type) and issubclass(value, ConfigOptions) and value.__module__ != ConfigOptions.__module__
    ]
    return found[-1] if found else None


def test_a_config_comes_back_and_one_of_another_program_is_a_mistake(script, tmp_path, capsys):
    kind = options_of(script)
    if kind is None:
        pytest.skip("goes on in its folder instead")
    options = kind()
    save_config(tmp_path / "own.yaml", script.__name__, options)
    assert load_config(tmp_path / "own.yaml", kind, script.__name__) == options
    assert len(dataclasses.fields(options)) > 5
    (tmp_path / "other.yaml").write_text("command: design")
    assert script.main(["--config", str(tmp_path / "other.yaml")]) == 1
    err = capsys.readouterr().err
    assert err.endswith(f"it is for design, not for {script.__name__}\n")
    assert err.count("\n") == 1
