"""The scale of an object that its slopes tell, and the light that its frames have."""

import pytest
import torch
from torch import nn

from torchmask.restoration.change import Change
from torchmask.restoration.slopes import rate_in_light, rate_of_slopes


def test_a_rate_is_that_of_the_slopes_wherever_they_are():
    point = torch.zeros(8, 8, dtype=torch.float64)
    point[3, 3] = 5.0  # gradients of 5, 5 and 5 sqrt 2
    rate = 3 * (2 + 2**0.5) / (5 * 4)
    assert rate_of_slopes(point) == pytest.approx(rate, rel=1e-12)
    assert rate_of_slopes(nn.functional.pad(point, (0, 20, 0, 30))) == pytest.approx(rate, rel=1e-12)  # a dark sky
    assert rate_of_slopes(torch.full((4, 4), 3.0)) == 0


def test_gradients_of_one_rate_are_known_by_it():
    """Of random gradients, whatever the share of pixels without any; within four standard errors of both moments."""
    n, rate = 20000, 0.4
    lengths = torch.distributions.Gamma(2.0, rate).expand((n,))
    with torch.random.fork_rng():
        torch.manual_seed(0)
        heights = lengths.sample().double()
    stripes = torch.zeros(1, 4 * n, dtype=torch.float64)
    stripes[0, ::4] = heights  # each has two slopes, and flat pixels beside it
    found = rate_of_slopes(stripes)
    assert abs(found / rate - 1) < 4 * (0.5 + (120 / 36 - 1)) ** 0.5 / n**0.5  # of E|g|, and of E|g|^2: 120 / mu^4


@pytest.mark.parametrize(("light", "rate"), [(10.0, 1.0), (60.0, 1.5), (1e4, 2.0)])
def test_gentle_slopes_suit_the_given_prior_of_a_search_or_a_heavier_one(light, rate):
    assert rate_in_light(Change(light / 20, 20, 4096)) == pytest.approx(rate, rel=1e-12)


def test_the_light_balances_slopes_however_fine_the_pixels():
    """Twice as fine, each pixel has a quarter of the change, and the slopes of an object add up to twice as much."""
    coarse, fine = Change(8.0, 20, 64 * 64), Change(2.0, 20, 128 * 128)
    assert (coarse.light, fine.light) == (160.0, 80.0)


@pytest.mark.parametrize("n_pixels", [4096, 16384])
def test_frames_are_scarce_of_light_below_2048_beyond_their_noise(n_pixels):
    """However fine their pixels; a single one has none to be compared with."""
    for beyond_noise, is_scarce in ((2047.0, True), (2049.0, False)):
        change = Change(beyond_noise / n_pixels + 0.9, 10, n_pixels)
        assert change.shown == pytest.approx(beyond_noise / 2048, rel=1e-9)
        assert change.is_scarce is is_scarce
    assert not Change(0.0, 1, n_pixels).is_scarce
