"""A run: a new folder with the log, the config that reproduces it, and a progress bar."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchmask.cli.config import CONFIG, save_config, stored
from torchmask.cli.instrument_used import INSTRUMENT
from torchmask.cli.options import RunOptions, SweepOptions
from torchmask.folders import free_name
from torchmask.instrument.instrument import Instrument
from torchmask.io import atomic_write, write_json
from torchmask.progress import Progress
from torchmask.record import Callback, Record, fan_out
from torchmask.tracking import RunLogger

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CHECKPOINT = "resume.npz"  # of a run that can be resumed


@dataclass(frozen=True)
class Run:
    """Output of a run.

    directory : folder of the results
    logger : writer of TensorBoard events and metrics.jsonl
    callback : callback for the algorithms
    summary : lines that are printed at the end, after the progress bars
    """

    directory: Path
    logger: RunLogger
    callback: Callback
    summary: list[str] = field(default_factory=list)

    def keep_instrument(self, instrument: Instrument | None) -> None:
        """Write the instrument of the run, if there is one, for other commands."""
        if instrument is not None:
            instrument.save(self.directory / INSTRUMENT)

    def report(self, name: str, numbers: Mapping[str, Any], text: str, figure: Figure | None = None) -> None:
        """Write NAME.json for programs, NAME.md for readers, and NAME.png; the last two for TensorBoard too."""
        write_json(self.directory / f"{name}.json", numbers)
        with atomic_write(self.directory / f"{name}.md") as file:
            file.write(text.encode())
        self.logger.text(name, text)
        if figure is not None:
            self.logger.figure(name, figure)


@contextmanager
def new_run(command: str, options: RunOptions, seed: int | None = None) -> Iterator[Run]:
    """Log to a new folder (by default runs/COMMAND-date-time), and to the terminal.

    If the request turns out to be impossible before there are any results (ValueError, or memory is short), the folder
    is removed again. If the run ends early for any other reason, the results so far are kept, and the user is told
    where.

    Raises ValueError if the folder exists or cannot be made.
    """
    run: Run | None = None
    directory = options.out or free_name(Path("runs") / datetime.now().strftime(f"{command}-%Y%m%d-%H%M%S"))
    parents = [parent for parent in directory.parents if not parent.exists()]
    useless = False  # only True from when the folder is made until it has results

    def kept(write: Callback) -> Callback:
        """Write records of results to the log, after which the folder is kept."""

        def note(record: Record) -> None:
            nonlocal useless
            if not record.preparatory:
                useless = False
                write(record)

        return note

    try:
        with RunLogger(directory, seed=seed) as logger, Progress() as progress:
            useless = True
            logger.log_config(stored(options))
            save_config(directory / CONFIG, command, options)
            run = Run(directory, logger, fan_out(kept(logger), progress))
            yield run
    except KeyboardInterrupt:
        print("", *_ways_on(command, directory, options), sep="\n", file=sys.stderr)
        raise
    except (ValueError, MemoryError, RuntimeError):
        if useless:
            shutil.rmtree(directory)
            for parent in parents:
                parent.rmdir()
        elif run is not None:
            print(*run.summary, f"the results so far are in {directory}", sep="\n", file=sys.stderr)
        raise
    print(f"written to {directory}", *run.summary, sep="\n")


def _ways_on(command: str, directory: Path, options: RunOptions) -> list[str]:
    """Return what to print after an interruption: where the results so far are, and how to continue if possible."""
    lines = [f"the results so far are in {directory}"] if directory.is_dir() else []
    if all((directory / name).is_file() for name in (CONFIG, CHECKPOINT)):
        lines.append(f"continue with: torchmask {command} --resume {shlex.quote(str(directory))}")
    if isinstance(options, SweepOptions):
        lines.append(f"with --sweep {options.sweep} the next run goes on from there")
    return lines
