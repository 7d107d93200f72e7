"""How far a restoration has come, on disk, so that it can go on after an interruption."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchmask.io import load_npz, save_npz
from torchmask.restoration.problem import State


@dataclass
class Progress:
    """Everything a later segment of a restoration depends on.

    starts : how many there were, with the present one; began : iterations before it
    rival : where the best of the earlier ones ended, and rival_message why
    relocations : how often lost frames and the object's place have been looked for
    message : why it stopped, empty until then
    """

    state: State
    costs: list[float] = field(default_factory=list)
    n_evaluations: int = 0
    relocations: int = 0
    starts: int = 1
    began: int = 0
    rival: State | None = None
    rival_message: str = ""
    message: str = ""

    @property
    def iterations(self) -> int:
        """Of the present start."""
        return len(self.costs) - self.began


_NUMBERS = ("n_evaluations", "relocations", "starts", "began")
_TEXTS = ("rival_message", "message")


def save_checkpoint(path: str | Path, progress: Progress, fingerprint: str) -> None:
    """Write or replace an .npz file; `fingerprint` says which frames and settings it belongs to."""
    arrays: dict[str, Any] = {name: getattr(progress, name) for name in ("costs", *_NUMBERS, *_TEXTS)}
    for prefix, state in (("", progress.state), ("rival_", progress.rival)):
        if state is not None:
            arrays |= {prefix + item.name: getattr(state, item.name) for item in fields(State)}
    save_npz(path, arrays | {"fingerprint": fingerprint}, replace=True)


def load_checkpoint(path: str | Path, fingerprint: str, device: torch.device) -> Progress:
    """Read what `save_checkpoint` wrote. Raises ValueError if it is damaged or of another fingerprint."""
    names = [item.name for item in fields(State)]
    stored = load_npz(path, required=(*names, "costs", *_NUMBERS, *_TEXTS, "fingerprint"))
    if stored["fingerprint"].item() != fingerprint:
        raise ValueError(f"{path} is the checkpoint of other frames or settings: give another name or remove it")

    def state(prefix: str) -> State:
        values = (stored[prefix + name] for name in names)
        return State(*(torch.from_numpy(v).to(device) if v.ndim else float(v) for v in values))  # type: ignore[arg-type]

    rival = state("rival_") if "rival_z" in stored else None
    others = {name: stored[name].item() for name in (*_NUMBERS, *_TEXTS)}
    return Progress(state(""), np.atleast_1d(stored["costs"]).tolist(), rival=rival, **others)
