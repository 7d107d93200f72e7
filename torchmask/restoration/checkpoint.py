"""Progress of a restoration on disk, so that it can continue after an interruption."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from enum import Enum
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.io import load_npz, save_npz
from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Callback, Record
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.descent import Listener, Variables
from torchmask.restoration.fingerprint import fingerprint_of
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import Calibration, Modes, State
from torchmask.restoration.traits import Refinement


class Status(Enum):
    """Whether a restoration is running, or why it ended."""

    RUNNING = "running"
    CONVERGED = "converged"
    STUCK = "no step of the last segment lowered the cost"
    GIVEN_UP = "an earlier start had a better fit"
    START_LIMIT = "the iterations of a start were spent"
    ITERATION_LIMIT = "max_iterations was reached"


@dataclass(frozen=True)
class Ending:
    """Final state of one start of a restoration, and why it ended.

    state : object, aberrations and calibration
    status : why the start ended
    decrease : fraction by which the last segment lowered the cost; None if the iterations were used up
    """

    state: State
    status: Status
    decrease: float | None = None


@dataclass
class Progress:
    """Everything on which a later segment of a restoration depends.

    candidates : the state, with several candidates for each frame during a tournament
    costs : cost after each iteration, of all starts
    n_evaluations : number of evaluations of cost and gradient
    status : status of the present start
    decrease : last decrease of the cost in the present start, as in `Ending`
    escapes : number of attempts in this start to escape from a local minimum
    starts : number of starts, including the present one
    began : number of iterations before the present start
    rival : final state of the best earlier start
    explained : final states of the starts that explain the frames, if the mean of several objects is wanted
    in_vain : number of starts since the last that was clearly better than those before it
    tempered : whether a start, the present one or an earlier one, was from the best object heated
    alike : whether the last two starts ended in the same result
    refinement : whether the position of the mask is fitted too, or will be if the frames require it
    finer : state of the last descent, which may have more modes; None before it
    last_segments : number of segments of the last descent that are done; all there may be, once it gains no more
    integrated : whether the aberrations have been integrated out, which is done at the end and not stored
    averaged : number of starts whose objects have been averaged, before the last descent
    retrieved : whether phases have been retrieved, after the present start or in the last descent
    seeks_no_more : whether phases of frames that the search has lost are no longer looked for in the last descent
    rate : that of the slopes of the first sharp object in faint light, which the search's prior suits; infinite until
        it is seen, and 1 where it is not looked for
    """

    candidates: Candidates
    costs: list[float] = field(default_factory=list)
    n_evaluations: int = 0
    status: Status = Status.RUNNING
    decrease: float | None = None
    escapes: int = 0
    starts: int = 1
    began: int = 0
    rival: Ending | None = None
    explained: tuple[Ending, ...] = ()
    in_vain: int = 0
    tempered: bool = False
    alike: bool = False
    refinement: Refinement = Refinement.OFF
    finer: State | None = None
    last_segments: int = 0
    integrated: bool = False
    averaged: int = 1
    retrieved: bool = False
    seeks_no_more: bool = False
    rate: float = 1.0

    @property
    def state(self) -> State:
        """Object, aberrations and calibration so far."""
        return self.candidates.state

    @state.setter
    def state(self, state: State) -> None:
        self.candidates = Candidates(state, self.candidates.n_each)

    @property
    def ending(self) -> Ending:
        """Present state as the ending of the present start."""
        return Ending(self.state, self.status, self.decrease)

    @property
    def iterations(self) -> int:
        """Number of iterations of the present start."""
        return len(self.costs) - self.began

    def limit(self, most: int, of_start: int) -> Status:
        """Return which limit on the iterations, of all starts or of one, has been reached, or RUNNING."""
        if len(self.costs) >= most:
            return Status.ITERATION_LIMIT
        return Status.RUNNING if self.iterations < of_start else Status.START_LIMIT

    def last_iteration(self, most: int, of_start: int) -> int:
        """Return the number of the present start's last iteration under these limits, counted over all starts."""
        return min(self.began + of_start, most)

    def reporter(self, stage: str, n_steps: int, callback: Callback | None, done: int = 0) -> Listener:
        """Return a listener of a descent after the search: it counts its evaluations and reports its iterations.

        Some may have been `done` before an interruption.
        """
        steps = itertools.count(done + 1)

        def listen(cost: float, evaluations: int, variables: Variables) -> None:
            self.n_evaluations += evaluations
            if callback is not None:
                callback(Record(stage, next(steps), n_steps, {"cost": cost}, {}))

        return listen

    def start_again(self, rival: Ending) -> None:
        """Begin another start, whose candidates are to be given; `rival` is the best so far."""
        self.rival = rival
        self.began, self.starts, self.escapes = len(self.costs), self.starts + 1, 0
        self.status, self.decrease = Status.RUNNING, None


_NUMBERS = (
    "n_evaluations",
    "escapes",
    "starts",
    "began",
    "in_vain",
    "tempered",
    "alike",
    "last_segments",
    "averaged",
    "retrieved",
    "seeks_no_more",
    "rate",
)
# arrays of an ending
_NEEDED = (
    "image",
    "z",
    "modes",
    "status",
    *(item.name for kind in (MaskGeometry, Calibration) for item in fields(kind)),
)


@dataclass(frozen=True)
class Checkpoint:
    """The .npz file to which a restoration writes its progress.

    path : name of the file
    fingerprint : hash of the frames, priors and settings to which it belongs
    """

    path: Path
    fingerprint: str

    @classmethod
    def of(
        cls,
        path: str | Path | None,
        objective: MyopicObjective,
        settings: Sequence[object],
        known: Sequence[Tensor | None],
    ) -> Checkpoint | None:
        """Return the file at `path`, if there is to be one, of a restoration with these settings.

        Raises ValueError if it could not be written there, or a setting cannot be known again.
        """
        if path is None:
            return None
        path = Path(path)
        if path.suffix != ".npz":
            raise ValueError(f"checkpoint is {path}, which does not end in .npz: give a name that does")
        if not path.parent.is_dir():
            raise ValueError(f"checkpoint is {path}, but there is no folder {path.parent}: create it first")
        return cls(path, fingerprint_of(objective, settings, known))

    def save(self, progress: Progress) -> None:
        """Write or replace the file."""
        arrays: dict[str, Any] = {name: getattr(progress, name) for name in ("costs", *_NUMBERS)}
        arrays |= {"n_candidates": progress.candidates.n_each, "fingerprint": self.fingerprint}
        arrays |= {"refinement": progress.refinement.name} | _ending_arrays("", progress.ending)
        if progress.rival is not None:
            arrays |= _ending_arrays("rival_", progress.rival)
        if progress.finer is not None:
            arrays |= _ending_arrays("finer_", Ending(progress.finer, progress.status))
        arrays["n_explained"] = len(progress.explained)
        for number, ending in enumerate(progress.explained):
            arrays |= _ending_arrays(f"explained{number}_", ending)
        save_npz(self.path, arrays, replace=True)

    def load(self, device: torch.device) -> Progress | None:
        """Read the file; None if there is none. Raises ValueError if it is damaged or has another fingerprint."""
        if not self.path.exists():
            return None
        stored = load_npz(self.path, required=("fingerprint",))
        if stored["fingerprint"].item() != self.fingerprint:
            raise ValueError(
                f"{self.path} is the checkpoint of other frames or settings, or of another version: give another name "
                "or delete it"
            )
        further = [prefix for prefix in ("rival_", "finer_") if any(name.startswith(prefix) for name in stored)]
        explained = [f"explained{number}_" for number in range(int(stored.get("n_explained", 0)))]
        needed = [prefix + name for prefix in ("", *further, *explained) for name in _NEEDED]
        needed += ["costs", "n_candidates", "n_explained", "refinement", *_NUMBERS]
        missing = [name for name in needed if name not in stored]
        if missing:
            raise ValueError(f"{self.path} has no {', '.join(missing)}: it is damaged, delete it to start again")
        now = _ending(stored, "", device)
        return Progress(
            Candidates(now.state, stored["n_candidates"].item()),
            np.atleast_1d(stored["costs"]).tolist(),
            status=now.status,
            decrease=now.decrease,
            rival=_ending(stored, "rival_", device) if "rival_" in further else None,
            finer=_ending(stored, "finer_", device).state if "finer_" in further else None,
            explained=tuple(_ending(stored, prefix, device) for prefix in explained),
            refinement=Refinement[stored["refinement"].item()],
            **{name: stored[name].item() for name in _NUMBERS},
        )


def save_nothing(progress: Progress) -> None:
    """Stand in for `Checkpoint.save` where no file is to be written."""


def _ending_arrays(prefix: str, ending: Ending) -> dict[str, Any]:
    state, calibration = ending.state, ending.state.calibration
    values: dict[str, Any] = {"image": state.image, "z": state.z}
    values |= {"modes": state.modes.name, "status": ending.status.name}
    # of the geometry the numbers themselves: those of its matrix would be rounded
    values |= {item.name: getattr(state.geometry, item.name) for item in fields(MaskGeometry)}
    values |= {item.name: getattr(calibration, item.name) for item in fields(Calibration)}
    if ending.decrease is not None:
        values["decrease"] = ending.decrease
    return {prefix + name: value for name, value in values.items()}


def _ending(stored: dict[str, np.ndarray], prefix: str, device: torch.device) -> Ending:
    def tensor(name: str) -> Tensor:
        return torch.from_numpy(stored[prefix + name]).to(device)

    weight = float(stored[prefix + "aberration_weight"])
    geometry = MaskGeometry(**{item.name: stored[prefix + item.name].item() for item in fields(MaskGeometry)})
    calibration = Calibration(tensor("transmission"), tensor("noise_inflation"), weight)
    decrease = stored.get(prefix + "decrease")
    status = Status[stored[prefix + "status"].item()]
    return Ending(
        State(tensor("image"), tensor("z"), calibration, geometry, Modes[stored[prefix + "modes"].item()]),
        status,
        None if decrease is None else float(decrease),
    )
