"""Write options to config.yaml and read them.

A config file has all options that a result depends on. It is plain YAML, read without constructing any object, and
unknown keys are errors, so that a misspelt key does not go unnoticed.
"""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any, TypeVar

from torchmask.io import atomic_write, from_json, to_json

T = TypeVar("T")

CONFIG = "config.yaml"  # its name in the folder of a run
_COMMAND = "command"  # key for the command that a config file belongs to
# Options that do not affect what is computed.
_NOT_STORED = ("out", "config", "resume", "debug", "sweep", "workers", "backend")


def save_config(path: str | Path, command: str, options: Any, *, replace: bool = False) -> None:
    """Write the options that a result depends on for `load_config`; existing paths become absolute.

    The file is a new one, or, with `replace`, in place of one that exists.
    """
    import yaml

    values = {_COMMAND: command} | to_json(stored(options))
    with atomic_write(path, replace=replace) as file:
        file.write(yaml.safe_dump(values, sort_keys=False, allow_unicode=True).encode())


def load_config(path: str | Path, options: type[T], command: str) -> T:
    """Read a file of `save_config`, or part of one; `options.from_v01`, if it exists, translates old keys.

    Raises
    ------
    ValueError
        If the file is missing, is not YAML, is for another command, or has an unknown key or a value of the wrong type;
        the message lists the known keys.
    """
    import yaml

    path = Path(path)
    if not path.is_file():
        raise ValueError(f"there is no config file {path}")
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    try:
        values = {} if values is None else values
        if not isinstance(values, dict):
            raise ValueError(f"the file contains {values!r}: names with values are needed")
        values = dict(values)
        made_for = values.pop(_COMMAND, command)
        if made_for != command:
            raise ValueError(f"it is for {made_for}, not for {command}")
        if hasattr(options, "from_v01"):
            values = typing.cast(Any, options).from_v01(values)
        return from_json(options, values, leave_out=_NOT_STORED)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def config_command(path: Path) -> str | None:
    """Return the command that a config file belongs to; None if there is no such file, or it names none."""
    import yaml

    if not path.is_file():
        return None
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError):
        return None
    return values.get(_COMMAND) if isinstance(values, dict) else None


def stored(options: Any) -> dict[str, Any]:
    """Return the fields that a result depends on, with nested dataclasses as mappings and absolute paths."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return stored(value)
        if isinstance(value, tuple):
            return [plain(item) for item in value]
        return value.absolute() if isinstance(value, Path) and value.exists() else value

    names = (field.name for field in dataclasses.fields(options) if field.name not in _NOT_STORED)
    return {name: plain(getattr(options, name)) for name in names}
