"""The densest known packings without a closed form: the radius of N equal discs in the unit disc, as tabulated."""

import math

import pytest
import torch

from torchmask.optics.packing import certain_number, largest_fill_factor, largest_number, random_packing

# E. Specht, packomania.com, "radius", to ten digits
RADII = {
    10: 0.2622589242,
    12: 0.2481634706,
    14: 0.2310307280,
    16: 0.2166647429,
    17: 0.2086796656,
    20: 0.1952240110,
}


@pytest.mark.parametrize("n", RADII)
def test_the_largest_fill_factor_is_that_of_the_tabulated_radius(n):
    # the last digit of the radius is half of 1e-10 off at most, and the fill factor n r^2
    assert largest_fill_factor(n) == pytest.approx(n * RADII[n] ** 2, rel=1e-9)


@pytest.mark.parametrize("n", RADII)
def test_discs_of_almost_that_radius_are_packed(n):
    """To 1e-5 in area: a table that promised more would be refused, and distances tell that none overlap."""
    fill = largest_fill_factor(n) * (1 - 1e-5)
    centers = random_packing(n, 2.0, fill, torch.Generator().manual_seed(0))
    diameter = 2.0 * math.sqrt(fill / n)
    assert float(torch.pdist(centers).min()) >= diameter * (1 - 1e-9)
    assert float(centers.norm(dim=-1).max()) <= 1.0 - diameter / 2 * (1 - 1e-9)


@pytest.mark.parametrize("n", [n for n in RADII if n < 20])  # the table's last bounds those that are not in it
def test_as_many_discs_fit_from_that_radius_on_and_fewer_below(n):
    for number in (largest_number, certain_number):
        assert number((1 + 1e-8) / RADII[n]) == n
        assert number((1 - 1e-8) / RADII[n]) == n - 1
