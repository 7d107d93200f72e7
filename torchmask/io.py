"""Reading files without unpickling, writing them completely or not at all, and importing optional dependencies."""

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

from torchmask.plain import require_plain

T = TypeVar("T")

_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}


def as_array(values: Any) -> np.ndarray:
    """Convert a tensor (on any device, with or without gradient), number or sequence to a NumPy array."""
    return values.numpy(force=True) if isinstance(values, Tensor) else np.asarray(values)


def as_tensor(values: Any, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
    """Convert an array, number or sequence to a tensor, by default on torch's device; a tensor stays where it is.

    Arrays may have any strides, as flipped ones do, and any order of bytes, as those of FITS files do.

    Raises TypeError for values with a unit, or that are no numbers, such as a path or None, and ValueError for masked
    arrays that hide values, see `require_plain`.
    """
    if isinstance(values, Tensor):
        return values.to(device=device, dtype=dtype)
    require_plain("values", values)
    array = np.asarray(values)
    if array.dtype.kind not in "biufc":
        given = repr(values) if values is None or isinstance(values, (str, Path)) else f"an array of {array.dtype}"
        raise TypeError(f"{given} was given: numbers are needed, as an array, a tensor or a sequence")
    return torch.as_tensor(_native(array), dtype=dtype, device=device)


def _native(array: np.ndarray) -> np.ndarray:
    """Return the array with the order of bytes, strides and precision that tensors have; they may be written to."""
    wide = array.dtype.kind == "f" and array.itemsize > 8
    kind = np.dtype(np.float64) if wide else array.dtype.newbyteorder("=")
    return array.astype(kind, order="C", copy=not array.flags.writeable)


@contextmanager
def atomic_write(path: str | Path, *, replace: bool = False) -> Iterator[BinaryIO]:
    """Open a file that appears at `path` only if the block ends without an error; otherwise nothing is left behind.

    The bytes go to a temporary file in the same folder, which is synchronised to disk and renamed.

    Parameters
    ----------
    path : str or Path
        Name of the file, in an existing folder.
    replace : bool
        Whether an existing file may be replaced. Readers see either the old or the new one, never a mixture.

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
        raise ValueError(f"{path} cannot be written: there is no folder {path.parent}, create it first")
    if not replace:
        _refuse_existing(path)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        with open(temporary, "xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        if not replace:
            _refuse_existing(path)  # it may have been created in the meantime
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _refuse_existing(path: Path) -> None:
    if path.exists():
        raise ValueError(f"{path} exists and is not overwritten: choose another name or move it away")


def save_npz(path: str | Path, arrays: Mapping[str, Any], *, replace: bool = False) -> None:
    """Write tensors, arrays and numbers to a compressed .npz file, atomically.

    Raises ValueError, and writes nothing, if `atomic_write` refuses the path, it does not end in .npz, or a value could
    only be stored by pickling.
    """
    if Path(path).suffix != ".npz":
        raise ValueError(f"{path} does not end in .npz: give a name that does")
    converted = {name: as_array(values) for name, values in arrays.items()}
    for name, array in converted.items():
        if array.dtype.hasobject:
            raise ValueError(f"{name} has dtype {array.dtype}: only numbers and text can be stored")
    with atomic_write(path, replace=replace) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in converted.items():  # not np.savez, which reserves some names
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, array, allow_pickle=False)


def load_npz(path: str | Path, required: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """Read all arrays of an .npz file, without unpickling, in this machine's order of bytes.

    Raises ValueError if the file is missing, damaged or not an .npz file, contains pickled objects, or lacks an array
    named in `required`.
    """
    # quoted, as these are names in a file: `torchmask.cli.wording` would take them for names of options
    names = ", ".join(map(repr, required))
    need = f" (needed: an .npz file with {names})" if required else " (needed: an .npz file)"
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no file {path}{need}")
    if not zipfile.is_zipfile(path):
        raise ValueError(f"{path} is not an .npz file, or its end is missing{need}")
    try:
        with np.load(path, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
    except (zipfile.BadZipFile, zlib.error, OSError, EOFError, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} cannot be read: {error}{need}") from error
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):
        raise ValueError(f"{path} is an archive of something other than arrays{need}")
    missing = [name for name in required if name not in arrays]
    if missing:
        lacking, held = (", ".join(map(repr, names)) for names in (missing, arrays))
        raise ValueError(f"{path} has no {lacking}; it contains {held or 'nothing'}{need}")
    return {name: _native(array) for name, array in arrays.items()}


def to_json(value: Any) -> Any:
    """Convert dataclasses, mappings, sequences, paths, arrays and tensors to values that strict JSON can represent.

    NaN and infinity, which JSON lacks, become None (null). Raises TypeError for values of other types.
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
    raise TypeError(f"{value!r} ({type(value).__name__}) cannot be stored as JSON: give a number, text, list or dict")


def from_json(kind: type[T], values: Any, prefix: str = "", leave_out: Sequence[str] = ()) -> T:
    """Create the dataclass `kind` from a mapping read from JSON or YAML; missing keys take their defaults.

    Unknown keys are errors, so a misspelt key cannot silently mean a default. `prefix` is put before keys in messages,
    and fields in `leave_out` count as unknown.

    Raises ValueError if a key is unknown or missing, or a value has the wrong type; the message says which.
    """
    if not isinstance(values, dict):
        raise ValueError(f"{prefix.rstrip('.')} is {values!r}: a mapping of names to values is needed")
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
    """Convert `value` to the type `hint`, or raise ValueError."""
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
            return float(value)  # YAML reads 550e-9, without a point, as text
        except ValueError:
            pass
    accepted = {float: (int, float), Path: str}.get(hint, hint)
    if not isinstance(value, accepted) or (isinstance(value, bool) and hint is not bool):
        raise ValueError(f"{key} is {value!r}: {_KINDS[hint]} is needed")
    return hint(value)


def _convert_items(hints: tuple[Any, ...], values: Any, key: str) -> tuple[Any, ...]:
    """Convert a list to a tuple of fixed length, or of any length if `hints` ends in an ellipsis."""
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
    """Write `to_json(value)` to a file, indented, atomically. Raises the errors of `to_json` and `atomic_write`."""
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
        raise ValueError(f"{path} is not valid JSON: {error}") from error


@contextmanager
def extra(name: str) -> Iterator[None]:
    """Wrap imports of packages that the extra called `name` installs.

    Raises
    ------
    ModuleNotFoundError
        If a package is not installed; the message says how to install the extra.

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
