"""Files that are whole or absent, written under a temporary name and renamed, read without unpickling; and extras.

Extras are what a plain install leaves out: whoever lacks one is told how to get it.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import types
import typing
import uuid
import zipfile
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO, Literal, TypeVar, Union

import numpy as np
import torch
from torch import Tensor

T = TypeVar("T")

_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}


def as_array(values: Any) -> np.ndarray:
    """A tensor (any device, with or without gradient), number or sequence as a NumPy array."""
    return values.numpy(force=True) if isinstance(values, Tensor) else np.asarray(values)


@contextmanager
def atomic_write(path: str | Path, *, replace: bool = False) -> Iterator[BinaryIO]:
    """Open a file that appears at `path` only when the block ends well; otherwise nothing is left behind.

    The bytes go to a temporary file in the same folder, which is synchronised to disk and renamed.

    Parameters
    ----------
    path : str or Path
        Its folder must exist.
    replace : bool
        Whether an existing file may be replaced; readers see the old one or the new one, never a mixture.

    Raises
    ------
    ValueError
        If the folder does not exist, or `path` exists and `replace` is false.

    Examples
    --------
    >>> import tempfile
    >>> folder = Path(tempfile.mkdtemp())
    >>> with atomic_write(folder / "notes.txt") as file:
    ...     _ = file.write(b"whole")
    >>> (folder / "notes.txt").read_text()
    'whole'
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise ValueError(f"{path} cannot be written: there is no folder {path.parent}, make it first")
    if not replace:
        _refuse_existing(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if not replace:
            _refuse_existing(path)  # it may have appeared in the meantime
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise ValueError(f"{path} exists and is not overwritten: choose another name or move it away")


def new_folder(path: str | Path) -> Path:
    """Make a folder, and those above it.

    Raises ValueError if it exists (the message names one that is free) or cannot be made.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True)
    except FileExistsError:
        raise ValueError(f"{path} exists and is not overwritten: choose another, such as {free_name(path)}") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be made: {error}") from error
    return path


def free_name(path: str | Path) -> Path:
    """`path` if nothing is there yet, or else the first of path-2, path-3, ... that is free."""
    path = candidate = Path(path)
    number = 1
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.name}-{number}")
    return candidate


def save_npz(path: str | Path, arrays: Mapping[str, Any], *, replace: bool = False) -> None:
    """Write tensors, arrays and numbers to a compressed .npz file, atomically.

    Raises ValueError for what `atomic_write` refuses, for a path that does not end in .npz, and for values that only
    pickling could store; then nothing is written.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{path} does not end in .npz")
    converted = {name: as_array(values) for name, values in arrays.items()}
    for name, array in converted.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name} is no array of numbers or text (dtype {array.dtype}): only those are stored")
    with atomic_write(path, replace=replace) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in converted.items():  # np.savez reserves some names, a Record none
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def load_npz(path: str | Path, required: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz file; nothing is ever unpickled.

    Raises ValueError if the file is missing, is damaged or no .npz, holds pickled objects, or lacks an array that
    is named in `required`.
    """
    need = f" (needed: an .npz file with {', '.join(required)})" if required else " (needed: an .npz file)"
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}{need}")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is no .npz file, or the end of it is missing{need}")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} cannot be read: {error}{need}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError(f"{path} is an archive of something else than arrays{need}")
    missing = [name for name in required if name not in arrays]
    if missing:
        raise ValueError(f"{path} has no {', '.join(missing)}; it holds {', '.join(arrays) or 'nothing'}{need}")
    return arrays


def to_json(value: Any) -> Any:
    """Turn dataclasses, mappings, sequences, paths, arrays and tensors into what strict JSON can hold.

    JSON knows no NaN and no infinity: both become None (null), which tables read back as missing.
    Raises TypeError for anything else.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, np.ndarray | np.generic | Tensor):
        return to_json(as_array(value).tolist())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_json(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(item) for item in value]
    if isinstance(value, Path | torch.dtype | torch.device):
        return str(value)
    raise TypeError(f"{value!r} ({type(value).__name__}) has no place in JSON: give a number, text, list or mapping")


def from_json(kind: type[T], values: Any, prefix: str = "", leave_out: Sequence[str] = ()) -> T:
    """The dataclass `kind` from a mapping, as JSON or YAML hold one; what the mapping lacks has its default.

    Strict, so that a misspelt key cannot be taken for a default. `prefix` begins the keys in messages, and fields in
    `leave_out` are none.

    Raises ValueError for an unknown or missing key and a value of the wrong kind: the message says which.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{prefix.rstrip('.')} holds {values!r}: names with values are needed")
    fields = [field for field in dataclasses.fields(typing.cast(Any, kind)) if field.name not in leave_out]
    known = [field.name for field in fields]
    for key in values:
        if key not in known:
            raise ValueError(f"unknown key {prefix}{key}; known keys are {', '.join(prefix + name for name in known)}")
    for field in fields:
        default = (field.default, field.default_factory)
        if field.name not in values and default == (dataclasses.MISSING, dataclasses.MISSING):
            raise ValueError(f"{prefix}{field.name} is missing")
    hints = typing.get_type_hints(kind)
    return kind(**{key: _convert(hints[key], value, f"{prefix}{key}") for key, value in values.items()})


def _convert(hint: Any, value: Any, key: str) -> Any:
    """`value` as the type `hint`, or ValueError."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return from_json(typing.cast(type, hint), value, f"{key}.")
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        *others, last = (argument for argument in arguments if argument is not type(None))
        for other in others:
            with suppress(ValueError):
                return _convert(other, value, key)
        return _convert(last, value, key)
    if origin is Literal:
        if value not in arguments:
            raise ValueError(f"{key} is {value!r}: known values are {', '.join(map(str, arguments))}")
        return value
    if origin is tuple:
        return _convert_items(arguments, value, key)
    if hint is float and isinstance(value, str):
        try:
            return float(value)  # YAML takes 550e-9, without a point, for text
        except ValueError:
            pass
    accepted = {float: (int, float), Path: str}.get(hint, hint)
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{key} is {value!r}: {_KINDS[hint]} is needed")
    return hint(value)


def _convert_items(hints: tuple[Any, ...], values: Any, key: str) -> tuple[Any, ...]:
    """A list as a tuple of fixed length, or of any length if `hints` ends in an ellipsis."""
    if not isinstance(values, list):
        raise ValueError(f"{key} is {values!r}: a list is needed")
    if hints[-1] is Ellipsis:
        hints = hints[:1] * len(values)
    if len(values) != len(hints):
        raise ValueError(f"{key} has {len(values)} items: {len(hints)} are needed")
    return tuple(
        _convert(hint, value, f"{key}[{i}]") for i, (hint, value) in enumerate(zip(hints, values, strict=True))
    )


def write_json(path: str | Path, value: Any, *, replace: bool = False) -> None:
    """Write `to_json(value)` to a file, indented, atomically. Errors as in `to_json` and `atomic_write`."""
    text = json.dumps(to_json(value), indent=2, allow_nan=False)
    with atomic_write(path, replace=replace) as file:
        file.write(f"{text}\n".encode())


def read_json(path: str | Path) -> Any:
    """Read a JSON file. Raises ValueError naming the file if it is missing or damaged."""
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path} (needed: a JSON file)")
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path} is no valid JSON: {error}") from error


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Around imports of what the extra of this name brings.

    Raises
    ------
    ModuleNotFoundError
        If one is not installed: names it, and the extra.

    Examples
    --------
    >>> with extra("data"):
    ...     import nothing_of_this_name
    Traceback (most recent call last):
    ModuleNotFoundError: nothing_of_this_name is not installed: pip install 'torchmask[data]'
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{error.name} is not installed: pip install 'torchmask[{name}]'", name=error.name
        ) from error
