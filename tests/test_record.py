"""Records on their way to those who listen, and results that print briefly."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchmask.record import Brief, Record, fan_out, label_stage


def test_fan_out_calls_all_in_order():
    calls = []
    both = fan_out(lambda r: calls.append(("a", r.step)), lambda r: calls.append(("b", r.step)))
    both(Record("fit", 5, 10, {"loss": 1.0}))
    assert calls == [("a", 5), ("b", 5)]


def test_a_label_tells_the_runs_of_one_algorithm_apart_and_changes_nothing_else():
    seen = []
    record = Record("design/cma", 3, 7, {"mse": 0.1}, {})
    for label in ("6_holes", "9_holes"):
        label_stage(seen.append, label)(record)
    assert [one.stage for one in seen] == ["design/cma/6_holes", "design/cma/9_holes"]
    assert {(one.step, one.n_steps, one.scalars["mse"]) for one in seen} == {(3, 7, 0.1)}
    assert record.stage == "design/cma"


@dataclass(frozen=True, repr=False)
class Kept(Brief):
    images: Tensor
    scale: Tensor
    header: dict[str, int]
    seconds: list[float]
    names: tuple[str, ...]
    inner: Brief | None = None
    hidden: int = field(default=3, repr=False)


def test_results_print_as_a_few_lines_whatever_they_hold():
    inner = Kept(torch.zeros(1), torch.tensor(2.0), {}, [], ())
    kept = Kept(torch.zeros(100, 64, 64), torch.tensor(0.5), {"A": 1, "B": 2}, [0.125] * 40, ("a", "b"), inner)
    assert repr(kept).splitlines() == [
        "Kept(",
        "    images=float32 tensor (100, 64, 64),",
        "    scale=0.5,",
        "    header={2 entries},",
        "    seconds=list of 40,",
        "    names=('a', 'b'),",
        "    inner=Kept( images=float32 tensor (1,), scale=2.0, header={}, seconds=[], names=(), ),",
        ")",
    ]
