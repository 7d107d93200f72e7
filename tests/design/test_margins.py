"""Margins of rules in closed form: holes that are not round, and baselines that agree but for their sign."""

import math

import pytest
import torch

from torchmask.design.constraints import KeepOutDisc, KeepOutSegment, NonRedundancy
from torchmask.optics.aperture import SparseAperture


def test_zones_keep_off_the_corners_of_holes_too():
    """A hexagon 0.1 m from flat to flat reaches 0.1 / 3^(1/2) m from its middle."""
    centers = torch.tensor([[0.3, 0.0], [0.0, -0.35]], dtype=torch.float64)
    mask = SparseAperture(centers, 0.1, 1.0, shape="hexagon")
    corner = 0.1 / math.sqrt(3)
    disc = KeepOutDisc(0.2, (0.0, 0.0)).margins(mask)
    torch.testing.assert_close(disc, torch.tensor([0.2, 0.25], dtype=torch.float64) - corner, rtol=1e-12, atol=0)
    bar = KeepOutSegment((0.0, 0.0), (0.0, 1.0), 0.04).margins(mask)
    torch.testing.assert_close(bar, torch.tensor([0.28, 0.33], dtype=torch.float64) - corner, rtol=1e-12, atol=0)


@pytest.mark.parametrize("order", [[0, 1, 2], [1, 0, 2], [2, 1, 0]])
def test_a_baseline_and_the_opposite_of_another_are_redundant(order):
    """A hole midway between two others, whichever comes first, repeats its baseline."""
    row = torch.tensor([[0.0, 0.0], [-0.2, 0.0], [0.2, 0.0]], dtype=torch.float64)[order]
    assert float(NonRedundancy(0.1).margins(SparseAperture(row, 0.05, 1.0)).min()) == pytest.approx(-0.1, rel=1e-9)
    moved = row + torch.tensor([[0.0, 0.04 * (index == 0)] for index in order], dtype=torch.float64)
    least = float(NonRedundancy(0.1).margins(SparseAperture(moved, 0.05, 1.0)).min())
    assert least == pytest.approx(0.08 - 0.1, rel=1e-9)  # the two baselines differ by twice the step aside
