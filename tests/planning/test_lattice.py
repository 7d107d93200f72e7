"""Tables on a lattice of points: multilinear between any of them."""

import numpy as np
import pytest

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
