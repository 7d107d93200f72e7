"""New starts of a mask from its object's twins: other pistons of its holes, the same in all frames.

The fringes of a mask fix each frame's pistons only up to a set of pistons common to all frames, which the phases of the
object can take over: if every baseline were a point, the frames could not tell the two apart. That its baselines have a
width, and that the object is positive and compact, decides between these twins, but a descent that has sharpened the
wrong one does not leave it, and one from other aberrations of each frame often finds it again. Between the twins there
is nothing to search but the common pistons, so a new start keeps what each frame has found and draws them anew. From
there a descent also leaves objects that are wrong otherwise, and that a descent under high noise alone finds again.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch

from torchmask.restoration.escapes import settle
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import State

_SETTLING = 60  # iterations that fit an object to the new pistons, before the aberrations move too


def twin_of(objective: MyopicObjective, state: State, inflation: float, seed: int) -> State:
    """Return the state with pistons drawn anew, alike in all frames, and the blurred object that suits them.

    `inflation` is the noise inflation with which the new descent begins.
    """
    basis = objective.model.aberrations
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(basis.n_subapertures, dtype=torch.float64, device="cpu", generator=generator)
    pistons = math.pi * (2 * uniform - 1)
    z = state.z + basis.parameters_of_pistons(pistons).to(state.z)
    return settle(objective, replace(state, z=z).with_noise_inflation(inflation), _SETTLING)
