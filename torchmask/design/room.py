"""Search for a first mask that satisfies all constraints, and advice if there is none."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from torchmask.design.constraint_base import Constraint, Inequality, Infeasible, require_constraints
from torchmask.design.constraints import InsideDisc, KeepOutDisc, MinimumGap, NoOverlap, RimMargin
from torchmask.design.descent import BatchedBFGS
from torchmask.design.merit import Holes
from torchmask.design.starts import random_mask
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.packing import certain_number, hole_diameter, largest_number
from torchmask.record import Callback, Record

_STARTS = 16
_ROUNDS = 150
_BISECTIONS = 14
_SPECK = 1e-4  # smallest fraction of a request that is tried; if even that fails, the request is not the obstacle
# How much wider cells, of a hole and its gap, must be for a search to find room: not at all for up to 20 holes, whose
# best packings are known; beyond, the bound on their number is more than any packing reaches.
_SPARE = 1.0, 1.1
_WELL_PACKED = 20
_NEAR = 1e-7  # sum of squared shortfalls from which a projection is tried, in mask diameters


def require_room(
    n_subapertures: int,
    mask_diameter: float,
    fill_factor: float,
    constraints: Sequence[Constraint],
    callback: Callback | None = None,
    narrowest: float = 0.0,
) -> tuple[Holes, SparseAperture]:
    """Return the holes of a request with all their constraints, and a first mask that satisfies them.

    Requests that no packing can satisfy are refused at once. Others are tried, with preparatory records for `callback`.
    Holes below the `narrowest` diameter [m] are not proposed instead.

    Raises
    ------
    ValueError
        If the holes cannot be packed; the message says how many could, and at which fill factor. If no mask that
        satisfies `constraints` is found; the message gives the largest fill factor at which one was or, failing that,
        the values of single constraints at which one was.
    TypeError
        If `constraints` is not a sequence of constraints.
    """
    hole_diameter(n_subapertures, mask_diameter, fill_factor)
    require_constraints(constraints)
    least_fill = n_subapertures * (narrowest / mask_diameter) ** 2
    _require_area(n_subapertures, mask_diameter, fill_factor, constraints, least_fill)
    rng = np.random.default_rng(0)
    holes = _holes(n_subapertures, mask_diameter, fill_factor, constraints)
    trials = _Trials(callback)
    try:
        return holes, _first_mask(holes, rng, trials)
    except Infeasible:
        pass

    def fits(fill: float, rules: Sequence[Constraint]) -> bool:
        try:
            _first_mask(_holes(n_subapertures, mask_diameter, fill, rules), rng, trials)
        except Infeasible:
            return False
        return True

    rules = ", ".join(map(str, constraints)) or "the mask disc"
    raise Infeasible(
        f"no mask of {count_holes(n_subapertures)} with fill_factor {fill_factor} was found that obeys {rules}; "
        f"{_advice(fits, fill_factor, list(constraints), least_fill)}"
    )


def count_holes(number: int) -> str:
    """Return "1 hole", "2 holes" and so on."""
    return f"{number} hole{'s' * (number != 1)}"


def _require_area(
    n: int, mask_diameter: float, fill_factor: float, constraints: Sequence[Constraint], least_fill: float
) -> None:
    """Raise `Infeasible` if there is too little area for N holes with their gaps beside the largest keep-out disc.

    Holes enlarged by half a gap all around do not overlap, and lie in a mask enlarged by half a gap all around. Holes
    that would fit into the keep-out disc, reduced by half a gap all around, are lost. What is proposed instead has
    some area to spare, as a search needs, and a fill factor above `least_fill`.
    """
    width = mask_diameter - 2 * max((rule.margin for rule in constraints if isinstance(rule, RimMargin)), default=0.0)
    gap = max((rule.gap for rule in constraints if isinstance(rule, MinimumGap)), default=0.0)
    zones = [rule for rule in constraints if isinstance(rule, KeepOutDisc)]
    zones = [zone for zone in zones if math.hypot(*zone.center) + zone.diameter / 2 <= width / 2]
    blocked = max((zone.diameter for zone in zones), default=0.0)

    def most(hole: float, gap: float) -> int:
        """Return an upper limit on the number of holes of this diameter [m]."""
        cell = hole + gap
        return largest_number(max(0.0, width + gap) / cell) - certain_number(max(0.0, blocked - gap) / cell)

    hole = mask_diameter * math.sqrt(fill_factor / n)
    if n <= most(hole, gap):
        return

    def has_room(number: int, fill: float, gap: float) -> bool:
        cell = (mask_diameter * math.sqrt(fill / number) + gap) * _SPARE[number > _WELL_PACKED]
        return number <= most(cell - gap, gap)

    fewer = next((number for number in range(n - 1, 0, -1) if has_room(number, fill_factor, gap)), 0)
    smaller = _largest(lambda fill: has_room(n, fill, gap), fill_factor)
    closer = _largest(lambda gap: has_room(n, fill_factor, gap), gap) if gap else 0.0
    advice = [f"n_subapertures of at most {fewer} at this fill factor"] if fewer else []
    advice += [f"a fill_factor of at most {smaller:.4g} for {count_holes(n)}"] if smaller > least_fill else []
    advice += [f"a MinimumGap gap of at most {closer:.4g} m"] if closer else []
    beside = f" beside a keep-out disc of {blocked:.4g} m" if blocked else ""
    apart = f" with gaps of {gap:.4g} m" if gap else ""
    raise Infeasible(
        f"{count_holes(n)} of {hole:.4g} m (fill_factor {fill_factor:.4g}){apart} cannot fit into a disc of "
        f"{width:.4g} m{beside}, whose area holds {most(hole, gap)} at most; it may have room for "
        f"{' or '.join(advice) or 'none of them: ask for a smaller keep-out disc or rim margin'}"
    )


class _Trials:
    """Tells the callback how far the search for a first mask is; a failure costs `_BISECTIONS` trials more at least."""

    def __init__(self, callback: Callback | None) -> None:
        self.callback = callback
        self.rounds = 0

    def tell(self, shortfall: float) -> None:
        """Count one more round of a trial, and report it; `shortfall` is in mask diameters."""
        self.rounds += 1
        if self.callback is not None:
            first = self.rounds <= _ROUNDS
            budget = _ROUNDS if first else _ROUNDS * max(1 + _BISECTIONS, math.ceil(self.rounds / _ROUNDS))
            scalars = {"shortfall": shortfall}
            self.callback(Record("design/room", self.rounds, budget, scalars, preparatory=True))


def _advice(
    fits: Callable[[float, Sequence[Constraint]], bool],
    fill_factor: float,
    constraints: list[Constraint],
    least_fill: float,
) -> str:
    """Return what to ask for instead: smaller holes or, if even tiny ones do not fit, less of one rule."""
    largest = _largest(lambda fill: fits(fill, constraints), fill_factor)
    if largest > 0:
        found = f"the largest fill factor at which one was found is {largest:.4g}"
        narrow = ", where holes are narrower than a sample of the criterion's frequencies: take fewer holes"
        return found + narrow * (largest < least_fill)
    eased = []
    for index, rule in enumerate(constraints):
        if not isinstance(rule, Inequality) or rule.length is None or getattr(rule, rule.length) == 0:
            continue

        def with_length(value: float, rule: Any = rule, index: int = index) -> list[Constraint]:
            return [*constraints[:index], replace(rule, **{rule.length: value}), *constraints[index + 1 :]]

        largest = _largest(lambda value, at=with_length: fits(fill_factor, at(value)), getattr(rule, rule.length))
        if largest > 0:
            eased.append(f"with a {type(rule).__name__} {rule.length} of at most {largest:.4g} m one was found")
    return " and ".join(eased) or "nor with much smaller holes: the rules leave no room"


def _largest(fits: Callable[[float], bool], limit: float) -> float:
    """Return the largest value below `limit` that was found to fit, by bisection; 0 if not even a tiny one fits."""
    largest, fails = 0.0, limit
    trial = _SPECK * limit
    for _ in range(_BISECTIONS):
        if fits(trial):
            largest = trial
        elif largest == 0:
            return 0.0
        else:
            fails = trial
        trial = (largest + fails) / 2
    # Rounded down, so that the stated value fits.
    digit = 10.0 ** (math.floor(math.log10(largest)) - 3)
    return math.floor(largest / digit) * digit


def _holes(n: int, mask_diameter: float, fill_factor: float, constraints: Sequence[Constraint]) -> Holes:
    diameter = hole_diameter(n, mask_diameter, fill_factor)
    template = SparseAperture(torch.zeros(n, 2, dtype=torch.float64, device="cpu"), diameter, mask_diameter)
    return Holes(template, (InsideDisc(), NoOverlap(), *constraints))


def _first_mask(holes: Holes, rng: np.random.Generator, trials: _Trials) -> SparseAperture:
    """Minimise the squared shortfalls from random masks, and return the first mask that can be projected."""
    if not any(not isinstance(c, (InsideDisc, NoOverlap)) for c in holes.constraints):
        template = holes.template
        generator = torch.Generator().manual_seed(int(rng.integers(2**62)))
        size = template.n_subapertures, template.mask_diameter, template.fill_factor
        with template.centers.device:
            return SparseAperture.random(*size, generator)
    descent = BatchedBFGS(torch.stack([random_mask(holes, rng) for _ in range(_STARTS)]), 0.1, 1e-16)
    for _ in range(_ROUNDS):
        x = descent.ask().requires_grad_()
        shortfall = (holes.margins(holes.aperture(x)).clamp(max=0) ** 2).sum(-1)
        (gradient,) = torch.autograd.grad(shortfall.sum(), x)
        descent.tell(shortfall.detach(), gradient)
        trials.tell(float(descent.values.min()) ** 0.5)
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
