"""Bands as a few wavelengths, by Gauss quadrature; filters by the cards of a header."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchmask.optics.band import FILTERS, Band, Filter, filter_of_header, warn_of_few_wavelengths
from torchmask.optics.passband import Passband


@pytest.mark.parametrize("width", [-10e-9, 0.0, 1.2e-6, math.nan])
def test_an_impossible_width_is_named(width):
    with pytest.raises(ValueError, match=r"m wide around 5\.5e-07 m: its width must be positive"):
        Band.top_hat(550e-9, width)


def test_equal_wavelengths_are_one():
    band = Band.of([5e-7, 6e-7, 5e-7], [1.0, 2.0, 5.0])
    assert band == Band((5e-7, 6e-7), (0.75, 0.25))


def test_what_is_no_wavelength_is_refused_in_metres():
    with pytest.raises(ValueError, match=r"wavelengths are \[-5e-07\]: they must be finite and positive, in m"):
        Band.of([-5e-7])
    with pytest.raises(ValueError, match=r"weights are \[0\.0\]: they must be finite and positive, in any unit"):
        Band.of([5e-7], [0.0])


@pytest.mark.parametrize("n", [1, 3, 8])
def test_a_top_hat_is_gauss_and_legendre(n):
    band = Band.top_hat(550e-9, 80e-9, n)
    nodes, weights = np.polynomial.legendre.leggauss(n)
    np.testing.assert_allclose(band.wavelengths, 550e-9 + 40e-9 * nodes, rtol=1e-12)
    np.testing.assert_allclose(band.shares, weights / 2, rtol=1e-10)


@given(
    st.lists(st.floats(0.01, 1.0), min_size=2, max_size=9),
    st.integers(1, 6),
    st.randoms(use_true_random=False),
)
def test_means_of_polynomials_over_a_curve_are_exact(transmission, n, random):
    """Against the closed form of the integral of a straight line times a power, piece by piece."""
    gaps = [random.uniform(1e-9, 20e-9) for _ in transmission]
    curve = 500e-9 + np.cumsum(gaps)
    band = Band.of_curve(curve, transmission, n)
    places = (np.array(band.wavelengths) - curve[0]) / (curve[-1] - curve[0])
    x = (curve - curve[0]) / (curve[-1] - curve[0])
    slopes = np.diff(transmission) / np.diff(x)
    offsets = np.array(transmission[:-1]) - slopes * x[:-1]

    def moment(k):
        by_offset, by_slope = ((x[1:] ** j - x[:-1] ** j) / j for j in (k + 1, k + 2))
        return float((offsets * by_offset + slopes * by_slope).sum())

    for power in range(2 * n):
        assert np.dot(band.shares, places**power) == pytest.approx(moment(power) / moment(0), rel=1e-7)
    assert curve[0] < min(band.wavelengths) <= max(band.wavelengths) < curve[-1]


@pytest.mark.parametrize(
    ("wavelengths", "transmission", "n", "message"),
    [
        ([5e-7], [1.0], 3, "at least 2"),
        ([5e-7, 6e-7], [1.0], 3, "equal numbers"),
        ([6e-7, 5e-7], [1.0, 1.0], 3, "increasing"),
        ([-1e-7, 5e-7], [1.0, 1.0], 3, "positive"),
        ([5e-7, 6e-7], [1.0, -1.0], 3, "negative"),
        ([5e-7, 6e-7], [0.0, 0.0], 3, "positive"),
        ([5e-7, 6e-7], [1.0, math.nan], 3, "finite"),
        ([5e-7, 6e-7], [1.0, 1.0], 0, "n_wavelengths is 0: it must be a whole number from 1 to 32"),
        ([5e-7, 6e-7], [1.0, 1.0], 33, "n_wavelengths is 33: it must be a whole number from 1 to 32"),
        ([5e-7, 6e-7], [1.0, 1.0], 2.5, r"n_wavelengths is 2\.5: it must be a whole number from 1 to 32"),
    ],
)
def test_what_is_no_curve_is_refused(wavelengths, transmission, n, message):
    with pytest.raises(ValueError, match=message):
        Band.of_curve(wavelengths, transmission, n)


def test_a_top_hat_wider_than_its_wavelength_is_refused():
    with pytest.raises(ValueError, match="positive"):
        Band.top_hat(550e-9, 1.2e-6)


@pytest.mark.parametrize(
    "cards", [{"INSTRUME": "NIRISS", "FILTER": "F380M"}, {"INSTRUME": " niriss", "FILTER": "f380m "}]
)
def test_a_filter_is_known_by_instrument_and_name(cards):
    assert filter_of_header(cards) == Filter(wavelength=3.828e-6, width=0.205e-6)


@pytest.mark.parametrize("cards", [{}, {"FILTER": "F380M"}, {"INSTRUME": "NIRCAM", "FILTER": "F380M"}])
def test_a_filter_of_no_or_another_instrument_is_not_known(cards):
    assert filter_of_header(cards) is None


def test_bands_are_in_metres():
    for (instrument, name), band in FILTERS.items():
        assert instrument == "NIRISS"
        assert band.wavelength == pytest.approx(int(name[1:4]) * 1e-8, rel=0.01)  # the name is the wavelength
        assert 0 < band.width < band.wavelength


def test_the_relative_width_is_that_of_the_top_hat_of_equal_scatter():
    """A top hat of width w scatters by w / sqrt(12), two equal lines a distance d apart by d / 2."""
    assert Band.top_hat(2e-6, 0.5e-6, 3).relative_width == pytest.approx(0.25, rel=1e-12)
    assert Band.of([0.9e-6, 1.1e-6]).relative_width == pytest.approx(math.sqrt(3) * 0.2, rel=1e-12)
    assert Band.of([1e-6]).relative_width == 0


@pytest.mark.parametrize(
    ("percent", "enough"), [(4.9, 1), (5.0, 1), (5.1, 2), (19.9, 2), (20.0, 2), (20.1, 3), (35.1, 4)]
)
def test_one_wavelength_stands_for_five_percent_and_each_other_for_fifteen_more(percent, enough):
    """Of the width over the mean wavelength; as many as that are not warned of."""
    passband = Passband.top_hat(550e-9, percent / 100 * 550e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_few_wavelengths(passband, enough)
    if enough > 1:
        with pytest.warns(UserWarning, match=f"n_wavelengths is {enough - 1} .* {enough} wavelengths do"):
            warn_of_few_wavelengths(passband, enough - 1)
