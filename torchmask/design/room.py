"""Is there a mask at all that obeys the rules, and if not, how large may its holes be?"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.descent import BatchedBFGS
from torchmask.design.feasibility import Constraint, Infeasible
from torchmask.design.merit import Holes
from torchmask.design.starts import random_mask
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import hole_diameter

_STARTS = 16
_ROUNDS = 150
_BISECTIONS = 14
_SPECK = 1e-4  # of the fill factor: where no mask of such holes is found, size is not what hinders
_NEAR = 1e-7  # sum of squared shortfalls from which a projection is tried, in mask diameters


def require_room(
    n_subapertures: int, mask_diameter: float, fill_factor: float, constraints: Sequence[Constraint], seed: int = 0
) -> tuple[Holes, SparseAperture]:
    """The holes of a request with all their rules, and a first mask that obeys them.

    Raises
    ------
    ValueError
        If the holes cannot be packed, or no mask that obeys `constraints` is found: says the largest fill factor at
        which one was.
    """
    hole_diameter(n_subapertures, mask_diameter, fill_factor)
    rng = np.random.default_rng(seed)
    holes = _holes(n_subapertures, mask_diameter, fill_factor, constraints)
    try:
        return holes, _first_mask(holes, rng)
    except Infeasible:
        largest = _largest_found(n_subapertures, mask_diameter, fill_factor, constraints, rng)
    rules = ", ".join(map(str, constraints)) or "the mask disc"
    advice = (
        f"the largest fill factor at which one was found is {largest:.4g}"
        if largest > 0
        else f"nor with holes of {_SPECK:g} of that: the rules leave no room"
    )
    raise Infeasible(
        f"no mask of {n_subapertures} holes with fill_factor {fill_factor} was found that obeys {rules}; {advice}"
    )


def _largest_found(
    n: int, mask_diameter: float, fill_factor: float, constraints: Sequence[Constraint], rng: np.random.Generator
) -> float:
    """The largest fill factor below `fill_factor` at which a mask was found, by bisection; 0 if there is none."""
    fits, fails = 0.0, fill_factor
    trial = _SPECK * fill_factor
    for _ in range(_BISECTIONS):
        try:
            _first_mask(_holes(n, mask_diameter, trial, constraints), rng)
            fits = trial
        except Infeasible:
            if fits == 0:
                return 0.0
            fails = trial
        trial = (fits + fails) / 2
    # rounded down, so that the value that is stated fits
    digit = 10.0 ** (math.floor(math.log10(fits)) - 3)
    return math.floor(fits / digit) * digit


def _holes(n: int, mask_diameter: float, fill_factor: float, constraints: Sequence[Constraint]) -> Holes:
    diameter = hole_diameter(n, mask_diameter, fill_factor)
    template = SparseAperture(torch.zeros(n, 2, dtype=torch.float64), diameter, mask_diameter)
    return Holes(template, (InsideDisc(), NoOverlap(), *constraints))


def _first_mask(holes: Holes, rng: np.random.Generator) -> SparseAperture:
    """Descend from random masks on the squared shortfalls alone; the first that can be projected is taken."""
    if not any(not isinstance(c, (InsideDisc, NoOverlap)) for c in holes.constraints):
        template = holes.template
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        return SparseAperture.random(
            template.n_subapertures, template.mask_diameter, template.fill_factor, generator=generator
        )
    descent = BatchedBFGS(torch.stack([random_mask(holes, rng) for _ in range(_STARTS)]), 0.1, 1e-16)
    for _ in range(_ROUNDS):
        x = descent.ask().requires_grad_()
        shortfall = (holes.margins(holes.aperture(x)).clamp(max=0) ** 2).sum(-1)
        (gradient,) = torch.autograd.grad(shortfall.sum(), x)
        descent.tell(shortfall.detach(), gradient)
        if bool((descent.values < 1e-16).any()):
            break
    failure = Infeasible("no descent on the shortfalls came near zero")
    for index in descent.values.argsort()[:3].tolist():
        if descent.values[index] < _NEAR:
            try:
                return holes.feasible(descent.points[index])
            except Infeasible as error:
                failure = error
    raise failure
