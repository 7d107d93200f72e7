"""Going on from the checkpoint of an interrupted restoration."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from torchmask.cli.config import CONFIG, load_config, stored
from torchmask.cli.run import CHECKPOINT
from torchmask.io import to_json


def find_checkpoint(folder: Path) -> Path:
    """Return the checkpoint in the folder of a run. Raises ValueError if there is none."""
    checkpoint = folder / CHECKPOINT
    if not checkpoint.is_file():
        raise ValueError(f"there is no {checkpoint} to resume from: it is first written at the 100th iteration")
    return checkpoint


@contextmanager
def resumed(folder: Path | None, state: Path, command: str, options: Any) -> Iterator[None]:
    """Let the block go on at `state` from the checkpoint in `folder`, of which it gets a copy; None: from nothing.

    Raises ValueError, which names the checkpoint itself and the options that differ, if it does not fit.
    """
    if folder is None:
        yield
        return
    checkpoint = find_checkpoint(folder)
    shutil.copyfile(checkpoint, state)
    try:
        yield
    except ValueError as error:
        if str(state) not in str(error):
            raise
        differing = _differing(folder / CONFIG, command, options)
        told = f"here {' and '.join(differing)}" if differing else "no option differs"
        raise ValueError(
            f"{checkpoint} is of other frames or settings, of another version, or damaged ({told}): give what it was "
            "made with, or leave out --resume to start again"
        ) from error


def _differing(config: Path, command: str, options: Any) -> list[str]:
    """Return what differs from the options of a config file, in words."""
    try:
        before = to_json(stored(load_config(config, type(options), command)))
    except (OSError, ValueError):  # of another version, which has other options
        return []
    now = to_json(stored(options))
    return [f"{name} is {value}, there {before[name]}" for name, value in now.items() if value != before[name]]
