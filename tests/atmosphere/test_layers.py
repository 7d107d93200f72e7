"""Scales of layered turbulence: against integrals, against each other, and where an outer scale changes them."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.profiles import PROFILES, named_layers
from torchmask.atmosphere.von_karman import von_karman_structure_function

WAVELENGTH = 500e-9


def hv57(h):
    """C_n^2 [m^(-2/3)] by Hufnagel and Valley."""
    wind = 0.00594 * (21 / 27) ** 2 * (1e-5 * h) ** 10 * math.exp(-h / 1000)
    return wind + 2.7e-16 * math.exp(-h / 1500) + 1.7e-14 * math.exp(-h / 100)


def bufton(h):
    return 5 + 30 * math.exp(-(((h - 9400) / 4800) ** 2))


def integral(function):
    places = [30, 100, 300, 1000, 3000, 6000, 9000, 12000, 16000, 20000, 30000]
    return quad(function, 0, 60e3, points=places, limit=1000, epsrel=1e-12)[0]


@pytest.mark.parametrize("n_layers", [1, 2, 5, 20, 10_000])
def test_hv57_has_its_scales_whatever_the_number_of_layers(n_layers):
    """r0 4.96 cm, theta0 6.89 microrad, tau0 1.86 ms at 500 nm, by quadrature, with the constants of the textbooks."""
    layers, k2 = named_layers("hv57", n_layers), (2 * math.pi / WAVELENGTH) ** 2
    assert len(layers.heights) == min(n_layers, 2000)
    r0 = (0.423 * k2 * integral(hv57)) ** -0.6
    theta0 = (2.914 * k2 * integral(lambda h: hv57(h) * h ** (5 / 3))) ** -0.6
    tau0 = (2.914 * k2 * integral(lambda h: hv57(h) * bufton(h) ** (5 / 3))) ** -0.6
    greenwood = (0.1025 * k2 * integral(lambda h: hv57(h) * bufton(h) ** (5 / 3))) ** 0.6
    assert layers.r0(WAVELENGTH) == pytest.approx(r0, rel=6e-4)  # 0.423 stands for 0.42336
    assert layers.theta0(WAVELENGTH) == pytest.approx(theta0, rel=1e-4)
    assert layers.tau0(WAVELENGTH) == pytest.approx(tau0, rel=1e-4)
    assert layers.greenwood_frequency(WAVELENGTH) == pytest.approx(greenwood, rel=2e-4)
    # In closed form: three integrals of exponentials, and the constant of D = 6.88 (r/r0)^(5/3).
    strength = 0.00594 * (21 / 27) ** 2 * 1e-17 * math.factorial(10) + 2.7e-16 * 1500 + 1.7e-14 * 100
    path = math.sqrt(math.pi) * math.gamma(-5 / 6) / math.gamma(-1 / 3)  # 2.914
    constant = path / (2 * (24 / 5 * math.gamma(6 / 5)) ** (5 / 6))
    assert layers.r0(WAVELENGTH) == pytest.approx((constant * k2 * strength) ** -0.6, rel=1e-5)  # of the 2000 cells
    # The 4.98 cm that are quoted too come from a constant rounded to 0.42, and not from the profile.
    assert (0.42 * k2 * strength) ** -0.6 == pytest.approx(0.0498, abs=5e-5)
    assert layers.theta0(WAVELENGTH) == pytest.approx(6.9e-6, abs=0.05e-6)


def test_more_layers_come_closer_to_the_profile():
    """Rays from two directions to two points: what r0 and theta0 alone do not fix."""
    fine = named_layers("hv57", 10_000)
    direction, outer_scale = (1.5 * fine.theta0(WAVELENGTH), 0.0), 10.0
    baseline = (-0.03, 0.02)

    def difference(layers):
        return float(layers.structure_function(WAVELENGTH, outer_scale, baseline=baseline, direction=direction))

    def density(h):
        away = math.hypot(baseline[0] + h * direction[0], baseline[1])
        r0 = Layers([h], [hv57(h)]).r0(WAVELENGTH)
        return float(von_karman_structure_function(torch.tensor(away, dtype=torch.float64), r0, outer_scale))

    exact = integral(density)
    assert difference(fine) == pytest.approx(exact, rel=1e-5)
    errors = [abs(difference(named_layers("hv57", n)) / exact - 1) for n in (2, 4, 8, 16, 32, 64)]
    assert errors[0] > 0.02
    assert all(later < 0.75 * sooner for sooner, later in itertools.pairwise(errors))
    assert errors[-1] < 1e-3


@pytest.mark.parametrize("n_layers", [2, 5, 8])
def test_every_group_has_the_same_share_of_strength_and_of_what_sets_theta0(n_layers):
    """Half of a share is one, half the other; a group may have a cell of the profile too many at either end."""

    def shares(layers):
        strength, height = np.array(layers.strengths), np.array(layers.heights)
        high = strength * height ** (5 / 3)
        return (strength / strength.sum() + high / high.sum()) / 2

    cell = shares(named_layers("hv57", 10_000)).max()
    assert cell < 0.01
    grouped = named_layers("hv57", n_layers)
    assert len(grouped.heights) == n_layers
    np.testing.assert_allclose(shares(grouped), 1 / n_layers, rtol=0, atol=1.01 * cell)


def test_one_layer_is_the_textbook():
    """theta0 = 0.314 r0 / h, tau0 = 0.314 r0 / v, f_G = 0.427 v / r0; a wind across counts with its length."""
    layers = Layers.from_fractions(0.1, WAVELENGTH, [4000.0], [3.0], [(6.0, -8.0)])
    assert layers.r0(WAVELENGTH) == pytest.approx(0.1, rel=1e-12)
    assert layers.theta0(WAVELENGTH) == pytest.approx(0.31427 * 0.1 / 4000, rel=2e-5)
    assert layers.tau0(WAVELENGTH) == pytest.approx(0.31427 * 0.1 / 10, rel=2e-5)
    assert layers.greenwood_frequency(WAVELENGTH) == pytest.approx(0.427 * 10 / 0.1, rel=1e-3)
    assert layers.greenwood_frequency(WAVELENGTH) * layers.tau0(WAVELENGTH) == pytest.approx(0.134, rel=2e-3)
    still = Layers([0.0], [1e-12])
    assert still.theta0(WAVELENGTH) == still.tau0(WAVELENGTH) == math.inf
    assert still.greenwood_frequency(WAVELENGTH) == 0


def test_scales_with_wavelength_and_airmass():
    layers = named_layers("hv57")
    for scale, power in (
        (layers.r0, 1.2),
        (layers.theta0, 1.2),
        (layers.tau0, 1.2),
        (layers.greenwood_frequency, -1.2),
    ):
        assert scale(2 * WAVELENGTH) == pytest.approx(2**power * scale(WAVELENGTH), rel=1e-12)
    aslant = layers.at_airmass(1.7)
    for name, power in (("r0", -0.6), ("theta0", -1.6), ("tau0", -0.6)):
        assert getattr(aslant, name)(1e-6) == pytest.approx(1.7**power * getattr(layers, name)(1e-6), rel=1e-12)
    parts = layers.layer_r0(WAVELENGTH)
    assert sum(r0 ** (-5 / 3) for r0 in parts) == pytest.approx(layers.r0(WAVELENGTH) ** (-5 / 3), rel=1e-12)


LAYERS = st.lists(
    st.tuples(st.floats(0, 2e4), st.floats(1e-15, 1e-11), st.floats(-40, 40), st.floats(-40, 40)),
    min_size=1,
    max_size=9,
)


@settings(derandomize=True, deadline=None, max_examples=60)
@given(LAYERS, st.integers(1, 9))
def test_grouping_keeps_the_scales(values, n_layers):
    heights, strengths, *wind = zip(*values, strict=True)
    layers = Layers(heights, strengths, tuple(zip(*wind, strict=True)))
    grouped = layers.grouped(n_layers)
    assert len(grouped.heights) <= min(n_layers, len(heights))
    for scale in ("r0", "theta0", "tau0"):
        assert getattr(grouped, scale)(WAVELENGTH) == pytest.approx(getattr(layers, scale)(WAVELENGTH), rel=1e-9)
    if n_layers >= len(heights):
        assert grouped == layers


def test_a_group_blows_the_way_its_members_do():
    layers = Layers([0.0, 10.0], [1e-13, 3e-13], [(4.0, 0.0), (0.0, 4.0)]).grouped(1)
    assert layers.winds[0] == pytest.approx((4 / math.sqrt(10), 12 / math.sqrt(10)), rel=1e-12)
    opposite = Layers([0.0, 10.0], [1e-13, 1e-13], [(4.0, 0.0), (-4.0, 0.0)]).grouped(1)
    assert opposite.winds[0] == pytest.approx((4.0, 0.0), rel=1e-12)


@pytest.mark.parametrize("n_layers", [1, 2, 4, 6])
def test_the_order_in_which_layers_are_given_changes_nothing(n_layers):
    """Neighbours are neighbours in height."""
    heights, strengths = (4e3, 0.0, 1.1e4, 300.0, 2e3, 8e3), (2e-13, 9e-13, 4e-14, 3e-13, 1e-13, 7e-14)
    winds = ((3.0, 9.0), (5.0, 0.0), (-20.0, 4.0), (6.0, 2.0), (1.0, -7.0), (15.0, 15.0))
    rows = sorted(zip(heights, strengths, winds, strict=True))
    found = Layers(heights, strengths, winds).grouped(n_layers)
    expected = Layers(*zip(*rows, strict=True)).grouped(n_layers)
    for found_height, height in zip(sorted(found.heights), expected.heights, strict=True):
        assert found_height == pytest.approx(height, rel=1e-12)
    assert sorted(found.strengths) == pytest.approx(sorted(expected.strengths), rel=1e-12)


def test_the_zenith_changes_nothing():
    assert Layers([4e3], [2e-13], [(3.0, 9.0)]).at_airmass(1.0) == Layers([4e3], [2e-13], [(3.0, 9.0)])


def test_a_description_has_shares_of_the_whole_and_speeds_whatever_their_direction():
    layers = Layers([100.0, 5e3], [6e-13, 2e-13], [(-3.0, 4.0), (0.0, -12.0)])
    rows = [row.strip("| ").split(" | ") for row in layers.describe(WAVELENGTH).splitlines()]
    assert rows[2:4] == [["100 m", "0.750", "5.0 m/s"], ["5000 m", "0.250", "12.0 m/s"]]
    told = {row[0]: row[1] for row in rows[4:] if len(row) == 3}
    units = {"cm": 1e-2, "ms": 1e-3, "Hz": 1.0, "microrad": 1e-6, "arcsec": math.pi / 180 / 3600}
    for name, scale in (
        ("r0", layers.r0),
        ("theta0", layers.theta0),
        ("tau0", layers.tau0),
        ("f_G", layers.greenwood_frequency),
    ):
        for part in told[name].split(" = "):
            number, unit = part.split()
            assert float(number) * units[unit] == pytest.approx(scale(WAVELENGTH), rel=1e-3)  # of four digits


def test_the_structure_function_is_1_at_each_scale():
    layers, close = named_layers("hv57"), {"rel": 1e-10}
    theta0, tau0, r0 = (scale(WAVELENGTH) for scale in (layers.theta0, layers.tau0, layers.r0))
    assert float(layers.structure_function(WAVELENGTH, direction=(0.6 * theta0, 0.8 * theta0))) == pytest.approx(
        1, **close
    )
    delays = torch.tensor([0.0, 0.5, 1.0, -2.0], dtype=torch.float64) * tau0
    found = layers.structure_function(WAVELENGTH, delay=delays)
    torch.testing.assert_close(found, (delays.abs() / tau0) ** (5 / 3), rtol=1e-10, atol=0)
    apart = torch.tensor([[r0, 0.0], [0.0, -2 * r0]], dtype=torch.float64)
    found = layers.structure_function(WAVELENGTH, baseline=apart)
    torch.testing.assert_close(
        found, 6.883877 * torch.tensor([1, 2 ** (5 / 3)], dtype=torch.float64), rtol=1e-6, atol=0
    )
    # at the time and in the direction in which the wind has carried what was seen before
    layer = Layers([5000.0], [1e-13], [(10.0, -5.0)])
    same = layer.structure_function(WAVELENGTH, direction=(2e-5, -1e-5), delay=0.01)
    assert float(same) == pytest.approx(0, abs=1e-15)
    assert float(layer.structure_function(WAVELENGTH, direction=(2e-5, -1e-5), delay=-0.01)) > 0.1


def test_an_outer_scale_lowers_the_difference_between_directions():
    """0.81 rad^2 at theta0 for one layer and L0/r0 = 140; Kolmogorov's 1 is slow to come, as (h theta0 / L0)^(1/3)."""
    layer = Layers.from_fractions(0.1, WAVELENGTH, [3000.0], [1.0])
    theta0 = layer.theta0(WAVELENGTH)

    def at(outer_scale):
        return float(layer.structure_function(WAVELENGTH, outer_scale, direction=(theta0, 0.0)))

    assert at(14.0) == pytest.approx(0.81, abs=0.005)
    assert at(14e3) == pytest.approx(1 - 0.19 / 10, abs=0.003)
    assert at(math.inf) == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(("name", "r0"), [("las_campanas", 0.16), ("mauna_kea", 0.2)])
def test_sites_have_the_r0_of_their_sources(name, r0):
    layers = named_layers(name)
    assert layers.r0(WAVELENGTH) == pytest.approx(r0, rel=1e-12)
    assert np.diff(layers.heights).min() > 0
    assert len(named_layers(name, 3).heights) == 3


SITES = {  # by height [m]: share of the turbulence and speed of the wind [m/s], as the sources print them
    "las_campanas": {
        **{250: (0.42, 10), 500: (0.03, 10), 1000: (0.06, 20), 2000: (0.16, 20)},
        **{4000: (0.11, 25), 8000: (0.10, 30), 16000: (0.12, 25)},
    },
    "mauna_kea": {
        **{500: (0.2283, 10), 1000: (0.0883, 10), 2000: (0.0666, 10)},
        **{4000: (0.1458, 10), 8000: (0.3350, 10), 16000: (0.1350, 10)},
    },
}


@pytest.mark.parametrize(("name", "r0", "wind"), [("las_campanas", 0.16, 18.67), ("mauna_kea", 0.2, 10.0)])
def test_sites_have_the_shares_and_winds_of_their_sources(name, r0, wind):
    layers, site = named_layers(name), SITES[name]
    assert layers.heights == tuple(site)
    total = sum(share for share, _ in site.values())
    shares = np.array(layers.layer_r0(WAVELENGTH)) ** (-5 / 3) * r0 ** (5 / 3)
    np.testing.assert_allclose(shares, [share / total for share, _ in site.values()], rtol=1e-12)
    assert layers.winds == tuple((float(speed), 0.0) for _, speed in site.values())
    # theta0 and tau0 are 0.314 r0 over the means of heights and winds, to the power 5/3
    high = sum(share * height ** (5 / 3) for height, (share, _) in site.items()) / total
    assert layers.theta0(WAVELENGTH) == pytest.approx(0.31427 * r0 / high**0.6, rel=2e-5)
    assert layers.tau0(WAVELENGTH) == pytest.approx(0.31427 * r0 / wind, rel=3e-4)  # winds are given to four digits


def test_unknown_profiles_are_refused_with_a_list():
    with pytest.raises(ValueError, match="'hv99' is unknown: known ones are " + ", ".join(sorted(PROFILES))):
        named_layers("hv99")


def test_arrays_and_lists_are_the_same_layers():
    heights, strengths, winds = [0.0, 1e3], [1e-13, 2e-13], [(1.0, 0.0), (0.0, 2.0)]
    made = Layers(np.array(heights), np.array(strengths), np.array(winds))
    assert made == Layers(heights, strengths, winds)
    assert Layers(heights, strengths, np.zeros((0, 2))) == Layers(heights, strengths)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (([], []), "0 heights, 0 strengths"),
        (([1.0, 2.0], [1e-13]), "2 heights, 1 strengths"),
        (([1.0], [1e-13], [(1.0, 0.0), (2.0, 0.0)]), "1 strengths and 2 winds"),
        (([-1.0], [1e-13]), "heights are .* at least 0"),
        (([1.0], [0.0]), "strengths are .* positive"),
        (([1.0], [math.nan]), "strengths are .* finite"),
        (([1.0], [1e-13], [(1.0, math.inf)]), "winds are .* finite"),
    ],
)
def test_bad_layers_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        Layers(*values)


def test_bad_arguments_are_refused():
    layers = named_layers("hv57")
    for wavelength in (0.0, -1e-6, math.nan):
        with pytest.raises(ValueError, match="wavelength is"):
            layers.r0(wavelength)
    with pytest.raises(ValueError, match=r"airmass is 0\.9"):
        layers.at_airmass(0.9)
    with pytest.raises(ValueError, match="n_layers is 0"):
        named_layers("hv57", 0)
    with pytest.raises(ValueError, match=r"r0 is 0\.0: it must be finite and positive, in m"):
        Layers.from_fractions(0.0, WAVELENGTH, [1.0], [1.0])
    with pytest.raises(ValueError, match=r"wavelength is -1: it must be finite and positive, in m"):
        Layers.from_fractions(0.1, -1, [1.0], [1.0])
    with pytest.raises(ValueError, match="sum of fractions is 0"):
        Layers.from_fractions(0.1, WAVELENGTH, [1.0], [0.0])
