"""A run: a new folder with the log, the config that reproduces it, and a progress bar."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from torchmask.cli.config import CONFIG, save_config, stored
from torchmask.progress import Progress
from torchmask.record import Callback, Record
from torchmask.tracking import RunLogger, fan_out, free_name


@dataclass(frozen=True)
class Run:
    """directory : of the results; logger : TensorBoard and metrics.jsonl; callback : for the algorithms; summary :
    lines that are printed at the end, when no progress bar is in their way."""

    directory: Path
    logger: RunLogger
    callback: Callback
    summary: list[str] = field(default_factory=list)


@contextmanager
def new_run(command: str, options: Any, directory: Path | None, seed: int | None = None) -> Iterator[Run]:
    """Log to a new folder (by default runs/COMMAND-date-time), and to the terminal.

    Where the request turns out to be impossible before any work is done (ValueError), the folder goes again. Whatever
    else ends the run leaves what was reached, and the user is told where.

    Raises ValueError if the folder exists or cannot be made.
    """
    directory = directory or free_name(Path("runs") / datetime.now().strftime(f"{command}-%Y%m%d-%H%M%S"))
    parents = [parent for parent in directory.parents if not parent.exists()]
    useless = False  # until the folder is ours, and again once it holds results

    def note(_: Record) -> None:
        nonlocal useless
        useless = False

    try:
        with RunLogger(directory, seed=seed) as logger, Progress() as progress:
            useless = True
            logger.log_config(stored(options))
            save_config(directory / CONFIG, command, options)
            run = Run(directory, logger, fan_out(logger, progress, note))
            yield run
    except KeyboardInterrupt:
        print(f"\nwhat was reached is in {directory}", file=sys.stderr)
        raise
    except ValueError:
        if useless:
            shutil.rmtree(directory)
            for parent in parents:
                parent.rmdir()
        raise
    print(*run.summary, f"written to {directory}", sep="\n")
