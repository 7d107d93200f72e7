"""Which holes overlap, and by how much: against distances worked out by hand."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.design.drawing import save_dxf, save_svg
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.overlaps import check_overlaps, find_overlaps, pair_clearances, require_apart
from torchmask.optics.shapes import Hexagon
from torchmask.simulation.dataset import StackDataset
from torchmask.simulation.exposures import simulate_observation


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(*[st.floats(-0.5, 0.5)] * 2), min_size=1, max_size=6), st.floats(0.01, 0.5))
def test_overlaps_are_those_that_distances_say(centers, diameter):
    mask = SparseAperture(torch.tensor(centers, dtype=torch.float64), diameter, 1.0)
    expected = {
        (i, j): diameter - math.dist(centers[i], centers[j])
        for j in range(len(centers))
        for i in range(j)
        if diameter - math.dist(centers[i], centers[j]) > 1e-6
    }
    found = find_overlaps(mask)
    assert {(pair.first, pair.second) for pair in found} == expected.keys()
    assert all(pair.depth == pytest.approx(expected[pair.first, pair.second], abs=1e-15) for pair in found)
    assert [pair.depth for pair in found] == sorted((pair.depth for pair in found), reverse=True)


def test_hexagons_overlap_where_their_sides_cross():
    """Side by side they touch at one width; corner to corner at 2 / sqrt(3) widths, which is farther."""
    width = 0.2
    for direction, touching in ((0.0, width), (math.pi / 6, 2 * width / math.sqrt(3))):
        for factor, overlaps in ((1 - 1e-4, True), (1 + 1e-4, False)):
            step = factor * touching
            centers = [[0.0, 0.0], [step * math.cos(direction), step * math.sin(direction)]]
            mask = SparseAperture(centers, width, 1.0, Hexagon(0.0))
            assert bool(find_overlaps(mask)) == overlaps


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_holes_that_touch_do_not_overlap(dtype):
    """A row of seven touching holes, whose positions are rounded in either precision."""
    size = 1 / 7
    centers = torch.tensor([[(k - 3) * size, 0.0] for k in range(7)], dtype=torch.float64).to(dtype)
    check_overlaps(SparseAperture(centers, size, 1.0))
    with pytest.raises(ValueError, match=r"6 pairs of holes overlap: .*, and 3 more pairs \(holes of 0\.143 m"):
        check_overlaps(SparseAperture(centers, 0.143, 1.0))


def test_the_message_names_holes_and_metres():
    centers = [[0.0, 0.0], [0.3, 0.0], [0.0, -0.19], [0.31, 0.05]]
    with pytest.raises(ValueError, match=r"overlap: 1 and 3 by 0\.149 m, 0 and 2 by 0\.01 m"):
        check_overlaps(SparseAperture(centers, 0.2, 1.0))


def test_masks_of_overlapping_holes_are_refused_unless_asked_for(tmp_path):
    """In drawings for the workshop and in simulations, as on the command line; golay6 at 0.9 has six such pairs."""
    mask, grid = SparseAperture.from_catalog("golay6", 1.0, 0.9), Grid.nyquist(1.0, 550e-9, 32)
    scene = torch.ones(32, 32, dtype=torch.float64)
    uses = [
        lambda **how: save_dxf(tmp_path / "mask.dxf", mask, **how),
        lambda **how: save_svg(tmp_path / "mask.svg", mask, **how),
        lambda **how: simulate_observation(scene, mask, grid, None, Detector(), 1, **how),
        lambda **how: StackDataset(mask, grid, 1, n_frames=1, **how),
    ]
    for use in uses:
        with pytest.raises(ValueError, match=r"pairs of holes overlap: .*; give allow_overlap to accept it"):
            use()
        assert not list(tmp_path.iterdir())
        use(allow_overlap=True)
        for file in tmp_path.iterdir():
            file.unlink()
    for aperture in (SparseAperture.from_catalog("golay6", 1.0, 0.15), FullAperture(1.0)):
        require_apart(aperture)


def test_one_hole_and_a_full_pupil_overlap_with_nothing():
    assert find_overlaps(SparseAperture([[0.0, 0.0]], 0.2, 1.0)) == []
    assert pair_clearances(FullAperture(1.0)).shape == (0,)


def test_of_a_population_the_pairs_of_all_masks_are_found():
    apart, close = [[0.0, 0.0], [0.3, 0.0]], [[0.0, 0.0], [0.1, 0.0]]
    masks = SparseAperture(torch.tensor([[apart, close], [apart, apart]]), 0.2, 1.0)
    assert [(pair.first, pair.second) for pair in find_overlaps(masks)] == [(0, 1)]
