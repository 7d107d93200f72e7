"""Tables on a lattice of points: multilinear between any of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchmask.planning.lattice import Axis, interpolate


@pytest.mark.parametrize("place", [0.0, 0.2, 0.5, 0.8, 1.0, 1.7, 2.3, 2.9, 3.0])
def test_along_one_axis_it_is_straight_between_neighbours(place):
    table = np.array([1.0, 4.0, 2.0, 7.0])
    assert interpolate(table, [place]) == pytest.approx(np.interp(place, np.arange(4), table), rel=1e-12)


@pytest.mark.parametrize("places", [(0.7, 1.6), (0.4, 0.9), (1.0, 2.0), (0.0, 0.0)])
def test_along_two_axes_it_weighs_the_four_points_around(places):
    table = np.array([[1.0, 4.0, 2.0], [3.0, -5.0, 8.0]])
    expected = 0.0
    for i in range(2):
        for j in range(3):
            weight = max(0.0, 1 - abs(places[0] - i)) * max(0.0, 1 - abs(places[1] - j))
            expected += weight * table[i, j]
    assert interpolate(table, places) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(("logarithmic", "place"), [(True, 1.5), (False, 1 + (10**2.5 - 100) / 900)])
def test_a_value_lies_between_points_by_itself_or_by_its_logarithm(logarithmic, place):
    axis = Axis("light", "photons", (10.0, 100.0, 1000.0), logarithmic=logarithmic)
    assert axis.place(10**2.5) == pytest.approx(place, rel=1e-12)
    assert [axis.place(value) for value in (1.0, 1e5)] == [0.0, 2.0]  # the nearest beyond them


@pytest.mark.parametrize("harder", [False, True])
@given(end=st.floats(0.1, 1e9), off=st.floats(-1e-12, 1e-12))
def test_an_end_that_was_computed_in_another_way_is_the_end(harder, end, off):
    """A few roundings, 1e-16 each, put a value beyond no end; a thousandth does."""
    axis = Axis("x", "x", (end / 100, end), harder=harder)
    assert axis.holds(end * (1 + off))
    assert axis.holds(end / 100 * (1 + off))
    assert not axis.is_harder(end * (1 + off))
    assert not axis.holds(end * 1.001)
    assert not axis.holds(end / 100 * 0.999)
    assert axis.is_harder(end * 1.001) == harder


def test_a_value_that_is_there_twice_is_refused():
    with pytest.raises(ValueError, match="in rising order"):
        Axis("x", "x", (1.0, 2.0, 2.0))
