"""Rules on holes: penalty, violation and projection against hand-made masks, and the way back to feasible ones."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.design.constraint_base import Infeasible, Subspace, project
from torchmask.design.constraints import (
    FixedHoles,
    InsideDisc,
    KeepOutDisc,
    KeepOutSegment,
    MinimumGap,
    NFoldSymmetry,
    NonRedundancy,
    NoOverlap,
    check_mask,
)
from torchmask.design.rules import MaskRules
from torchmask.design.space import DesignSpace
from torchmask.optics.aperture import SparseAperture

INEQUALITIES = [
    InsideDisc(),
    NoOverlap(),
    MinimumGap(0.05),
    KeepOutDisc(0.4),
    KeepOutDisc(0.2, center=(0.1, -0.2)),
    KeepOutSegment((0.0, 0.0), (0.5, 0.0), 0.03),
    NonRedundancy(0.06),
]
EQUALITIES = [FixedHoles([(0.1, 0.2), (-0.3, 0.0)]), NFoldSymmetry(3), NFoldSymmetry(2)]


def mask(centers, diameter=0.1, shape="disc", orientation=0.0):
    return SparseAperture(torch.as_tensor(centers, dtype=torch.float64), diameter, 1.0, shape, orientation)


def thrown(n, seed, diameter=0.1, spread=0.9):
    generator = torch.Generator().manual_seed(seed)
    return mask(spread * (torch.rand(n, 2, generator=generator, dtype=torch.float64) - 0.5), diameter)


@pytest.mark.parametrize(
    ("constraint", "centers", "violation"),
    [
        (InsideDisc(), [[0.45, 0.0]], 0.0),
        (InsideDisc(), [[0.3, 0.4]], 0.05),
        (NoOverlap(), [[0.0, 0.0], [0.1, 0.0], [0.3, 0.0]], 0.0),
        (NoOverlap(), [[0.0, 0.0], [0.06, 0.0], [0.0, 0.08]], 0.04),
        (NoOverlap(), [[0.1, 0.2], [0.1, 0.2]], 0.1),
        (MinimumGap(0.02), [[0.0, 0.0], [0.11, 0.0]], 0.01),
        (KeepOutDisc(0.3), [[0.2, 0.0], [0.0, 0.17]], 0.03),
        (KeepOutDisc(0.3, (0.2, 0.0)), [[0.2, 0.0]], 0.2),
        (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.2, 0.05], [0.45, 0.0]], 0.01),
        (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.2, 0.0]], 0.06),
        # beyond the end the distance is that to the end point
        (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.43, 0.04]], 0.01),
        # equal spacing: the baselines 0-1 and 1-2 coincide
        (NonRedundancy(0.06), [[-0.2, 0.0], [0.0, 0.0], [0.2, 0.0]], 0.06),
        (NonRedundancy(0.06), [[-0.2, 0.0], [0.0, 0.0], [0.25, 0.0]], 0.01),
        # two baselines that differ only in sign are the same frequency
        (NonRedundancy(0.06), [[0.0, 0.0], [0.2, 0.0], [0.0, 0.3], [0.21, 0.3]], 0.05),
        (FixedHoles([(0.1, 0.2)]), [[0.1, 0.17], [0.4, 0.0]], 0.03),
        (FixedHoles([(0.1, 0.2)], indices=[1]), [[0.4, 0.0], [0.1, 0.2]], 0.0),
        (NFoldSymmetry(2), [[0.1, 0.2], [-0.1, -0.2]], 0.0),
        (NFoldSymmetry(2), [[0.1, 0.2], [-0.1, -0.2], [0.0, 0.03]], 0.03),
        (NFoldSymmetry(4), [[0.3, 0.1], [-0.1, 0.3], [-0.3, -0.1], [0.1, -0.3]], 0.0),
    ],
)
def test_violation_by_hand(constraint, centers, violation):
    aperture = mask(centers)
    assert float(constraint.violation(aperture)) == pytest.approx(violation, abs=1e-12)
    penalty = float(constraint.penalty(aperture))
    assert (penalty > 1e-20) == (violation > 0)
    assert penalty >= violation**2 * (1 - 1e-9)


def test_hexagons_touch_side_to_side_and_corner_to_rim():
    side_by_side = mask([[0.0, 0.0], [0.1, 0.0]], shape="hexagon")
    assert float(NoOverlap().violation(side_by_side)) == pytest.approx(0, abs=1e-15)
    # turned by 30 degrees they meet at corners, 2/sqrt(3) d apart
    corner_to_corner = mask([[0.0, 0.0], [0.1, 0.0]], shape="hexagon", orientation=math.pi / 6)
    assert float(NoOverlap().violation(corner_to_corner)) == pytest.approx(0.1 * (1 - math.sqrt(3) / 2), rel=1e-9)
    corner = 0.1 / math.sqrt(3)
    touching = mask([[0.0, 0.5 - corner]], shape="hexagon")
    assert float(InsideDisc().margins(touching)) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("constraint", INEQUALITIES + EQUALITIES, ids=str)
@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_penalty_gradient(constraint, shape):
    generator = torch.Generator().manual_seed(3)
    centers = torch.rand(2, 6, 2, generator=generator, dtype=torch.float64) - 0.5

    def penalty(c):
        return constraint.penalty(SparseAperture(c, 0.15, 1.0, shape, 0.2))

    assert float(penalty(centers).sum()) > 0  # else there would be nothing to differentiate
    assert torch.autograd.gradcheck(penalty, centers.requires_grad_())


@pytest.mark.parametrize("constraint", INEQUALITIES + EQUALITIES, ids=str)
def test_gradient_is_finite_where_holes_coincide(constraint):
    centers = torch.zeros(6, 2, dtype=torch.float64).requires_grad_()
    (gradient,) = torch.autograd.grad(constraint.penalty(mask(centers)), centers)
    assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("constraint", INEQUALITIES + EQUALITIES, ids=str)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_population_equals_one_by_one(constraint, dtype):
    population = torch.stack([thrown(6, seed).centers for seed in range(4)]).to(dtype).reshape(2, 2, 6, 2)
    together = SparseAperture(population, 0.1, 1.0)
    assert constraint.penalty(together).dtype == dtype
    for i in range(2):
        for j in range(2):
            alone = SparseAperture(population[i, j], 0.1, 1.0)
            torch.testing.assert_close(constraint.penalty(together)[i, j], constraint.penalty(alone))
            torch.testing.assert_close(constraint.violation(together)[i, j], constraint.violation(alone))


@pytest.mark.parametrize("constraint", INEQUALITIES + EQUALITIES, ids=str)
@given(seed=st.integers(0, 10**6))
@settings(max_examples=8, derandomize=True, deadline=None)
def test_projection_obeys_is_near_and_leaves_feasible_masks_alone(constraint, seed):
    aperture = thrown(6, seed)
    projected = constraint.project(aperture)
    assert float(constraint.violation(projected)) < 1e-11
    again = constraint.project(projected)
    torch.testing.assert_close(again.centers, projected.centers, rtol=0, atol=1e-10)
    # nearest: shrinking the step towards the given mask breaks the rule, unless it held from the start
    if float(constraint.violation(aperture)) > 1e-6:
        between = projected.centers + 0.05 * (aperture.centers - projected.centers)
        assert float(constraint.violation(mask(between))) > 0


def test_projection_of_a_single_hole_is_the_closed_form():
    outside = mask([[0.6, 0.8]])
    torch.testing.assert_close(InsideDisc().project(outside).centers, mask([[0.27, 0.36]]).centers, rtol=0, atol=1e-9)
    touching = NoOverlap().project(mask([[-0.02, 0.0], [0.04, 0.0]]))
    torch.testing.assert_close(touching.centers, mask([[-0.04, 0.0], [0.06, 0.0]]).centers, rtol=0, atol=1e-9)
    turned = NFoldSymmetry(2).project(mask([[0.1, 0.2], [-0.3, 0.0]]))
    torch.testing.assert_close(turned.centers, mask([[0.2, 0.1], [-0.2, -0.1]]).centers, rtol=0, atol=1e-12)


# Where the direction to leave is not defined, and the length of the shortest way out.
STUCK = [
    (KeepOutDisc(0.4), [[0.0, 0.0]], 0.25),
    (KeepOutDisc(0.4, (0.1, 0.2)), [[0.1, 0.2], [0.4, -0.1]], 0.25),
    (KeepOutDisc(0.4), [[0.0, 0.0], [0.0, 0.0]], 0.25 * math.sqrt(2)),
    (KeepOutDisc(0.4), [[0.0, 1e-200]], 0.25),  # its square is zero
    (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.2, 0.0]], 0.06),
    (KeepOutSegment((0.0, 0.0), (0.4, 0.3), 0.02), [[0.2, 0.15]], 0.06),
    (KeepOutSegment((0.1, 0.2), (0.4, 0.3), 0.02), [[0.19, 0.23]], 0.06),  # on the axis up to rounding
    (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.0, 0.0]], 0.06),
    (KeepOutSegment((0.0, 0.0), (0.4, 0.0), 0.02), [[0.4, 0.0]], 0.06),
    (MinimumGap(0.02), [[0.1, 0.1], [0.1, 0.1]], 0.12 / math.sqrt(2)),
    (NoOverlap(), [[0.1, 0.1]] * 3, 0.1),  # to an equilateral triangle
    (NonRedundancy(0.06), [[0.0, 0.0], [0.0, 0.0]], 0.06 / math.sqrt(2)),
    # equal steps: a - 2 b + c has to become 0.06 long
    (NonRedundancy(0.06), [[-0.2, 0.0], [0.0, 0.0], [0.2, 0.0]], 0.06 / math.sqrt(6)),
    # a square: a - b + c - d has to
    (NonRedundancy(0.06), [[0.0, 0.0], [0.2, 0.0], [0.2, 0.2], [0.0, 0.2]], 0.03),
]


@pytest.mark.parametrize(("constraint", "centers", "shortest"), STUCK)
def test_projection_leaves_where_no_direction_is_better(constraint, centers, shortest):
    aperture = mask(centers)
    projected = constraint.project(aperture)
    assert float(constraint.violation(projected)) == 0
    assert float((projected.centers - aperture.centers).norm()) == pytest.approx(shortest, rel=1e-6)
    assert constraint.project(aperture).centers.equal(projected.centers)


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
@pytest.mark.parametrize(("constraint", "centers", "shortest"), STUCK)
def test_descent_leaves_where_no_direction_is_better(constraint, centers, shortest, shape):
    del shortest
    start = torch.tensor(centers, dtype=torch.float64, requires_grad=True)
    before = constraint.penalty(mask(start, shape=shape))
    (gradient,) = torch.autograd.grad(before, start)
    after = constraint.penalty(mask(start.detach() - 0.01 * gradient, shape=shape))
    assert float(after) < float(before.detach())


def test_symmetric_mask_leaves_the_center():
    rules = [InsideDisc(), NoOverlap(), KeepOutDisc(0.3), NFoldSymmetry(4)]
    found = project(mask([[0.0, 0.0]] * 4), rules)
    check_mask(found, 1e-11, rules)
    assert torch.linalg.vector_norm(found.centers, dim=-1).tolist() == pytest.approx([0.2] * 4, rel=1e-6)


@given(seed=st.integers(0, 10**6), fill=st.floats(0.05, 0.5), n=st.integers(2, 12))
@settings(max_examples=25, derandomize=True, deadline=None)
def test_any_mask_finds_its_way_into_the_disc(seed, fill, n):
    diameter = math.sqrt(fill / n)
    aperture = thrown(n, seed, diameter, spread=0.8)
    try:
        check_mask(project(aperture, [InsideDisc(), NoOverlap()]), 1e-11)
    except Infeasible:
        # only crowded starts may get stuck between others
        assert fill > 0.25


def test_several_rules_at_once():
    rules = [InsideDisc(), NoOverlap(), KeepOutDisc(0.2), NFoldSymmetry(3), FixedHoles([(0.3, 0.1)], indices=[3])]
    found = project(thrown(9, 1), rules)
    check_mask(found, 1e-11, rules)
    assert found.centers[3].tolist() == pytest.approx([0.3, 0.1], abs=1e-12)
    turned = found.centers @ torch.tensor([[-0.5, math.sqrt(3) / 2], [-math.sqrt(3) / 2, -0.5]], dtype=torch.float64)
    distance = torch.cdist(turned, found.centers).min(-1).values
    assert float(distance.max()) < 1e-11


def test_float32_masks_still_hold_after_rounding():
    aperture = SparseAperture(thrown(9, 2).centers.float(), 0.1, 1.0)
    projected = project(aperture, [InsideDisc(), NoOverlap()])
    assert projected.centers.dtype == torch.float32
    check_mask(projected, 0.0)


def test_check_names_the_rule_and_the_shortfall():
    with pytest.raises(ValueError, match=r"0 and 1 by 0\.04 m"):
        check_mask(mask([[0.0, 0.0], [0.06, 0.0]]))
    with pytest.raises(ValueError, match="KeepOutDisc"):
        check_mask(mask([[0.0, 0.0], [0.3, 0.0]]), constraints=[KeepOutDisc(0.1)])
    check_mask(mask([[0.0, 0.0], [0.0999, 0.0]]), tolerance=1e-3)


def test_a_population_of_no_masks_breaks_no_rule():
    check_mask(mask(torch.zeros(0, 3, 2)), constraints=[MinimumGap(0.1), KeepOutDisc(0.2), NFoldSymmetry(3)])
    for worst in (0, 1):  # and of others the worst is told, wherever it stands
        masks = torch.tensor([[[0.0, 0.3], [0.0, -0.3]]]).repeat(2, 1, 1)
        masks[worst, 0, 0] = 0.2
        with pytest.raises(ValueError, match=r"FixedHoles.* is broken by 0\.2 m"):
            check_mask(mask(masks), constraints=[FixedHoles([(0.0, 0.3)])])


@pytest.mark.parametrize("name", ["min_gap", "rim_margin", "central_obstruction"])
@pytest.mark.parametrize("make", [lambda **rules: MaskRules(**rules).constraints(), DesignSpace])
def test_rules_given_as_numbers_are_refused_by_their_own_name(name, make):
    for value in (-0.1, math.nan):
        with pytest.raises(ValueError, match=f"^{name} is {value}: it must be finite and at least 0, in m$"):
            make(**{name: value})


def test_subspace_moves_a_hole_and_all_that_is_tied_to_it():
    subspace = Subspace(7, [NFoldSymmetry(3), FixedHoles([(0.3, 0.1)])])
    assert subspace.size == 2  # one free orbit; the fixed hole holds its own, the last sits at the centre
    z = subspace.place(torch.zeros(2, dtype=torch.float64), 4, torch.tensor([0.0, 0.2], dtype=torch.float64))
    centers = subspace.centers(z)
    assert centers[4].tolist() == pytest.approx([0.0, 0.2])
    assert centers[0].tolist() == pytest.approx([0.3, 0.1])
    assert centers[6].tolist() == pytest.approx([0.0, 0.0], abs=1e-12)
    np.testing.assert_allclose(torch.linalg.vector_norm(centers[3:6], dim=-1), 0.2)


def test_contradictions_and_impossible_symmetries_are_refused():
    with pytest.raises(ValueError, match="together"):
        Subspace(6, [NFoldSymmetry(3), FixedHoles([(0.3, 0.1), (0.0, 0.2)])])
    with pytest.raises(ValueError, match="6, 7, 9"):
        Subspace(8, [NFoldSymmetry(3)])
    with pytest.raises(Infeasible, match="missing"):
        project(thrown(3, 0), [InsideDisc(), NonRedundancy(0.9)])


def test_a_whole_number_of_folds_may_be_a_float():
    for one, other in zip(NFoldSymmetry(3.0).equations(7), NFoldSymmetry(3).equations(7), strict=True):
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MinimumGap(-0.1), "gap is -0.1"),
        (lambda: KeepOutDisc(0.0), "diameter is 0.0"),
        (lambda: KeepOutDisc(0.1, (0.0, math.nan)), "center is"),
        (lambda: KeepOutSegment((0.1, 0.0), (0.1, 0.0), 0.1), "KeepOutDisc"),
        (lambda: KeepOutSegment((0.1, 0.0), (0.2, 0.0), -0.1), "width is -0.1"),
        (lambda: NonRedundancy(math.inf), "distance is inf"),
        (lambda: FixedHoles([(0.0, 0.0)], indices=[1, 2]), "indices is"),
        (lambda: FixedHoles([(0.0, 0.0)], indices=[-1]), "counted from 0"),
        (lambda: NFoldSymmetry(1), "n_fold is 1"),
        (lambda: NFoldSymmetry(math.inf), "n_fold is inf"),
        (lambda: FixedHoles([(0.0, 0.0)], indices=[4]).equations(3), "mask has 3 holes"),
    ],
)
def test_bad_rules_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_mask_that_is_no_mask_any_more_is_not_in_order():
    mask = SparseAperture([[-0.3, 0.0], [0.3, 0.0]], 0.2, 1.0)
    mask.centers[1] = torch.nan
    with pytest.raises(ValueError, match="centers hold values that are not finite"):
        check_mask(mask)
    with pytest.raises(TypeError, match="aperture is of type Tensor: it must be of type SparseAperture"):
        check_mask(mask.centers)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda margins: margins * torch.nan, "is broken by nan m"),
        (
            lambda margins: margins > 0,
            r"dtype torch\.bool .* numbers \[m\] of shape \('M',\) are needed",
        ),
        (lambda margins: margins.sum(), r"have shape \(\)"),
        (lambda margins: margins[None], r"have shape \(1, 2\)"),
    ],
)
def test_rules_of_another_form_are_refused(change, said):
    class Rule(InsideDisc):
        def margins(self, aperture):
            return change(super().margins(aperture))

    with pytest.raises(ValueError, match=said):
        check_mask(SparseAperture([[-0.3, 0.0], [0.3, 0.0]], 0.2, 1.0), constraints=[Rule()])
