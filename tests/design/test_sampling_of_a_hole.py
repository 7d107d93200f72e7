"""Pixels so coarse that the OTF of a single hole overlaps itself are refused, at the shortest wavelength of a band."""

import re

import pytest

from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

HOLE, SHORTEST = 0.5, 450e-9


def refusal(pixel_scale):
    grid, mask = Grid(32, pixel_scale, 550e-9), SparseAperture([[-1.0, 0.0], [1.0, 0.0]], HOLE, 4.0)
    band = [SHORTEST, 550e-9, 650e-9]
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=0.8, wavelengths=band)
    with pytest.raises(ValueError, match=r"overlaps itself: pixel_scale must be at most") as told:
        criterion(mask)
    return str(told.value)


def test_the_shortest_wavelength_says_how_fine_pixels_must_be():
    """Two pixels to a fringe of the widest baseline within a hole, its diameter: the wavelength of the grid would do
    with 550 / 450 as coarse ones."""
    needed = SHORTEST / (2 * HOLE)
    for factor in (1.001, 1.1, 1.2):
        told = refusal(factor * needed)
        assert f"reaches {0.5 * factor:.3f} cycles/pixel" in told
        # a little below, so that seven digits are never above
        assert float(re.search(r"at most (\S+) rad", told)[1]) == pytest.approx(needed, rel=2e-6)
