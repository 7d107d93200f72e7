"""The coherence of two wavelengths, as it is interpolated, against what it is fitted to."""

import math

import pytest
import torch

from torchmask.atmosphere import colour_coherence
from torchmask.atmosphere.colour_coherence import ColourCoherence, colour_loss
from torchmask.atmosphere.lens_coherence import lens_drift
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import difference_variance
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


@pytest.mark.parametrize("motion", [{}, {"exposure": 0.01, "wind": (6.0, 3.0)}])
@pytest.mark.parametrize("baseline", [[0.5, 0.0], [0.3, 0.4], [-0.1, 0.2]])
def test_the_loss_is_that_of_pairs_of_points_aside_of_the_baseline(baseline, motion, lens_points):
    """In exp(-k) to a fifteenth of the promised 3 %, as 12 and 16 samples across a hole leave its border uncertain. In
    motion the loss is 0.02 less; lenses along the baseline and not across it lose 0.01 and more."""
    seeing, step = Seeing(0.1 / 0.8, **motion), 0.1
    middle = torch.tensor(baseline, dtype=torch.float64)
    scales = 1 + step / 2, 1 - step / 2
    baselines = [middle / scale for scale in scales]
    across = 0.45 * 0.1 * torch.stack([-middle[1], middle[0]]) / middle.norm()
    apart = (baselines[0] - baselines[1]) / 2
    lenses = [lens_points(place, 0.1, 16) for place in (across + apart, across - apart)]
    steps, shares = lens_drift(seeing)

    def kept(i, j):
        separations = (lenses[j][:, None] - lenses[i]).flatten(0, 1)
        first, second = (baselines[k].expand_as(separations) for k in (i, j))
        total = 0.0
        for lag, share in zip(steps, shares, strict=True):
            variance = difference_variance(seeing.structure(), separations + lag, first, second, scales[i], scales[j])
            total += share * float(torch.exp(-variance / 2).mean())
        return total

    expected = math.log(math.sqrt(kept(0, 0) * kept(1, 1)) / kept(0, 1))
    found = colour_coherence._lost(Disc(), 0.1, seeing, middle[None], torch.tensor([step]).double())
    assert float(found) == pytest.approx(expected, abs=0.002)
