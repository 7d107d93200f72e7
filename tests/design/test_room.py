"""Requests without room: refused with the largest value that fits, which is known in closed form."""

import math

import pytest
import torch

from torchmask.design.constraint_base import project
from torchmask.design.constraints import FixedHoles, KeepOutDisc, MinimumGap, NFoldSymmetry, RimMargin, check_mask
from torchmask.design.refine import refine_mask
from torchmask.design.room import require_room
from torchmask.optics.aperture import SparseAperture

HOLE = math.sqrt(0.15 / 3)  # of three holes with a fill factor of 0.15 in a disc of 1 m
MASK = SparseAperture(torch.tensor([[0.0, 0.3], [0.3, 0.0]]), 0.1, 1.0)


@pytest.mark.parametrize(
    ("rule", "stated", "largest"),
    [
        # Between the keep-out disc and the rim the holes are (1 - 0.7) / 2 wide at most.
        (KeepOutDisc(0.7), "fill factor at which one was found is", 3 * 0.15**2),
        # Holes of any size are in the way: the disc may reach to the inner edge of those at the rim.
        (KeepOutDisc(1.5), "KeepOutDisc diameter of at most", 1 - 2 * HOLE),
        # A triangle at the rim.
        (MinimumGap(1.0), "MinimumGap gap of at most", math.sqrt(3) * (1 - HOLE) / 2 - HOLE),
    ],
)
def test_the_largest_value_that_fits_is_stated(rule, stated, largest):
    with pytest.raises(ValueError, match=rf"{stated} \d") as refusal:
        require_room(3, 1.0, 0.15, [rule])
    value = float(str(refusal.value).split(stated)[1].split()[0])
    assert 0.99 * largest < value <= largest
    if "fill factor" in stated:
        found = require_room(3, 1.0, value, [rule])[1]
        check_mask(found, 1e-9, [rule])


def test_where_no_size_helps_the_rules_are_named():
    rules = [FixedHoles([(0.0, 0.0)]), KeepOutDisc(0.2)]
    with pytest.raises(ValueError, match=r"FixedHoles.*KeepOutDisc.*the rules leave no room"):
        require_room(6, 1.0, 0.15, rules)
    with pytest.raises(ValueError, match="4-fold symmetric"):
        require_room(6, 1.0, 0.15, [NFoldSymmetry(4)])
    with pytest.raises(ValueError, match=r"at most 0\.66"):
        require_room(6, 1.0, 0.9, [])


@pytest.mark.parametrize("constraints", [KeepOutDisc(0.2), [0.2], None])
def test_what_is_no_list_of_rules_is_refused(constraints):
    for call in (
        lambda: require_room(6, 1.0, 0.15, constraints),
        lambda: check_mask(MASK, constraints=constraints),
        lambda: project(MASK, constraints),
        lambda: refine_mask(lambda mask: mask.centers.sum(), MASK, constraints=constraints),
    ):
        with pytest.raises(TypeError, match="a list of constraints is needed"):
            call()


def test_what_no_area_can_hold_is_refused_at_once():
    """The number that is proposed has room, at 0.8 of Oler's inequality, worked out here for the centres."""
    told = []
    with pytest.raises(ValueError, match=r"300 holes of 0\.1834 m.*gaps of 0\.5 m.*at most \d+ at") as refusal:
        require_room(300, 8.2, 0.15, [MinimumGap(0.5)], callback=told.append)
    assert not told  # not a single trial
    stated = int(str(refusal.value).split("of at most ")[1].split()[0])
    # Oler: N points at distances of at least t in a disc of radius R; N at this fill factor sets both
    hole = 8.2 * math.sqrt(0.15 / stated)
    radius, apart = (8.2 - hole) / 2, hole + 0.5
    most = 2 / math.sqrt(3) * math.pi * (radius / apart) ** 2 + math.pi * radius / apart + 1
    assert 0.75 * most < stated < 0.85 * most
    check_mask(require_room(stated, 8.2, 0.15, [MinimumGap(0.5)])[1], 1e-9, [MinimumGap(0.5)])


def test_holes_too_narrow_for_the_criterion_are_not_proposed():
    """A hundred holes with such gaps would have to be narrow; at most that many of them are named otherwise."""
    request, rules = (100, 1.0, 0.3), [MinimumGap(0.05)]
    with pytest.raises(ValueError, match="a fill_factor of at most"):
        require_room(*request, rules)
    with pytest.raises(ValueError, match="n_subapertures of at most") as refusal:
        require_room(*request, rules, narrowest=0.054)
    assert "fill_factor of at most" not in str(refusal.value)
    with pytest.raises(ValueError, match=r"where holes are narrower than a sample .* take fewer holes"):
        require_room(3, 1.0, 0.15, [KeepOutDisc(0.7)], narrowest=0.2)


@pytest.mark.parametrize(
    ("n", "gap", "obstruction", "largest"),
    [
        # Seven equal discs around one in the middle: with their gaps three to a diameter of 1 + gap.
        (7, 0.1, 0.0, 7 * ((1 + 0.1) / 3 - 0.1) ** 2),
        # The middle one stands in a keep-out disc that is a gap wider than it is all around: six are left.
        (6, 0.1, (1 + 0.1) / 3 + 0.1, 6 * ((1 + 0.1) / 3 - 0.1) ** 2),
    ],
)
def test_the_bound_is_where_the_best_packing_is(n, gap, obstruction, largest):
    """From both sides: a mask is found just below, and the refusal just above names the largest fill factor."""
    rules = [MinimumGap(gap)] + ([KeepOutDisc(obstruction - 0.005)] if obstruction else [])
    check_mask(require_room(n, 1.0, 0.98 * largest, rules)[1], 1e-9, rules)
    rules = [MinimumGap(gap)] + ([KeepOutDisc(obstruction + 0.005)] if obstruction else [])
    told = []
    with pytest.raises(ValueError, match="a fill_factor of at most") as refusal:
        require_room(n, 1.0, 1.01 * largest, rules, callback=told.append)
    assert not told
    stated = float(str(refusal.value).split("a fill_factor of at most ")[1].split()[0])
    assert 0.999 * largest < stated <= largest


def test_a_rim_margin_is_lost_on_either_side():
    """Seven equal discs fit three to a diameter, of what the margins leave: found just below, refused just above."""
    largest, rules, told = 7 * (0.8 / 3) ** 2, [RimMargin(0.1)], []
    check_mask(require_room(7, 1.0, 0.98 * largest, rules)[1], 1e-9, rules)
    with pytest.raises(ValueError, match=r"cannot fit into a disc of 0\.8 m, whose area holds 5 at most") as refusal:
        require_room(7, 1.0, 1.01 * largest, rules, callback=told.append)
    assert not told
    stated = float(str(refusal.value).split("a fill_factor of at most ")[1].split()[0])
    assert 0.999 * largest < stated <= largest


def test_trials_that_take_long_are_told_of():
    told = []
    with pytest.raises(ValueError, match="fill factor at which one was found"):
        require_room(3, 1.0, 0.15, [KeepOutDisc(0.7)], callback=told.append)
    assert [record.step for record in told] == list(range(1, len(told) + 1))
    assert all(record.preparatory and record.step <= record.n_steps for record in told)
    assert told[-1].scalars["shortfall"] >= 0
