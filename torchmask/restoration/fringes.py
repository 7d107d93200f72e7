"""A way out of local minima in a band: pistons that are whole waves off.

Frames of one wavelength do not show whole waves of piston; those of several do, by the contrast of their fringes. A
descent does not move a hole, or a part of the mask, from one fringe to the next: the contrast is worse in between. Most
often all holes on one side of a line are a wave off against the others, as if the mask were tilted. For a fixed object
the frames are separate problems, so all these changes are tried, and each frame takes the one that suits it best, as
long as there is one. An object that is still to be found may be wrong by parts of a wave, and is held there by the
fringes that suit it: where frames tell them, `group_delays` are the remedy.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import State

_ASIDE = 1e-6  # angle to both sides of the direction in which two holes are level [rad]


@torch.no_grad()
def change_fringes(objective: MyopicObjective, state: State) -> tuple[State, int]:
    """Return the state after all changes by a wave that lower the cost of a frame, and the evaluations of all frames.

    It is `state` itself if no change does, or if the frames are of one wavelength, or of one aperture.
    """
    model, basis = objective.model, objective.model.aberrations
    if len(model.band.wavelengths) == 1 or basis.n_subapertures == 1:
        return state, 0
    wave = 2 * math.pi * model.band.mean / model.window.grid.wavelength  # [rad] at the wavelength of the grid
    changes = basis.parameters_of_pistons(wave * sides_of_lines(model.pupil.aperture.centers).double()).to(state.z)
    z, tried = state.z.clone(), 0
    moving = torch.arange(len(z), device=z.device)
    while len(moving):
        part, calibration = objective.of_frames(moving), state.calibration.of_frames(moving)
        best = now = z[moving]
        least = first = part.frame_costs(state.image, now, calibration)
        for change in torch.cat([changes, -changes]):
            trial = now + change
            cost = part.frame_costs(state.image, trial, calibration)
            best, least = torch.where((cost < least)[:, None], trial, best), torch.minimum(cost, least)
        tried += (2 * len(changes) + 1) * len(moving)
        z[moving] = best
        moving = moving[least < first]
    return (state if torch.equal(z, state.z) else replace(state, z=z)), tried // len(z)


def sides_of_lines(centers: Tensor) -> Tensor:
    """Return the sets (S, N) of holes, true or false, that a line can divide from the others, and each hole alone.

    Each division is there once, as the side that does not hold the first hole; `centers` is (N, 2) [m].
    """
    points = centers.detach().double().cpu()
    first, second = torch.triu_indices(len(points), len(points), 1, device="cpu")
    apart = points[second] - points[first]
    level = torch.atan2(apart[:, 1], apart[:, 0]) + math.pi / 2  # directions along which these two are level
    angles = torch.cat([level - _ASIDE, level + _ASIDE])
    order = (torch.stack([angles.cos(), angles.sin()], 1) @ points.T).argsort(dim=1)
    ranks = order.argsort(dim=1)
    below = torch.cat([ranks < n for n in range(1, len(points))])  # the n holes that lie furthest back
    sides = torch.cat([below, torch.eye(len(points), dtype=torch.bool, device="cpu")])
    return torch.unique(sides ^ sides[:, :1], dim=0)
