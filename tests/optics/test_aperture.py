import math

import numpy as np
import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.shapes import Annulus, Disc, Hexagon

WAVELENGTH = 550e-9
GRID = Grid.nyquist(1.0, WAVELENGTH, 64)
TRIANGLE = [[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]]


def test_shapes_have_names_and_are_objects():
    named, given = SparseAperture(TRIANGLE, 0.1, 1.0, "hexagon", 0.2), SparseAperture(TRIANGLE, 0.1, 1.0, Hexagon(0.2))
    assert named.shape == given.shape == Hexagon(0.2)
    assert SparseAperture(TRIANGLE, 0.1, 1.0).shape == Disc()
    assert SparseAperture(TRIANGLE, 0.1, 1.0, "disc", 0.2).shape == Disc()  # a disc has no orientation
    assert (FullAperture(1.0).shape, FullAperture(1.0, 0.2).shape) == (Disc(), Annulus(0.2))


def test_the_same_mask_but_for_what_is_replaced():
    mask = SparseAperture(TRIANGLE, 0.1, 1.0, "hexagon", 0.2)
    other = torch.zeros(4, 3, 2)
    for change in ({"centers": other}, {"subaperture_diameter": 0.2}, {"mask_diameter": 2.0}, {"shape": Disc()}):
        replaced = mask.replace(**change)
        for name in ("centers", "subaperture_diameter", "mask_diameter", "shape"):
            assert getattr(replaced, name) is change.get(name, getattr(mask, name)), name
    moving = nn.Parameter(mask.centers.clone())
    assert mask.replace(moving).centers is moving


def test_a_parameter_stays_the_very_object_and_a_tensor_becomes_a_buffer():
    parameter = nn.Parameter(torch.tensor(TRIANGLE))
    assert SparseAperture(parameter, 0.2, 1.0).centers is parameter
    fixed = SparseAperture(torch.tensor(TRIANGLE), 0.2, 1.0)
    assert [name for name, _ in fixed.named_buffers()] == ["centers"]
    assert list(fixed.parameters()) == []
    with pytest.raises(ValueError, match="Parameter"):
        SparseAperture(parameter, 0.2, 1.0, dtype=torch.float64)


@pytest.mark.parametrize("device", ["cpu", torch.device("cpu"), None])
def test_a_parameter_may_be_asked_for_where_it_is(device):
    parameter = nn.Parameter(torch.tensor(TRIANGLE))
    assert SparseAperture(parameter, 0.2, 1.0, device=device).centers is parameter
    for elsewhere in ("meta", "cuda"):  # which this machine need not have
        with pytest.raises(ValueError, match="Parameter of another dtype or device: convert it"):
            SparseAperture(parameter, 0.2, 1.0, device=elsewhere)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("device", ["cuda", "cuda:0", torch.device("cuda"), torch.device("cuda", 0)])
def test_the_gpu_has_a_name_with_and_without_its_number(device):
    parameter = nn.Parameter(torch.tensor(TRIANGLE, device="cuda:0"))
    with torch.cuda.device(0):
        assert SparseAperture(parameter, 0.2, 1.0, device=device).centers is parameter


def test_a_whole_number_of_holes_may_be_a_float():
    one, other = (SparseAperture.random(n, 1.0, 0.1, torch.Generator().manual_seed(0)) for n in (3, 3.0))
    assert torch.equal(one.centers, other.centers)
    with pytest.raises(ValueError, match=r"n_subapertures is 2\.5: it must be a whole number of at least 1"):
        SparseAperture.random(2.5, 1.0, 0.1)


def test_a_population_of_no_masks_reaches_as_far_as_a_hole():
    none = SparseAperture(torch.zeros(0, 3, 2, dtype=torch.float64), 0.2, 1.0)
    assert (none.extent, none.reach) == (0.2, 0.1)
    assert none.samples(GRID).weights.shape[:2] == (0, 3)


def test_state_dict_round_trip():
    source = SparseAperture(TRIANGLE, 0.2, 1.0)
    target = SparseAperture(np.zeros((3, 2)), 0.2, 1.0)
    target.load_state_dict(source.state_dict())
    assert torch.equal(target.centers, source.centers)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[0.0, 0.0, 0.0]], 0.1, 1.0), "shape"),
        (([0.0, 0.0], 0.1, 1.0), "shape"),
        ((torch.zeros(0, 2), 0.1, 1.0), "shape"),
        (([[math.nan, 0.0]], 0.1, 1.0), "finite"),
        (([[0.0, 0.0]], -0.1, 1.0), "subaperture_diameter"),
        (([[0.0, 0.0]], 0.1, math.inf), "mask_diameter"),
        ((TRIANGLE, torch.tensor([0.1, 0.2, 0.1]), 1.0), "subaperture_diameter holds 3 values: it is one number, in m"),
        ((TRIANGLE, [0.1, 0.2, 0.1], 1.0), "as all holes have one size"),
        (([[0.0, 0.0]], 0.1, 1.0, "star"), "known shapes are .*hexagon"),
        (([[0.0, 0.0]], 0.1, 1.0, "annulus"), "needs obstruction"),
        (([[0.0, 0.0]], 0.1, 1.0, "hexagon", math.nan), "orientation"),
        (([[0.0, 0.0]], 0.1, 1.0, Hexagon(0.1), 0.1), "has its own"),
    ],
)
def test_bad_masks_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        SparseAperture(*arguments)


def test_whole_numbers_are_no_positions():
    with pytest.raises(TypeError, match="floating"):
        SparseAperture(torch.zeros(1, 2, dtype=torch.int64), 0.1, 1.0)


@pytest.mark.parametrize(("diameter", "obstruction"), [(0.0, 0.0), (math.nan, 0.0), (1.0, 1.0), (1.0, -0.1)])
def test_bad_pupils_are_refused(diameter, obstruction):
    with pytest.raises(ValueError, match=r"diameter|central_obstruction"):
        FullAperture(diameter, obstruction)
