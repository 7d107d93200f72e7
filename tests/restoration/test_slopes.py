"""The scale of an object that its slopes tell, and what noise makes of it."""

import pytest
import torch
from torch import nn

from torchmask.restoration.change import Change
from torchmask.restoration.slopes import rate_in_light, rate_in_noise, rate_of_slopes, shown


def point_of(rate):
    """An object whose slopes have this rate: of one pixel, with two slopes and one across."""
    point = torch.zeros(8, 8, dtype=torch.float64)
    point[3, 3] = 3 * (2 + 2**0.5) / (4 * rate)
    return point


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


@pytest.mark.parametrize(
    ("rate", "light", "expected"),
    [
        (0.8, 39.0, 0.8),
        (0.8, 41.0, 1.025),
        (0.8, 60.0, 1.5),
        (0.8, 80.0, 2.0),
        (0.8, 1e4, 2.0),
        (2.5, 1e4, 2.5),
        (0.1, 60.0, 1.5),
    ],
)
def test_gentle_slopes_have_a_higher_rate_the_more_light_has_bent_them(rate, light, expected):
    """Up to 2 and never a lower one, however steep those found are; others are taken as they are."""
    change = Change(light / 20, 20, 4096)
    assert rate_in_noise(point_of(rate), change, gentle=True) == pytest.approx(expected, rel=1e-12)
    assert rate_in_noise(point_of(rate), change, gentle=False) == pytest.approx(rate, rel=1e-12)


@pytest.mark.parametrize("n_pixels", [4096, 16384])
@pytest.mark.parametrize("n_frames", [2, 10, 200])
@pytest.mark.parametrize("gentle", [False, True])
@pytest.mark.parametrize(
    ("beyond_noise", "factor"), [(2400, 1.0), (2049, 1.0), (1638.4, 0.8), (819.2, 0.4), (400, 0.25), (-400, 0.25)]
)
def test_slopes_in_frames_of_hardly_more_than_noise_are_steeper(beyond_noise, factor, gentle, n_frames, n_pixels):
    """However many there are, and gentle or not, and however fine their pixels; nothing is held by the light there."""
    for rate in (0.3, 1.6):
        change = Change(beyond_noise / n_pixels + 1 - 1 / n_frames, n_frames, n_pixels)
        least = min(change.light / 40, 2.0)
        expected = max(rate, least) if factor == 1 and gentle and least > 1 else rate * factor
        assert rate_in_noise(point_of(rate), change, gentle=gentle) == pytest.approx(expected, rel=1e-9)
        assert (shown(change) < 1) == (factor < 1)


def test_a_single_frame_does_not_tell_how_much_frames_change():
    assert rate_in_noise(point_of(0.7), Change(0.0, 1, 4096), gentle=False) == pytest.approx(0.7, rel=1e-12)


@pytest.mark.parametrize(("light", "rate"), [(10.0, 1.0), (60.0, 1.5), (1e4, 2.0)])
def test_gentle_slopes_suit_the_given_prior_of_a_search_or_a_heavier_one(light, rate):
    assert rate_in_light(Change(light / 20, 20, 4096)) == pytest.approx(rate, rel=1e-12)


def test_the_light_balances_slopes_however_fine_the_pixels():
    """Twice as fine, each pixel has a quarter of the change, and the slopes of an object add up to twice as much."""
    coarse, fine = Change(8.0, 20, 64 * 64), Change(2.0, 20, 128 * 128)
    assert (coarse.light, fine.light) == (160.0, 80.0)
