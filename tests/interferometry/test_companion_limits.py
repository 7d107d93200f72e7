"""Where companions are looked for, and how faint they may be, in closed form."""

import math

import numpy as np
import pytest
import torch

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import SIGNIFICANCE, DetectionLimits, detection_limits, search_offsets


def test_offsets_are_a_raster_between_two_separations():
    offsets = search_offsets(0.04, least=0.11, most=0.5) / ARCSEC
    away = torch.linalg.vector_norm(offsets, dim=1)
    assert 0.11 < away.min() < away.max() < 0.5
    steps = offsets / 0.04
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-12)
    assert len(steps.round().unique(dim=0)) == len(offsets)
    line = np.arange(-13, 14) * 0.04
    radius = np.hypot(*np.meshgrid(line, line))
    assert len(offsets) == ((radius > 0.11) & (radius < 0.5)).sum()


def test_limits_are_the_scatter_of_each_annulus():
    """Contrasts that grow with the square of the separation, of either sign."""
    offsets = search_offsets(0.02)
    away = torch.linalg.vector_norm(offsets, dim=1) / ARCSEC
    sign = torch.where(torch.arange(len(away)) % 2 == 0, 1.0, -1.0)
    limits = detection_limits(offsets, sign * away**2)
    np.testing.assert_allclose(limits.separation, [0.15, 0.25, 0.35, 0.45, 0.55, 0.65], rtol=1e-12)
    for middle, limit in zip(limits.separation, limits.contrast, strict=True):
        # the rms of r^2 over an annulus: r^6 / 6 between its borders, over r^2 / 2; the last ends with the raster
        low, high = max(middle - 0.075, 0.1), min(middle + 0.075, 0.7)
        expected = ((high**6 - low**6) / 3 / (high**2 - low**2)) ** 0.5
        assert limit / SIGNIFICANCE == pytest.approx(expected, rel=0.05)  # of a raster of 0.02 arcsec


def test_between_annuli_limits_are_linear_and_beyond_them_constant():
    limits = DetectionLimits(np.array([0.1, 0.3]), np.array([0.02, 0.01]), np.array([0.002, 0.001]))
    offsets = torch.tensor([[[0.06, 0.08], [0.0, 0.25]], [[0.0, 0.0], [-3.0, 4.0]]], dtype=torch.float64) * ARCSEC
    expected = torch.tensor([[0.02, 0.0125], [0.02, 0.01]], dtype=torch.float64)
    torch.testing.assert_close(limits(offsets), expected, rtol=1e-12, atol=0)


def test_the_error_of_a_limit_is_that_of_an_rms_of_independent_squares():
    """As drawn: the scatter over many rings of the rms of as many normal numbers as squares of 0.1 arcsec fit in."""
    offsets = search_offsets(0.05)
    limits = detection_limits(offsets, torch.full((len(offsets),), 1e-3, dtype=torch.float64))
    generator = torch.Generator().manual_seed(0)
    for middle, limit, error in zip(limits.separation, limits.contrast, limits.errors, strict=True):
        n = round(2 * math.pi * middle / 0.1)
        drawn = torch.randn(4000, n, generator=generator, dtype=torch.float64).square().mean(1).sqrt()
        # the standard deviation of 4000 numbers is known to 1.1 %; that of an rms of n is 1 / (2 n)^(1/2) but for a
        # relative 1 / (8 n), and n is rounded by a half at most, which changes it by 1 / (4 n)
        assert error / limit == pytest.approx(float(drawn.std()), rel=4 / math.sqrt(2 * 4000) + 3 / (8 * n))
