"""How many equal discs fit: bounds from both sides, and packings that exist."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchmask.optics.packing import certain_number, largest_fill_factor, largest_number


@given(st.floats(0.5, 60.0))
def test_what_fits_is_never_more_than_what_may(ratio):
    assert 0 <= certain_number(ratio) <= largest_number(ratio)


@pytest.mark.parametrize("n", [*range(1, 20), 25, 40, 100, 1000])
def test_the_number_and_the_fill_factor_are_one_bound(n):
    """N discs just above the ratio of the densest packing may fit, and just below they do not; 6 fit where 7 do."""
    ratio = math.sqrt(n / largest_fill_factor(n))
    assert largest_number(ratio * (1 + 1e-9)) == (7 if n == 6 else 19 if n == 18 else n)
    assert largest_number(ratio * (1 - 1e-6)) == (5 if n == 7 else 17 if n == 19 else n - 1)


def test_densities_tend_to_that_of_the_hexagonal_lattice():
    """N over the area in discs: pi / sqrt(12) less a share of the rim, which is 1 / ratio times a number of order 1."""
    for ratio in (100.0, 400.0):
        certain, largest = (number(ratio) / ratio**2 for number in (certain_number, largest_number))
        density = math.pi / math.sqrt(12)
        assert density * (1 - 3 / ratio) < certain < largest < density


def test_seven_discs_fit_where_a_ring_of_six_surrounds_one():
    assert (certain_number(3.0), largest_number(3.0)) == (7, 7)
    assert (certain_number(2.99), largest_number(2.99)) == (5, 5)
