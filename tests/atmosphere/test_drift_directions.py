"""Winds of all directions: the mean over them of high powers of the drift, which a few directions get wrong."""

import math

import pytest
import torch

from torchmask.atmosphere.seeing import Seeing


@pytest.mark.parametrize("power", [2, 4, 8, 12])
@pytest.mark.parametrize("turn", [0.0, 0.3])
def test_powers_of_the_drift_along_any_axis(power, turn):
    """Lags have the density 2 (1 - u), of which the mean of u^n is 2 / ((n + 1) (n + 2)); cos^n has its own mean."""
    steps, shares = Seeing(0.15, 20.0, 3e-3, 12.0).drift()
    along = steps / (3e-3 * 12.0) @ torch.tensor([math.cos(turn), math.sin(turn)], dtype=torch.float64)
    circle = math.comb(power, power // 2) / 2**power
    expected = 2 / ((power + 1) * (power + 2)) * circle
    # seven lags are exact up to u^13, eight directions over half a turn up to cos^14
    assert float(shares @ along**power) == pytest.approx(expected, rel=1e-11)
