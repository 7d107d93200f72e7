"""Progress of a running algorithm, as one bar per stage on a terminal and as plain lines elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import TYPE_CHECKING, Any

from torchmask.io import as_array
from torchmask.record import Record

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import TaskID

_PLAIN_INTERVAL = 10.0  # seconds between the plain lines of one stage


class Progress:
    """Callback that shows the progress of each stage, the quantity it minimises (its first scalar), and the time left.

    A stage is shown once it has run for `delay` seconds, so quick ones stay silent. On a terminal it is a progress bar;
    elsewhere (a file, a pipe, a notebook) a plain line every 10 seconds and one at the end.

    Parameters
    ----------
    delay : float
        Running time after which a stage is shown [s].
    console : rich.console.Console, optional
        Console to write to; standard error by default.

    Examples
    --------
    >>> with Progress() as progress:
    ...     for step in range(100):
    ...         progress(Record("fit", step + 1, 100, {"loss": 1 / (step + 1)}))
    """

    def __init__(self, delay: float = 2.0, console: Console | None = None) -> None:
        from rich.console import Console

        self._delay = delay
        self._console = console or Console(stderr=True)
        self._bars: Any = None
        self._tasks: dict[str, TaskID] = {}
        self._started: dict[str, float] = {}
        self._printed: dict[str, float] = {}
        self._last: Record | None = None
        self._last_time = 0.0

    def __call__(self, record: Record) -> None:
        now = time.monotonic()
        if self._last is not None and self._last.stage != record.stage:
            self._end_stage()
        self._last, self._last_time = record, now
        elapsed = now - self._started.setdefault(record.stage, now)
        if elapsed < self._delay:
            return
        if self._console.is_terminal:
            self._draw(record)
        elif now - self._printed.get(record.stage, self._started[record.stage]) >= _PLAIN_INTERVAL:
            self._printed[record.stage] = now
            left = elapsed * (record.n_steps / record.step - 1)
            self._print(record, f", {left:.0f} s left")

    def close(self, interrupted: bool = False) -> None:
        """End the current stage and release the terminal. An interrupted stage keeps its unfilled bar."""
        self._end_stage(interrupted)
        if self._bars is not None:
            self._bars.stop()
            self._bars = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close(interrupted=error is not None)

    def _draw(self, record: Record) -> None:
        from rich import progress

        if self._bars is None:
            self._bars = progress.Progress(
                progress.TextColumn("{task.description}"),
                progress.BarColumn(),
                progress.MofNCompleteColumn(),
                progress.TextColumn("{task.fields[value]}"),
                progress.TimeElapsedColumn(),
                progress.TimeRemainingColumn(),
                console=self._console,
            )
            self._bars.start()
        if record.stage not in self._tasks:
            self._tasks[record.stage] = self._bars.add_task(record.stage, total=record.n_steps, value="")
        budget: dict[str, Any] = {"completed": record.step, "total": record.n_steps}  # a restart may raise the budget
        self._bars.update(self._tasks[record.stage], **budget, value=_objective(record))

    def _print(self, record: Record, estimate: str = "") -> None:
        seconds = self._last_time - self._started[record.stage]
        line = f"{record.stage} {record.step}/{record.n_steps} {_objective(record)} {seconds:.0f} s{estimate}"
        self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def _end_stage(self, interrupted: bool = False) -> None:
        """Fill the bar of the latest stage, which may have converged before its budget was used up."""
        last, self._last = self._last, None
        if last is None or self._last_time - self._started[last.stage] < self._delay:
            return
        if not self._console.is_terminal:
            self._print(last)
        elif not interrupted:
            self._bars.update(self._tasks[last.stage], total=last.step)


def _objective(record: Record) -> str:
    return next((f"{name} {float(as_array(value)):.5g}" for name, value in record.scalars.items()), "")
