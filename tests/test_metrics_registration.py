"""The shift that registers images on a field that is not square, of which each side has a period of its own."""

import pytest
import torch

from torchmask.metrics import registration


@pytest.mark.parametrize("shape", [(12, 40), (40, 12)])
@pytest.mark.parametrize("offset", [(5, 5), (-5, -5), (4, -3)])
def test_the_shift_is_the_shortest_along_either_side(shape, offset):
    """A whole period more is the same image, but not the same tilt of the aberrations that go with it."""
    reference = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    image = reference.roll((-offset[0], -offset[1]), (0, 1))
    # the search ends at a gradient of 1e-9, and so within about as much of the shift
    assert registration(image, reference).tolist() == pytest.approx(offset, abs=1e-6)
