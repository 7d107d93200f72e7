"""A new start of a mask from its best object, heated: its aberrations wander in more noise, which then falls again.

A descent goes straight into the nearest minimum, and an object of gentle slopes shows so little at long baselines that
many are near. In noise of ten times its variance the frames hold neither the aberrations nor, against its prior, the
object as tightly, so that samples of the aberrations, with the object that suits them, leave a poor minimum; as the
noise falls back they settle in one that is wider, and mostly deeper. This is deterministic annealing (Ueda & Nakano,
Neural Netw. 11, 271, 1998) with samples in place of expectations.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchmask.record import Callback, Record
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.sampler import sample_rounds
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State


def temper(
    objective: MyopicObjective, state: State, schedule: Schedule, seed: int, callback: Callback | None = None
) -> tuple[State, int]:
    """Return the state after the noise has fallen from `schedule.heat` times its variance, and the evaluations.

    The callback is called with a `Record` after every round.
    """
    rounds, base = schedule.cooling, state.calibration
    heats = (schedule.heat ** (1 - number / max(rounds - 1, 1)) for number in range(rounds))
    sampled = sample_rounds(objective, state, heats, schedule, torch.Generator().manual_seed(seed), follow_r0=False)
    for number, (heated, accepted) in enumerate(sampled):
        state = heated
        if callback is not None:
            callback(Record("heated start", number + 1, rounds, {"accepted": accepted}, {}))
    return replace(state, calibration=base), rounds * (schedule.moves + 2)
