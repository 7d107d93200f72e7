"""Rules on masks: margins from geometry, penalties that autograd follows, projections that obey."""

import math

import pytest
import torch

from torchmask.design.constraints import (
    FixedHoles,
    InsideDisc,
    KeepOutDisc,
    KeepOutSegment,
    MinimumGap,
    NFoldSymmetry,
    NonRedundancy,
    NoOverlap,
    check,
)
from torchmask.optics.aperture import SparseAperture

RULES = [
    InsideDisc(),
    NoOverlap(),
    MinimumGap(0.02),
    KeepOutDisc(0.2, (0.05, 0.0)),
    KeepOutSegment((0.0, 0.0), (0.5, 0.1), 0.03),
    NonRedundancy(0.05),
    FixedHoles([(0.1, 0.3)], indices=[2]),
    NFoldSymmetry(3),
]


def mask(centers, diameter=0.1, shape="disc"):
    return SparseAperture(torch.as_tensor(centers, dtype=torch.float64), diameter, 1.0, shape)


@pytest.mark.parametrize(
    ("rule", "centers", "expected"),
    [
        (InsideDisc(), [[0.46, 0.0], [0.0, 0.2]], 0.01),  # outer edge at 0.51
        (NoOverlap(), [[0.0, 0.0], [0.06, 0.0]], 0.04),
        (MinimumGap(0.02), [[0.0, 0.0], [0.0, 0.11]], 0.01),
        (KeepOutDisc(0.2), [[0.12, 0.0], [0.3, 0.3]], 0.03),  # nearest edge at 0.07, zone to 0.1
        (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.2, 0.05], [0.2, 0.3]], 0.01),
        (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.43, 0.04], [0.2, 0.3]], 0.01),  # beyond its end: 3-4-5
        (NonRedundancy(0.05), [[-0.2, 0.0], [0.0, 0.0], [0.22, 0.0]], 0.03),  # baselines 0.20 and 0.22
        (FixedHoles([(0.1, 0.3)]), [[0.1, 0.32], [0.0, 0.0]], 0.02),
        (NFoldSymmetry(2), [[0.2, 0.0], [-0.2, 0.03]], 0.03),
    ],
)
def test_violation_is_the_geometric_shortfall(rule, centers, expected):
    assert float(rule.violation(mask(centers))) == pytest.approx(expected, rel=1e-12)
    assert float(rule.penalty(mask(centers))) >= expected**2 * (1 - 1e-12)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_penalty_gradient_also_for_coincident_and_central_holes(rule):
    generator = torch.Generator().manual_seed(0)
    scattered = 0.5 * torch.rand(6, 2, generator=generator, dtype=torch.float64) - 0.25
    assert torch.autograd.gradcheck(lambda c: rule.penalty(mask(c)), scattered.requires_grad_())
    degenerate = torch.zeros(6, 2, dtype=torch.float64, requires_grad=True)
    rule.penalty(mask(degenerate)).backward()
    assert degenerate.grad is not None
    assert bool(torch.isfinite(degenerate.grad).all())


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: type(rule).__name__)
def test_projection_obeys_and_leaves_what_obeys(rule):
    # outside the disc, overlapping, redundant, on the zones and not symmetric, all at once
    start = mask([[0.47, 0.2], [0.4, 0.25], [0.06, 0.01], [0.02, 0.03], [-0.3, -0.3], [0.2, 0.05]])
    assert float(rule.violation(start)) > 0
    once = rule.project(start)
    assert float(rule.violation(once)) < 1e-9
    again = rule.project(once)
    assert (again.centers - once.centers).abs().max() < 1e-8


def test_population_is_treated_member_by_member():
    generator = torch.Generator().manual_seed(2)
    centers = torch.rand(4, 6, 2, generator=generator, dtype=torch.float64) - 0.5
    for rule in RULES:
        together = rule.penalty(mask(centers))
        assert together.shape == (4,)
        alone = torch.stack([rule.penalty(mask(c)) for c in centers])
        torch.testing.assert_close(together, alone, rtol=1e-12, atol=1e-15)


def test_hexagons_touch_side_by_side():
    angle = math.pi / 6  # of the line between the centres: a corner direction, where hexagons reach further
    beside = mask([[0.0, 0.0], [0.1, 0.0]], shape="hexagon")
    assert float(NoOverlap().violation(beside)) < 1e-15
    corner = mask([[0.0, 0.0], [0.1 * math.cos(angle), 0.1 * math.sin(angle)]], shape="hexagon")
    assert float(NoOverlap().violation(corner)) == pytest.approx(0.1 * (1 - math.cos(angle)), rel=1e-12)


def test_check_names_the_rule_and_the_amount():
    check(mask([[-0.4, 0.0], [0.4, 0.0]]))
    with pytest.raises(ValueError, match=r"InsideDisc.*0\.01 m"):
        check(mask([[0.46, 0.0], [0.0, 0.0]]))
    with pytest.raises(ValueError, match="KeepOutDisc"):
        check(mask([[0.1, 0.0], [0.4, 0.0]]), constraints=[KeepOutDisc(0.2)])


@pytest.mark.parametrize(
    "make",
    [
        lambda: MinimumGap(-0.1),
        lambda: KeepOutDisc(0.0),
        lambda: KeepOutDisc(0.1, (math.nan, 0.0)),
        lambda: KeepOutSegment((0.0, 0.0), (0.0, 0.0), 0.1),
        lambda: KeepOutSegment((0.0, 0.0), (0.1, 0.0), -0.1),
        lambda: NonRedundancy(0.0),
        lambda: FixedHoles([(0.0, 0.0)], indices=[0, 1]),
        lambda: NFoldSymmetry(1),
        lambda: NFoldSymmetry(3).penalty(mask([[0.1, 0.0], [0.2, 0.0], [0.3, 0], [0, 0.1], [0, 0.3]])),
    ],
)
def test_impossible_rules_are_refused(make):
    with pytest.raises(ValueError, match=r"must|cannot|KeepOutDisc"):
        make()
