"""Options to config.yaml and back.

A config file holds what a result depends on. It is plain YAML: read without constructing any object, and strictly, so
that a misspelt key cannot be taken for a default.
"""

from __future__ import annotations

import dataclasses
import typing
from pathlib import Path
from typing import Any, TypeVar

from torchmask.io import atomic_write, from_json, to_json

T = TypeVar("T")

CONFIG = "config.yaml"  # its name in the folder of a run
_COMMAND = "command"  # the key that says which command a config file is for
# Where work is done, where results go and how errors are shown: no part of what is computed.
_NOT_STORED = ("out", "config", "resume", "debug", "sweep", "workers", "backend")


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
        raise ValueError(f"{path} is not valid YAML: {error}") from error
    try:
        values = {} if values is None else values
        if not isinstance(values, dict):
            raise ValueError(f"the file holds {values!r}: names with values are needed")
        values = dict(values)
        made_for = values.pop(_COMMAND, command)
        if made_for != command:
            raise ValueError(f"it is for {made_for}, not for {command}")
        if hasattr(options, "from_v01"):
            values = typing.cast(Any, options).from_v01(values)
        return from_json(options, values, leave_out=_NOT_STORED)
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

    names = (field.name for field in dataclasses.fields(options) if field.name not in _NOT_STORED)
    return {name: plain(getattr(options, name)) for name in names}
