"""Folders for results, which are always new."""

from __future__ import annotations

from pathlib import Path


def new_folder(path: str | Path) -> Path:
    """Create a folder and its parents.

    Raises ValueError if it exists (the message suggests a free name) or cannot be created.
    """
    require_new(path := Path(path))
    try:
        path.mkdir(parents=True)
    except OSError as error:
        raise ValueError(f"{path} cannot be created: {error}") from error
    return path


def require_new(path: Path) -> None:
    """Raise ValueError if a folder exists; the message suggests a free name."""
    if path.exists():
        raise ValueError(f"{path} exists and is not overwritten: choose another, such as {free_name(path)}")


def free_name(path: str | Path) -> Path:
    """Return `path` if it does not exist, or else the first of path-2, path-3, ... that does not."""
    path = candidate = Path(path)
    number = 1
    while candidate.exists():
        number += 1
        candidate = path.parent / f"{path.name or 'run'}-{number}"  # the present folder has no name
    return candidate
