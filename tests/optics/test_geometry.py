"""The affine map of a mask: its parameters, its matrix and the mask that it moves."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry, turn_and_stretch
from torchmask.optics.polygons import Hexagon

stretches = st.floats(0.5, 2.0)


@given(st.floats(-3.1, 3.1), stretches, stretches, st.floats(-0.4, 0.4), st.booleans())
def test_every_geometry_is_found_again_in_its_matrix(rotation, along_x, along_y, shear, mirrored):
    told = MaskGeometry(rotation, along_x, along_y, shear, mirrored)
    found = MaskGeometry.from_matrix(told.matrix)
    assert found.mirrored == mirrored
    values = (found.rotation, found.magnification_x, found.magnification_y, found.shear)
    # rounding of products of numbers up to 2, divided by the least trace, 1
    assert values == pytest.approx((rotation, along_x, along_y, shear), abs=1e-14)


def test_a_turn_is_from_x_to_y_and_a_mirror_reverses_x_before_it():
    x, y = torch.eye(2, dtype=torch.float64)
    assert torch.allclose(MaskGeometry(rotation=math.pi / 2).matrix @ x, y, atol=1e-16)
    assert torch.allclose(MaskGeometry(rotation=math.pi / 2, mirrored=True).matrix @ x, -y, atol=1e-16)
    assert torch.allclose(MaskGeometry(shear=0.1).matrix @ x, x + 0.1 * y)
    assert MaskGeometry(magnification_x=1.2, magnification_y=0.9).matrix.diagonal().tolist() == [1.2, 0.9]


def test_holes_are_magnified_by_the_root_of_the_area_and_turned():
    mask = SparseAperture([[0.0, 0.4], [0.3, -0.2]], 0.1, 1.0, "hexagon", orientation=0.1)
    moved = MaskGeometry(0.2, 1.05, 0.98, 0.01).apply(mask)
    assert moved.subaperture_diameter == pytest.approx(0.1 * math.sqrt(1.05 * 0.98 - 0.01**2))
    assert isinstance(moved.shape, Hexagon)
    assert moved.shape.orientation == pytest.approx(0.3)
    mirrored = MaskGeometry(0.2, mirrored=True).apply(mask)
    assert isinstance(mirrored.shape, Hexagon)
    assert math.remainder(mirrored.shape.orientation - 0.2 + 0.1, math.pi / 3) == pytest.approx(0, abs=1e-12)


@pytest.mark.parametrize("values", [{"magnification_x": -1.0}, {"shear": 1.0}, {"rotation": math.nan}])
def test_what_turns_the_mask_inside_out_is_refused(values):
    with pytest.raises(ValueError, match="positive"):
        MaskGeometry(**values)


def test_the_decomposition_differentiates():
    matrix = torch.tensor([[1.01, 0.02], [-0.03, 0.97]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(turn_and_stretch, matrix)
    identity = torch.eye(2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(turn_and_stretch, identity)
