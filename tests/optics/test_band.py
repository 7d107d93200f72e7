"""Filters by the cards of a header."""

import pytest

from torchmask.optics.band import FILTERS, Filter, filter_of_header


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
