"""config.yaml: what is written is read back, whatever is wrong in it is named, and nothing in it is executed."""

import dataclasses
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.cli.config import load_config, save_config


@dataclass(frozen=True)
class Inner:
    """Nested."""

    size: float = 0.7
    count: int | None = None
    sun: tuple[float, float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Options:
    """Every kind of value there is."""

    inner: Inner = field(default_factory=Inner)
    wavelength: float = 550e-9
    kind: Literal["cma", "hybrid"] = "cma"
    sky: float | Literal["if-seen", "none"] = "if-seen"
    refine: bool = True
    title: str = ""
    bars: tuple[tuple[float, float], ...] = ()
    source: Path | None = None
    config: Path | None = None
    out: Path | None = None
    debug: bool = False


FINITE = st.floats(allow_nan=False, allow_infinity=False)
OPTIONS = st.builds(
    Options,
    inner=st.builds(
        Inner, size=FINITE, count=st.none() | st.integers(), sun=st.none() | st.tuples(FINITE, FINITE, FINITE)
    ),
    wavelength=FINITE,
    kind=st.sampled_from(["cma", "hybrid"]),
    sky=st.sampled_from(["if-seen", "none"]) | FINITE,
    refine=st.booleans(),
    title=st.text(st.characters(exclude_categories=["Cs"])),
    bars=st.lists(st.tuples(FINITE, FINITE)).map(tuple),
)


@given(OPTIONS)
@settings(derandomize=True, deadline=None, max_examples=60)
def test_a_config_comes_back_to_the_last_bit(tmp_path_factory, options):
    path = tmp_path_factory.mktemp("config") / "config.yaml"
    save_config(path, "test", options)
    assert load_config(path, Options, "test") == options


def test_paths_that_exist_become_absolute_and_places_of_results_are_not_stored(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("stack.npz").touch()
    save_config("config.yaml", "test", Options(source=Path("stack.npz"), out=Path("runs/x"), debug=True))
    monkeypatch.chdir("/")
    assert load_config(tmp_path / "config.yaml", Options, "test") == Options(source=tmp_path / "stack.npz")
    with pytest.raises(ValueError, match="exists"):
        save_config(tmp_path / "config.yaml", "test", Options())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "wavelenght: 1.0",
            "unknown key wavelenght; known keys are inner, wavelength, kind, sky, refine, title, bars, source$",
        ),
        ("inner: {siz: 1.0}", r"unknown key inner.siz; known keys are inner.size, inner.count, inner.sun$"),
        ("out: here", "unknown key out"),
        ("inner: 3", "inner is 3"),
        ("- 1", r"the file contains \[1\]"),
        ("wavelength: long", "wavelength is 'long': a number is needed"),
        ("wavelength: null", "wavelength is None: a number is needed"),
        ("wavelength: true", "wavelength is True: a number is needed"),
        ("inner: {count: 2.5}", "inner.count is 2.5: a whole number is needed"),
        ("refine: 1", "refine is 1: true or false is needed"),
        ("title: 1", "title is 1: text is needed"),
        ("kind: nelder", "kind is 'nelder': known values are cma, hybrid"),
        ("kind: [cma]", "kind is"),
        ("sky: dark", "sky is 'dark': known values are if-seen, none"),
        ("bars: [[1, 2], [3]]", r"bars\[1\] has 1 items: 2 are needed"),
        ("bars: 3", "bars is 3: a list is needed"),
        ("inner: {sun: [1, 2]}", "inner.sun has 2 items: 3 are needed"),
        ("command: restore", "it is for restore, not for test"),
        ("wavelength: [1", "is not valid YAML"),
        ("wavelength: 1\0", "is not valid YAML"),
    ],
)
def test_a_bad_config_is_refused_with_its_name_and_the_key(tmp_path, text, message):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        load_config(path, Options, "test")
    assert str(path) in str(error.value)


def test_missing_and_binary_files_are_refused(tmp_path):
    with pytest.raises(ValueError, match=re.escape(f"no config file {tmp_path / 'none.yaml'}")):
        load_config(tmp_path / "none.yaml", Options, "test")
    (tmp_path / "binary.yaml").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(ValueError, match="not valid YAML"):
        load_config(tmp_path / "binary.yaml", Options, "test")


def test_an_empty_config_is_all_defaults(tmp_path):
    (tmp_path / "empty.yaml").write_text("")
    assert load_config(tmp_path / "empty.yaml", Options, "test") == Options()


def test_a_config_executes_nothing(tmp_path):
    path, trap = tmp_path / "evil.yaml", tmp_path / "trap"
    path.write_text(f"title: !!python/object/apply:os.mkdir ['{trap}']")
    with pytest.raises(ValueError, match="not valid YAML"):
        load_config(path, Options, "test")
    assert not trap.exists()
    yaml.unsafe_load(path.read_text())  # the trap is one
    assert trap.exists()


def test_every_option_of_every_command_survives_the_file(tmp_path):
    """A command whose option has a type that config.yaml cannot hold would fail here."""
    from torchmask.cli import codesign, design, restore, simulate

    for module in (codesign, design, restore, simulate):
        options = module.Options()
        path = tmp_path / f"{module.__name__}.yaml"
        save_config(path, "test", options)
        assert load_config(path, module.Options, "test") == options
        names = {field.name for field in dataclasses.fields(options)}
        elsewhere = {"out", "config", "resume", "debug", "workers", "backend"}  # of no influence on the result
        assert yaml.safe_load(path.read_text()).keys() == {"command"} | names - elsewhere
