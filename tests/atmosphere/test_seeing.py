"""Exposures under a frozen wind: coherence times and the lags between two instants."""

import math

import numpy as np
import pytest
import torch

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.von_karman import STRUCTURE_CONSTANT


# The integral of 2 (1 - x) exp(-(x T / tau0)^(5/3)) over [0, 1], by adaptive quadrature
@pytest.mark.parametrize(("ratio", "kept"), [(0.5, 0.940), (1.0, 0.832), (2.0, 0.620), (4.0, 0.378)])
@pytest.mark.parametrize("wind", [10.0, (6.0, -8.0)])
def test_two_points_lose_the_contrast_that_the_coherence_time_says(ratio, kept, wind):
    still = Seeing(0.1, wind=wind)
    moving = Seeing(0.1, exposure=ratio * still.tau0, wind=wind)
    steps, weights = moving.drift()
    # two points far apart: each changes by itself, so half the variance of their difference is D
    assert float(weights @ torch.exp(-moving.structure()(steps))) == pytest.approx(kept, abs=6e-4)


def test_tau0_is_that_of_the_structure_constant():
    assert Seeing(0.1, wind=(6.0, 8.0)).tau0 == pytest.approx(STRUCTURE_CONSTANT**-0.6 * 0.01, rel=1e-12)
    assert Seeing(0.1).tau0 == math.inf


@pytest.mark.parametrize("wind", [10.0, (6.0, -8.0)])
def test_lags_have_the_moments_of_a_triangle(wind):
    steps, weights = Seeing(0.1, exposure=0.02, wind=wind).drift()
    assert float(weights.sum()) == pytest.approx(1, abs=1e-12)
    # mean square of the difference of two uniform instants: T^2 / 6
    assert float(weights @ (steps**2).sum(-1)) == pytest.approx((0.02 * 10) ** 2 / 6, rel=1e-12)


@pytest.mark.parametrize("kind", [list, np.array, torch.tensor])
def test_a_wind_is_a_pair_of_any_kind(kind):
    seeing = Seeing(0.1, exposure=1e-3, wind=kind([3.0, -4.0]))
    assert seeing == Seeing(0.1, exposure=1e-3, wind=(3.0, -4.0))
    assert hash(seeing) == hash(Seeing(0.1, exposure=1e-3, wind=(3.0, -4.0)))
    assert Seeing(0.1, exposure=1e-3, wind=kind([5.0])[0]) == Seeing(0.1, exposure=1e-3, wind=5.0)


def test_a_speed_has_no_direction():
    steps, weights = Seeing(0.1, exposure=0.02, wind=10.0).drift()
    second = (weights[:, None, None] * steps[:, :, None] * steps[:, None, :]).sum(0)
    assert float(second[0, 0]) == pytest.approx(float(second[1, 1]), rel=1e-12)
    assert abs(float(second[0, 1])) < 1e-12 * float(second[0, 0])
    assert Seeing(0.1, exposure=0.02, wind=10.0).is_isotropic
    assert not Seeing(0.1, exposure=0.02, wind=(10.0, 0.0)).is_isotropic


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"r0": -0.1}, "r0 is -0.1"),
        ({"r0": 0.1, "outer_scale": 0.0}, "outer_scale is 0.0"),
        ({"r0": 0.1, "exposure": -1.0}, "exposure is -1.0"),
        ({"r0": 0.1, "exposure": 0.01}, "without wind"),
        ({"r0": 0.1, "wind": -3.0}, "wind is -3.0"),
        ({"r0": 0.1, "wind": (1.0, 2.0, 3.0)}, "wind is"),
        ({"r0": 0.1, "wind": math.nan}, "wind is nan"),
    ],
)
def test_impossible_sites_and_exposures_are_refused(keywords, message):
    with pytest.raises(ValueError, match=message):
        Seeing(**keywords)
