"""Records that running algorithms pass to callbacks, and a short `repr` for their results."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

from torch import Tensor


@dataclass(frozen=True)
class Record:
    """One step of a running algorithm.

    stage : name of the algorithm, such as "design/cma" or "restoration"
    step : number of iterations so far within the stage, from 1
    n_steps : budget of iterations, for progress bars
    scalars : the quantity that is minimised, then any others worth plotting
    arrays : best state so far (centres, object, coefficients), detached; what is kept after an interruption
    preparatory : whether the stage has no result of its own: it prepares the run, or measures what was found
    """

    stage: str
    step: int
    n_steps: int
    scalars: Mapping[str, float]
    arrays: Mapping[str, Tensor] = field(default_factory=dict)
    preparatory: bool = False


Callback = Callable[[Record], None]


def fan_out(*callbacks: Callback) -> Callback:
    """Return a callback that passes each record to several others, such as a `RunLogger` and a `Progress`."""

    def call_all(record: Record) -> None:
        for callback in callbacks:
            callback(record)

    return call_all


def label_stage(callback: Callback, label: str) -> Callback:
    """Return a callback for one of several runs of an algorithm, which renames its stage "fit" to "fit/LABEL"."""
    return lambda record: callback(replace(record, stage=f"{record.stage}/{label}"))


_LONGEST = 60  # characters up to which a sequence is printed in full


class Brief:
    """Base class for dataclasses (with `repr=False`) whose `repr` gives only the shapes of tensors.

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
