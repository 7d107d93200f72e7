"""Options to config.yaml and back.

A config file holds what a result depends on. It is plain YAML: read without constructing any object, and strictly, so
that a misspelt key cannot be taken for a default.
"""

from __future__ import annotations

import contextlib
import dataclasses
import types
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar, Union

from torchmask.io import atomic_write, to_json

T = TypeVar("T")

CONFIG = "config.yaml"  # its name in the folder of a run
_COMMAND = "command"  # the key that says which command a config file is for
# Where work is done, where results go and how errors are shown: no part of what is computed.
_NOT_STORED = ("out", "config", "resume", "debug", "sweep", "workers", "backend")
_KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text", Path: "a path"}


def save_config(path: str | Path, command: str, options: Any) -> None:
    """Write the options that a result depends on, for `load_config`; paths that exist become absolute. A new file."""
    import yaml

    values = {_COMMAND: command} | to_json(stored(options))
    with atomic_write(path) as file:
        file.write(yaml.safe_dump(values, sort_keys=False, allow_unicode=True).encode())


def load_config(path: str | Path, options: type[T], command: str) -> T:
    """Read what `save_config` wrote, or part of it; `options.from_v01`, if there is one, translates old keys.

    Raises
    ------
    ValueError
        If the file is missing, no YAML, for another command, or holds an unknown key or a value of the wrong kind; the
        message names the keys that are known.
    """
    import yaml

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no config file {path}")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is no valid YAML: {error}") from error
    try:
        values = dict(_mapping({} if values is None else values, "the file"))
        made_for = values.pop(_COMMAND, command)
        if made_for != command:
            raise ValueError(f"it is for {made_for}, not for {command}")
        if hasattr(options, "from_v01"):
            values = typing.cast(Any, options).from_v01(values)
        return _build(options, values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def stored(options: Any) -> dict[str, Any]:
    """Fields that a result depends on, nested dataclasses as mappings, paths absolute."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return stored(value)
        if isinstance(value, tuple):
            return [plain(item) for item in value]
        return value.absolute() if isinstance(value, Path) and value.exists() else value

    return {field.name: plain(getattr(options, field.name)) for field in _fields(type(options))}


def _fields(options: type) -> list[dataclasses.Field[Any]]:
    return [field for field in dataclasses.fields(options) if field.name not in _NOT_STORED]


def _mapping(values: Any, key: str) -> dict[str, Any]:
    if not isinstance(values, dict):
        raise ValueError(f"{key} holds {values!r}: names with values are needed")
    return values


def _build(options: type[T], values: Any, prefix: str = "") -> T:
    """An instance of the dataclass `options` from a mapping; what the mapping lacks has its default."""
    known = [field.name for field in _fields(options)]
    for key in _mapping(values, prefix.rstrip(".")):
        if key not in known:
            raise ValueError(f"unknown key {prefix}{key}; known keys are {', '.join(prefix + name for name in known)}")
    hints = typing.get_type_hints(options)
    return options(**{key: _convert(hints[key], value, f"{prefix}{key}") for key, value in values.items()})


def _convert(hint: Any, value: Any, key: str) -> Any:
    """`value` as the type `hint`, or ValueError."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast(type, hint), value, f"{key}.")
    if origin in (Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        *others, last = (argument for argument in arguments if argument is not type(None))
        for other in others:
            with contextlib.suppress(ValueError):
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
