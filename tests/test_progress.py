"""Progress is shown on what takes time, as bars on a terminal and as a few lines elsewhere."""

import io

import pytest
import torch
from rich.console import Console

from torchmask import progress
from torchmask.progress import Progress
from torchmask.record import Record


class Clock:
    """Stands in for `time`, so that the tests need not wait."""

    now = 0.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(progress, "time", clock)
    return clock


def run(bar: Progress, clock: Clock, stage: str, n_steps: int, seconds: float, done: int | None = None) -> None:
    for step in range(1, (done or n_steps) + 1):
        clock.now += seconds
        bar(Record(stage, step, n_steps, {"cost": torch.tensor(100.0 / step, requires_grad=True), "other": 7.0}))


def plain() -> tuple[Console, io.StringIO]:
    out = io.StringIO()
    return Console(file=out, width=80), out


def test_short_stages_are_silent(clock):
    for terminal in (True, False):
        out = io.StringIO()
        with Progress(console=Console(file=out, force_terminal=terminal)) as bar:
            run(bar, clock, "quick", 10, 0.1)
        assert out.getvalue() == ""


def test_few_plain_lines_without_a_terminal(clock):
    console, out = plain()
    with Progress(console=console) as bar:
        run(bar, clock, "design/cma", 100, 0.25)
        clock.now += 50  # figures, say: no part of the stage
        run(bar, clock, "restoration/mask", 10, 1.0)
    assert out.getvalue().splitlines() == [
        "design/cma 41/100 cost 2.439 10 s, 14 s left",  # 10 s (100 - 41) / 41
        "design/cma 81/100 cost 1.2346 20 s, 5 s left",
        "design/cma 100/100 cost 1 25 s",
        "restoration/mask 10/10 cost 10 9 s",
    ]


def test_bars_on_a_terminal(clock):
    out = io.StringIO()
    with Progress(console=Console(file=out, force_terminal=True, width=120)) as bar:
        run(bar, clock, "restoration/mask", 1000, 0.05, done=500)  # converged early
        run(bar, clock, "restoration/full", 50, 0.1)
        assert bar._bars is not None
    shown = out.getvalue()
    last = shown.rsplit("restoration/mask", 1)[1]  # the final state of both bars
    assert "500/500" in last  # a stage that ended early is full
    assert "cost 0.2" in last
    assert "restoration/full" in last
    assert "50/50" in last
    assert bar._bars is None


def test_a_budget_that_grows_is_the_one_that_counts(clock):
    """A restoration that starts again has the iterations of both starts."""
    for terminal in (True, False):
        out = io.StringIO()
        with Progress(console=Console(file=out, force_terminal=terminal, width=120)) as bar:
            run(bar, clock, "restoration", 10, 1.0)
            for step in range(11, 22):
                clock.now += 1.0
                bar(Record("restoration", step, 40, {"cost": 1.0}))
            if terminal:
                (task,) = bar._bars.tasks
                assert (task.completed, task.total) == (21, 40)
                assert not task.finished
        if not terminal:
            assert "restoration 21/40 cost 1 20 s, 18 s left" in out.getvalue()  # 20 s (40 - 21) / 21


def test_an_interruption_frees_the_terminal(clock):
    out = io.StringIO()
    bar = Progress(console=Console(file=out, force_terminal=True, width=120))

    def interrupt() -> None:
        with bar:
            run(bar, clock, "fit", 100, 1.0, done=10)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert out.getvalue().rstrip().endswith("\x1b[?25h")  # the cursor is back
    assert "10/100" in out.getvalue()


def test_a_record_without_scalars_has_no_value(clock):
    console, out = plain()
    with Progress(delay=0.0, console=console) as bar:
        bar(Record("screens", 1, 1, {}))
    assert out.getvalue() == "screens 1/1  0 s\n"
