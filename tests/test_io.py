"""Files are whole or absent, nothing is overwritten, nothing is unpickled."""

import json
import math
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from torchmask.folders import free_name, new_folder
from torchmask.io import (
    as_array,
    as_tensor,
    atomic_write,
    load_npz,
    read_json,
    save_npz,
    to_json,
    write_json,
)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def write_and_fail(path: Path, error: BaseException, replace: bool = False) -> None:
    with atomic_write(path, replace=replace) as file:
        file.write(b"half")
        file.flush()
        raise error


def test_a_failure_midway_leaves_nothing(tmp_path):
    with pytest.raises(RuntimeError, match="midway"):
        write_and_fail(tmp_path / "a.bin", RuntimeError("midway"))
    assert names(tmp_path) == []


def test_a_failure_midway_keeps_the_file_that_was_to_be_replaced(tmp_path):
    path = tmp_path / "a.bin"
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt):
        write_and_fail(path, KeyboardInterrupt(), replace=True)
    assert path.read_bytes() == b"old"
    assert names(tmp_path) == ["a.bin"]
    with atomic_write(path, replace=True) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"  # until the block ends
    assert path.read_bytes() == b"new"


def test_an_array_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(np.lib.format, "write_array", fail)
    with pytest.raises(OSError, match="disk full"):
        save_npz(tmp_path / "a.npz", {"x": 1})
    assert names(tmp_path) == []


REPLACE_FOR_EVER = """
import itertools, sys
import numpy as np
from torchmask.io import save_npz
for value in itertools.count():
    save_npz(sys.argv[1], {"x": np.full(20_000, value), "y": np.full(20_000, value)}, replace=True)
"""


def test_a_killed_writer_leaves_a_whole_file(tmp_path):
    path = tmp_path / "state.npz"
    with subprocess.Popen([sys.executable, "-c", REPLACE_FOR_EVER, path]) as writer:
        try:
            while not path.exists():
                assert writer.poll() is None
                time.sleep(0.01)
            for _ in range(20):  # read while it is being replaced
                state = load_npz(path, ["x", "y"])
                assert np.all(state["x"] == state["y"][0])
        finally:
            writer.kill()
    state = load_npz(path, ["x", "y"])
    assert np.all(state["x"] == state["y"][0])


def write_late(path: Path) -> None:
    with atomic_write(path) as file:
        path.write_bytes(b"first")  # another program was faster
        file.write(b"second")


def test_nothing_is_overwritten(tmp_path):
    path = tmp_path / "a.npz"
    save_npz(path, {"x": np.arange(3)})
    before = path.read_bytes()
    with pytest.raises(ValueError, match=r"a\.npz exists and is not overwritten"):
        save_npz(path, {"x": np.zeros(3)})
    with pytest.raises(ValueError, match="not overwritten"):
        write_late(tmp_path / "late.bin")
    assert (tmp_path / "late.bin").read_bytes() == b"first"
    assert path.read_bytes() == before
    assert names(tmp_path) == ["a.npz", "late.bin"]


def test_new_files_have_ordinary_permissions(tmp_path):
    ordinary = tmp_path / "ordinary"
    ordinary.touch()
    write_json(tmp_path / "a.json", {})
    assert (tmp_path / "a.json").stat().st_mode == ordinary.stat().st_mode


def test_missing_folder_and_wrong_ending(tmp_path):
    with pytest.raises(ValueError, match="no folder"):
        write_json(tmp_path / "absent" / "a.json", {})
    with pytest.raises(ValueError, match=r"does not end in \.npz"):
        save_npz(tmp_path / "a.npy", {})


@settings(derandomize=True, deadline=None, max_examples=40)
@given(
    hnp.arrays(
        st.sampled_from(["f4", "f8", "c8", "c16", "i8", "u1", "?", "U3"]), hnp.array_shapes(min_dims=0, max_side=4)
    )
)
def test_npz_round_trip(tmp_path_factory, array):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    save_npz(path, {"file": array, "args": array})  # names that np.savez keeps for itself
    stored = load_npz(path, ["file", "args"])
    for value in stored.values():
        assert value.dtype == array.dtype
        np.testing.assert_array_equal(value, array)


def test_arrays_of_another_order_of_bytes_become_tensors(tmp_path):
    values = np.arange(6.0).reshape(2, 3)
    save_npz(tmp_path / "a.npz", {"fits": values.astype(">f4"), "number": np.array(2.0, ">f8")})
    stored = load_npz(tmp_path / "a.npz")
    assert torch.equal(torch.from_numpy(stored["fits"]), torch.arange(6.0).reshape(2, 3))
    assert stored["number"].shape == as_tensor(stored["number"]).shape == ()
    assert torch.equal(as_tensor(values.astype(">f8")[::-1]), torch.from_numpy(values).flip(0))
    tensor = torch.ones(2, requires_grad=True)
    assert as_tensor(tensor) is tensor
    assert as_tensor(values.astype(np.longdouble)).dtype == torch.float64


def test_arrays_that_may_not_be_written_to_become_tensors_of_their_own():
    """Without torch's warning; writing to the tensor leaves the array as it is."""
    values = np.arange(3.0)
    values.flags.writeable = False
    as_tensor(values)[0] = 5.0
    assert values[0] == 0


@pytest.mark.parametrize(
    ("values", "given"),
    [
        (None, "None was given"),
        ("frames.npz", "'frames.npz' was given"),
        (np.array([1.0, None]), "an array of object was given"),
        (["a", "b"], "an array of <U1 was given"),
    ],
)
def test_what_is_no_number_is_named(values, given):
    with pytest.raises(TypeError, match=f"{given}: numbers are needed"):
        as_tensor(values)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.complex64, torch.int64, torch.bool])
def test_tensors_are_stored_with_their_dtype(tmp_path, dtype):
    values = torch.ones(2, 3, dtype=dtype, requires_grad=dtype.is_floating_point or dtype.is_complex)
    save_npz(tmp_path / "a.npz", {"x": values.mT.conj() if dtype.is_complex else values.mT})
    stored = load_npz(tmp_path / "a.npz")["x"]
    assert stored.shape == (3, 2)
    assert torch.from_numpy(stored).dtype == dtype


def test_objects_are_neither_written_nor_read(tmp_path):
    path = tmp_path / "a.npz"
    with pytest.raises(ValueError, match="x has dtype object: only numbers"):
        save_npz(path, {"good": 1, "x": [object()]})
    assert names(tmp_path) == []
    np.savez(path, x=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match=r"a\.npz cannot be read.*pickle.*needed: an \.npz file with 'frames'"):
        load_npz(path, ["frames"])


def test_missing_array_is_named(tmp_path):
    save_npz(tmp_path / "a.npz", {"x": 1, "y": 2})
    with pytest.raises(ValueError, match=r"a\.npz has no 'frames', 'centers'; it contains 'x', 'y'"):
        load_npz(tmp_path / "a.npz", ["x", "frames", "centers"])


def test_damaged_files_are_refused(tmp_path):
    whole = tmp_path / "whole.npz"
    save_npz(whole, {"x": np.random.default_rng(0).normal(size=1000)})
    content = whole.read_bytes()
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0xFF
    np.save(tmp_path / "array.npy", np.zeros(3))
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("a.txt", "not an array")
    cases = {
        "absent": (None, "there is no file"),
        "empty": (b"", "is not an .npz"),
        "text": (b"frames", "is not an .npz"),
        "truncated": (content[:-100], "is not an .npz"),
        "flipped": (bytes(flipped), "cannot be read"),
        "array": ((tmp_path / "array.npy").read_bytes(), "is not an .npz"),
        "archive": ((tmp_path / "other.zip").read_bytes(), "something other than arrays"),
    }
    for name, (data, message) in cases.items():
        path = tmp_path / f"{name}.npz"
        if data is not None:
            path.write_bytes(data)
        with pytest.raises(ValueError, match=message) as caught:
            load_npz(path, ["frames"])
        assert str(path) in str(caught.value)
        assert "needed: an .npz file with 'frames'" in str(caught.value)


@dataclass(frozen=True)
class Inner:
    n: int = 3
    path: Path = Path("a/b")


@dataclass(frozen=True)
class Config:
    inner: Inner = field(default_factory=Inner)
    sides: tuple[float, ...] = (1.0, math.nan, -math.inf)
    dtype: torch.dtype = torch.float32
    nothing: None = None


def test_json_of_a_config(tmp_path):
    write_json(tmp_path / "config.json", Config())
    assert read_json(tmp_path / "config.json") == {
        "inner": {"n": 3, "path": "a/b"},
        "sides": [1.0, None, None],
        "dtype": "torch.float32",
        "nothing": None,
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_json_of_tensors_and_scalars(dtype):
    values = torch.tensor([[1.5, math.nan]], dtype=dtype, requires_grad=True)
    assert to_json({"t": values, "a": as_array(values), 3: np.float32(math.inf), "b": np.bool_(True)}) == {
        "t": [[1.5, None]],
        "a": [[1.5, None]],
        "3": None,
        "b": True,
    }


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
)


@settings(derandomize=True, deadline=None)
@given(json_values)
def test_json_is_strict_and_repeatable(value):
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    once = to_json(value)
    assert json.loads(json.dumps(once, allow_nan=False), parse_constant=refuse) == once
    assert to_json(once) == once


def test_json_refuses_the_rest_before_it_writes(tmp_path):
    with pytest.raises(TypeError, match="cannot be stored as JSON"):
        write_json(tmp_path / "a.json", {"x": object()})
    assert names(tmp_path) == []
    (tmp_path / "bad.json").write_text('{"a": 1')
    with pytest.raises(ValueError, match=r"bad\.json is not valid JSON"):
        read_json(tmp_path / "bad.json")
    with pytest.raises(ValueError, match="there is no file"):
        read_json(tmp_path / "absent.json")


def test_a_new_folder_is_new(tmp_path):
    assert free_name(tmp_path / "runs" / "run") == tmp_path / "runs" / "run"
    assert new_folder(str(tmp_path / "runs" / "run")) == tmp_path / "runs" / "run"
    (tmp_path / "runs" / "run-2").touch()
    assert free_name(tmp_path / "runs" / "run") == tmp_path / "runs" / "run-3"
    with pytest.raises(ValueError, match=r"\. exists and is not overwritten: choose another, such as run-2"):
        new_folder(".")
    with pytest.raises(ValueError, match=r"run exists and is not overwritten: choose another, such as .*run-3$"):
        new_folder(tmp_path / "runs" / "run")
    with pytest.raises(ValueError, match="cannot be created"):
        new_folder(tmp_path / "runs" / "run-2" / "below_a_file")
    assert names(tmp_path / "runs") == ["run", "run-2"]
