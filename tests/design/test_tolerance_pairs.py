"""Errors of diameters come in pairs of opposite signs, and what is printed of them is in per cent."""

import pytest
import torch

from torchmask.design.tolerance import MachiningErrors, machining_errors
from torchmask.optics.aperture import SparseAperture

HOLE = 0.1


def test_what_is_of_first_order_in_the_diameter_cancels_in_every_pair(seeded):
    """A criterion that grows by 3 for each relative error of the diameter: a straight line, also as a spline."""
    mask = SparseAperture.from_catalog("golay6", 1.0, 6 * HOLE**2)

    def line(aperture):
        grown = aperture.subaperture_diameter / HOLE - 1
        return 2 * (1 + 3 * grown) * aperture.centers.new_ones(aperture.centers.shape[:-2])

    result = machining_errors(line, mask, diameter_rms=0.005, n_draws=64, generator=seeded(0))
    first, second = result.growth.reshape(2, -1)
    assert float(first.std()) == pytest.approx(3 * 0.05, rel=0.4)  # of 32 draws: known to 1 / 8, three times over
    torch.testing.assert_close(second, -first, rtol=0, atol=1e-12)
    mean, error = result.mean()
    assert max(abs(mean), error) < 1e-12


def test_the_summary_is_in_per_cent():
    mse = 2 * torch.linspace(1.0, 1.2, 101, dtype=torch.float64)[:100]
    result = MachiningErrors(1e-3, 2e-3, 2.0, mse)
    (mean, mean_error), (high, high_error) = result.mean(), result.quantile(0.95)
    lines = str(result).splitlines()
    assert "rms error of positions 0.001 m, of the diameter 0.002 m, 100 masks" in lines[0]
    for line, value, error in ((lines[1], mean, mean_error), (lines[2], high, high_error)):
        told = [float(word) for word in line.removesuffix(" %").split(" +- ")[0].split()[-1:]]
        told.append(float(line.removesuffix(" %").split(" +- ")[1]))
        assert told == pytest.approx([100 * value, 100 * error], abs=6e-4)
    # growth is 0, 0.2, ..., 19.8 %: its mean, and the 95th percentile by its definition
    assert (100 * mean, 100 * high) == (pytest.approx(9.9), pytest.approx(0.95 * 19.8))
