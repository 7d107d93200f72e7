"""A map of a mask shows its holes as a whole, also where they leave the disc."""

import math

import pytest
import torch

from torchmask.design.manufacture import amplitude_map
from torchmask.optics.aperture import SparseAperture


@pytest.mark.parametrize("n_pixels", [196, 197])
@pytest.mark.parametrize("outermost", [0.35, 0.44])
def test_the_open_area_of_the_map_and_its_middle_are_those_of_the_holes(n_pixels, outermost):
    """The outermost hole ends inside the disc, or 0.04 of its diameter beyond, where a seventh of it would be lost."""
    mask = SparseAperture([[outermost, 0.0], [-0.2, 0.3], [-0.2, -0.3]], 0.2, 1.0)
    amplitude, step = amplitude_map(mask, n_pixels)
    # cells take the edge in them for straight, which adds about (cell / radius)^2 / 10 to a disc
    assert float(amplitude.sum()) * step**2 == pytest.approx(3 * math.pi * 0.1**2, rel=1e-3)
    x = step * (torch.arange(n_pixels, dtype=torch.float64) - n_pixels // 2)
    middle = float((amplitude.sum(0) * x).sum() / amplitude.sum())
    assert middle == pytest.approx((outermost - 0.4) / 3, abs=0.02 * step)
