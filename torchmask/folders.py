"""Folders for results, which are always new."""

from __future__ import annotations

import re
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


class FileNames:
    """File names of one folder that are made of titles, each of which has a file of its own.

    Names in `reserved` are given to no title.

    Examples
    --------
    >>> names = FileNames("config.json")
    >>> names.of("with mask", ".png")
    'with_mask.png'
    >>> names.of("with_mask", ".png")
    Traceback (most recent call last):
    ValueError: 'with_mask' would be written to with_mask.png, where 'with mask' is: rename one of them
    """

    def __init__(self, *reserved: str) -> None:
        self._reserved = {".", "..", *reserved}
        self._titles: dict[str, str] = {}

    def of(self, title: str, suffix: str = "") -> str:
        """Return the file name of a title; raises ValueError if it is reserved or that of another title."""
        name = re.sub(r"[^\w.+-]+", "_", title) + suffix
        if name in self._reserved:
            raise ValueError(f"{title!r} would be written to {name}, which is not free: rename it")
        other = self._titles.setdefault(name, title)
        if other != title:
            raise ValueError(f"{title!r} would be written to {name}, where {other!r} is: rename one of them")
        return name
