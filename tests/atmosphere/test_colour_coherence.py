"""The coherence of two wavelengths, as it is interpolated, against what it is fitted to."""

import pytest
import torch

from torchmask.atmosphere import colour_coherence
from torchmask.atmosphere.colour_coherence import ColourCoherence, colour_loss
from torchmask.atmosphere.seeing import Seeing
from torchmask.optics.band import Band
from torchmask.optics.shapes import Disc


@pytest.mark.parametrize("baseline", [0.4, 0.8])
def test_the_loss_is_as_good_between_near_wavelengths_as_between_far_ones(baseline):
    """Over (a - a')^2 it falls as |a - a'| grows; a parabola, fitted to far wavelengths, is 9 % low for near ones."""
    hole, seeing, band = 0.0866, Seeing(0.0866 / 1.5), Band.top_hat(550e-9, 110e-9, 7)
    known = ColourCoherence(Disc(), hole, seeing, band, 550e-9, 1.2)
    place = torch.tensor([[baseline, 0.0]], dtype=torch.float64)
    second, third = known.factors(place)
    for step in (0.022, 0.044, 0.1):
        apart = torch.tensor([step], dtype=torch.float64)
        expected = float(colour_coherence._lost(Disc(), hole, seeing, place, apart))
        assert float(colour_loss(second, third, 1 + apart / 2, 1 - apart / 2)) == pytest.approx(expected, rel=0.04)
