"""A band whose wavelengths lie unevenly around that of the grid, in light that turbulence leaves in peace."""

from dataclasses import replace

import pytest
import torch

from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

APART = [[0.0, 0.35], [0.3, -0.2], [-0.35, -0.1]]
REDUNDANT = [[-0.3, 0.0], [0.0, 0.05], [0.3, 0.1], [0.0, 0.35], [0.3, 0.4]]  # lenses of several pairs in one place


@pytest.mark.parametrize(("centers", "most"), [(APART, 1e-3), (REDUNDANT, 0.03)])
def test_without_turbulence_all_wavelengths_add_to_one_transfer_function(centers, most):
    """With r0 of a kilometre the phase differs by 7e-5 rad^2 across the pupil. Splines of 48 steps to a hole miss about
    a step^(3/2) where a lens ends with a cusp, some 1e-3 of what one pair gives at most. Of what lenses share, modes
    of 1 % of the light are left out, and 3 % are promised."""
    grid = Grid.nyquist(1.0, 550e-9, 32, 1.2)
    wavelengths, shares = [480e-9, 500e-9, 590e-9], [0.5, 0.2, 0.3]
    mask = SparseAperture(centers, 0.2, 1.0)
    psds = PowerLawPSD(1.5, 1e5), NoisePSD(1e5)
    found = TurbulentMSE(grid, *psds, 20, r0=1e3, wavelengths=wavelengths, weights=shares).expected_power(mask)
    otfs = [analytic_otf(mask, replace(grid, wavelength=wavelength)) for wavelength in wavelengths]
    expected = torch.stack([share * otf for share, otf in zip(shares, otfs, strict=True)]).sum(0).abs() ** 2
    reversed_ = torch.stack([share * otf for share, otf in zip(shares, otfs[::-1], strict=True)]).sum(0).abs() ** 2
    assert (found - expected).abs().max() < most / len(centers) ** 2
    assert (found - reversed_).abs().max() > 0.1 / len(centers) ** 2
