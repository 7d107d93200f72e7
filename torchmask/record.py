"""What an algorithm tells the outside while it runs, to a callback, and what its results print, in a few lines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Record:
    """One step of a running stage.

    stage : which algorithm is speaking, such as "design/cma" or "restoration"
    step : iterations done so far, counted from 1 within the stage
    n_steps : the budget, for progress bars
    scalars : what is being minimised first, then anything else worth a curve
    arrays : the best state so far (centres, object, coefficients), detached; enough to keep after an interruption
    preparatory : whether this is still the look at what was asked for, before any result
    """

    stage: str
    step: int
    n_steps: int
    scalars: Mapping[str, float]
    arrays: Mapping[str, Tensor] = field(default_factory=dict)
    preparatory: bool = False


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


_LONGEST = 60  # characters of one field that is a sequence


class Brief:
    """A base of dataclasses (with `repr=False`) whose arrays are not printed in full.

    Examples
    --------
    >>> import torch
    >>> from dataclasses import dataclass
    >>> @dataclass(repr=False)
    ... class Seen(Brief):
    ...     frames: torch.Tensor
    ...     noise: float
    ...     mask: torch.Tensor | None = None
    >>> Seen(torch.zeros(20, 128, 128), 1.5)
    Seen(
        frames=float32 tensor (20, 128, 128),
        noise=1.5,
    )
    """

    def __repr__(self) -> str:
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.repr}  # type: ignore[arg-type]
        lines = [f"    {name}={_shorten(value)},\n" for name, value in values.items() if value is not None]
        return f"{type(self).__name__}(\n{''.join(lines)})"


def _shorten(value: Any) -> str:
    if isinstance(value, Tensor):
        kind = str(value.dtype).removeprefix("torch.")
        return repr(value.item()) if value.ndim == 0 else f"{kind} tensor {tuple(value.shape)}"
    if isinstance(value, Mapping):
        return f"{{{len(value)} entries}}" if value else "{}"
    text = repr(value)
    if isinstance(value, (list, tuple)) and len(text) > _LONGEST:
        return f"{type(value).__name__} of {len(value)}"
    return " ".join(line.strip() for line in text.splitlines())
