"""Random masks to begin a search from, and random changes to a good one."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from torchmask.design.merit import Holes

TURNS = 64  # orientations of which the one that breaks the rules least is taken


def random_mask(holes: Holes, rng: np.random.Generator) -> Tensor:
    """Draw the coordinates (F,) of a random mask, whose holes may overlap.

    Masks range from an even spread over the disc to a ring at the rim, radius = R u^a with a drawn for each mask, and
    half of them have nearly even angles. Good masks of many holes are uneven rings, which an even spread misses.
    """
    n = holes.template.n_subapertures
    radii = holes.radius * rng.random(n) ** rng.uniform(0, 0.5)
    angles = 2 * math.pi * rng.random(n)
    if rng.random() < 0.5:
        angles = 2 * math.pi / n * (np.arange(n) + rng.random() * rng.standard_normal(n))
    positions = torch.as_tensor(np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1), device="cpu")
    x = holes.subspace.origin.new_zeros(holes.subspace.size)
    for hole in range(n):
        x = holes.place(x, hole, positions[hole])
    return x


def changed_mask(holes: Holes, x: Tensor, rng: np.random.Generator) -> Tensor:
    """Return a start near the mask x (F,), with all holes moved slightly, or one or two moved anywhere.

    Where rules are not alike all around, the whole mask may be turned instead.
    """
    moved = int(rng.integers(3 + holes.orientation_matters))
    if moved == 0:
        return x + 0.03 * torch.as_tensor(rng.standard_normal(len(x)), device="cpu").to(x)
    if moved == 3:
        return turned_to_fit(holes, x, rng)
    n = holes.template.n_subapertures
    for hole in rng.choice(n, size=min(n, moved), replace=False):
        radius, angle = holes.radius * rng.random() ** rng.uniform(0, 0.5), 2 * math.pi * rng.random()
        place = [radius * math.cos(angle), radius * math.sin(angle)]
        # rounded to float32, whatever the default: a seed keeps its result
        x = holes.place(x, int(hole), torch.tensor(place, dtype=torch.float32, device="cpu"))
    return x


def turned_to_fit(holes: Holes, x: Tensor, rng: np.random.Generator) -> Tensor:
    """Return the mask x (F,) turned by one of a few random angles, or over, which breaks the rules least.

    A descent does not turn a mask past a vane, and to most criteria its orientation does not matter.
    """
    turn, over = torch.as_tensor(rng.random((TURNS, 2)), device="cpu").T.to(x)
    turns = holes.turned(x, 2 * math.pi * turn, (over < 0.5) & holes.may_be_mirrored)
    shortfall = holes.margins(holes.aperture(turns)).clamp(max=0)
    return turns[int((shortfall**2).sum(-1).argmin())]
