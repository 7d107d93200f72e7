"""What an algorithm tells the outside while it runs: plain records to a callback, nothing about who listens."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from torch import Tensor


@dataclass(frozen=True)
class Record:
    """One step of a running stage.

    stage : which algorithm is speaking, such as "design/cma" or "restoration"
    step : iterations done so far, counted from 1 within the stage
    n_steps : the budget, for progress bars
    scalars : what is being minimised first, then anything else worth a curve
    arrays : the best state so far (centres, object, coefficients), detached; enough to keep after an interruption
    """

    stage: str
    step: int
    n_steps: int
    scalars: Mapping[str, float]
    arrays: Mapping[str, Tensor] = field(default_factory=dict)


Callback = Callable[[Record], None]


def fan_out(*callbacks: Callback) -> Callback:
    """One callback that hands each record to several, such as a `RunLogger` and a `Progress`."""

    def call_all(record: Record) -> None:
        for callback in callbacks:
            callback(record)

    return call_all


def label_stage(callback: Callback, label: str) -> Callback:
    """The same callback for an algorithm that runs several times: its stage, such as "fit", becomes "fit/LABEL"."""
    return lambda record: callback(replace(record, stage=f"{record.stage}/{label}"))
