"""The structure function against its Bessel function, its limits, and its derivative."""

import math

import pytest
import torch

from torchmask.atmosphere.structure import StructureFunction
from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT, von_karman_structure_function

DISTANCE = torch.logspace(-5, 1.4, 500, dtype=torch.float64)
PLACES = torch.tensor([[0.3, -0.1], [0.02, 0.0], [7.0, 1.0]], dtype=torch.float64)


@pytest.mark.parametrize("outer_scale", [0.5, 5.0, 100.0])
@pytest.mark.parametrize("reach", [2.0, math.inf])
def test_it_is_that_of_the_bessel_function(outer_scale, reach):
    distance = DISTANCE[reach >= DISTANCE]
    exact = von_karman_structure_function(distance, 0.1, outer_scale)
    found = StructureFunction(0.1, outer_scale, reach).at(distance, torch.zeros_like(distance))
    assert (found / exact - 1).abs().max() < 1e-7


def test_without_outer_scale_it_is_a_power_law():
    found = StructureFunction(0.1)(torch.stack([0.6 * DISTANCE, 0.8 * DISTANCE], -1))
    torch.testing.assert_close(found, STRUCTURE_CONSTANT * (DISTANCE / 0.1) ** (5 / 3), rtol=1e-7, atol=0)


def test_displacements_beyond_the_reach_are_taken_as_the_reach():
    structure = StructureFunction(0.1, 5.0, reach=1.0)
    far, edge = structure(torch.tensor([[30.0, 0.0], [1.0, 0.0]], dtype=torch.float64))
    assert far == pytest.approx(float(edge), rel=1e-12)


def test_without_outer_scale_the_reach_changes_nothing():
    assert torch.equal(StructureFunction(0.1, reach=1.0)(PLACES), StructureFunction(0.1)(PLACES))


@pytest.mark.parametrize("outer_scale", [2.0, math.inf])
def test_coordinates_that_broadcast_are_those_of_the_plane(outer_scale):
    """To rounding: a processor takes powers of the numbers at the end of an array in another way than in its middle."""
    structure, (x, y) = StructureFunction(0.1, outer_scale), PLACES.unbind(-1)
    expected = structure(torch.stack(torch.meshgrid(x, y, indexing="ij"), -1))
    torch.testing.assert_close(structure.at(x[:, None], y), expected, rtol=1e-14, atol=0)
    torch.testing.assert_close(structure.at(x[:1], y), expected[0], rtol=1e-14, atol=0)


@pytest.mark.parametrize("outer_scale", [2.0, math.inf])
def test_gradcheck_with_the_origin(outer_scale):
    points = torch.tensor([[0.3, -0.1], [0.02, 0.0], [7.0, 1.0]], dtype=torch.float64, requires_grad=True)
    structure = StructureFunction(0.1, outer_scale)
    assert torch.autograd.gradcheck(structure, points)
    origin = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(structure(origin).sum(), origin)
    assert gradient.abs().max() == 0


@pytest.mark.parametrize("outer_scale", [2.0, math.inf])
def test_single_precision(outer_scale):
    structure = StructureFunction(0.1, outer_scale)
    found = structure.at(DISTANCE.float(), torch.zeros_like(DISTANCE).float())
    assert found.dtype == torch.float32
    # 48 steps of a recurrence of terms up to a few times the result, whose smallest part is 1e-3 of its largest
    assert (found / structure.at(DISTANCE, torch.zeros_like(DISTANCE)) - 1)[DISTANCE < 6].abs().max() < 1e-3


@pytest.mark.parametrize(
    ("r0", "outer_scale", "name"), [(0.0, 1.0, "r0"), (math.inf, 1.0, "r0"), (0.1, -1.0, "outer_scale")]
)
def test_impossible_scales_are_refused(r0, outer_scale, name):
    with pytest.raises(ValueError, match=f"{name} is"):
        StructureFunction(r0, outer_scale)
