"""What a checkpoint is known by: a hash of frames, priors and settings, that of functions and networks included."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence
from types import ModuleType

import numpy as np
import torch
from torch import Tensor

from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.parts import everything_in, parts_of


def fingerprint_of(objective: MyopicObjective, settings: Sequence[object], known: Sequence[Tensor | None]) -> str:
    """Return a hash of the frames, priors, settings and further known tensors, to recognise their checkpoint.

    Functions are known by their names and code, and by the numbers, tensors and modules that they read from their
    defaults, from what encloses them and from the names of their own file; functions of other files that these call,
    by their names only. Modules are known by their class, attributes and weights, but not by the code of their class.

    Raises ValueError if something has no name but an address in memory, which would be another one in the process that
    resumes.
    """
    model = objective.model
    tensors = [objective.frames, objective.precision, *model.pupil.samples(), model.response]
    digest = hashlib.sha256()
    for part in everything_in((*settings, objective.free, model.background, objective.prior, *tensors, *known)):
        digest.update(_name(type(part)).encode() + b"\0" + _content(part) + b"\0")
    return digest.hexdigest()


def _content(value: object) -> bytes:
    """Return what tells a value from others of its type, but for its parts."""
    if isinstance(value, Tensor):  # by its bytes, since NumPy lacks some types of numbers
        plain = value.detach().resolve_conj().resolve_neg().cpu().contiguous().reshape(-1)
        return f"{value.dtype} {tuple(value.shape)}".encode() + plain.view(torch.uint8).numpy().tobytes()
    parts = parts_of(value)
    if parts is None and isinstance(value, np.ndarray):
        return f"{value.dtype} {value.shape}".encode() + value.tobytes()
    return (_text(value) if parts is None else str(len(parts))).encode()


def _text(value: object) -> str:
    """Return what tells a value without parts from others. Raises ValueError if that is an address in memory."""
    if isinstance(value, type):
        return _name(value)
    if isinstance(value, ModuleType):
        return value.__name__
    if re.search(r" at 0x[0-9a-fA-F]+", text := repr(value)):
        raise ValueError(
            f"a checkpoint cannot know {text} again, which has no name but an address in memory: give a function or "
            "module of numbers and tensors, or an object whose __repr__ tells its numbers, or no checkpoint"
        )
    return text


def _name(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
