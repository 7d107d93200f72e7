"""The criterion under turbulence where closed forms are known: as r0 grows, E|OTF|^2 is the square of the OTF."""

import itertools

import torch

from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, 32)
PSDS = PowerLawPSD(1.5, 1e5), NoisePSD(1e5)


def test_without_turbulence_lenses_of_holes_that_overlap_share_all_with_their_own_opposites():
    """Holes half a diameter apart transmit a baseline and its opposite at the same frequencies, and both at those of
    the holes with themselves. The phase differs by 3e-5 rad^2 across the pupil with r0 of a kilometre; splines of 48
    steps to a hole round a lens off by some 1e-3 of its middle."""
    criterion = TurbulentMSE(GRID, *PSDS, 20, r0=1e3)
    for centers in ([[-0.06, 0.0], [0.06, 0.03]], [[0.0, 0.0], [0.1, 0.05], [0.3, 0.1]]):
        mask = SparseAperture(centers, 0.25, 1.0)
        found, expected = criterion.expected_power(mask), analytic_otf(mask, GRID).abs() ** 2
        bright = expected > 0.02 / len(centers) ** 2
        assert int(bright.sum()) > 50
        torch.testing.assert_close(found[bright], expected[bright], rtol=0.005, atol=0)
        assert (found - expected).abs().max() < 0.002


def test_without_turbulence_wavelengths_that_leave_the_frequency_torus_alias():
    """A pair of holes nearly as far apart as the torus allows lies, in light of 0.87 of the reference wavelength, three
    small holes beyond its border, and comes in from the other side. Splines of 48 steps to a hole err by 48^-4 but at
    its edge and its tip, for which 2e-4 of the brightest pixel are allowed."""
    grid, wavelengths, shares = Grid.nyquist(1.0, 550e-9, 96), (480e-9, 620e-9), (0.4, 0.6)
    criterion = TurbulentMSE(grid, *PSDS, 20, r0=1e3, wavelengths=wavelengths, weights=shares)
    nu_y, nu_x = grid.frequencies(torch.float64)
    nu = torch.stack(torch.broadcast_tensors(nu_x, nu_y), -1)
    away = nu.norm(dim=-1) > 0.1  # from the light of holes with themselves
    for end in ([0.48, 0.01], [0.01, -0.48], [0.47, 0.48]):
        mask = SparseAperture([end, [-end[0], -end[1]]], 0.03, 1.5)
        expected = torch.zeros(grid.shape, dtype=torch.float64)
        for (wavelength, share), *turns, sign in itertools.product(
            zip(wavelengths, shares, strict=True), (-1, 0, 1), (-1, 0, 1), (-1, 1)
        ):
            baselines = (nu + torch.tensor(turns)) * grid.period * wavelength / grid.wavelength
            expected += (share / 2 * mask.shape.otf(baselines - sign * 2 * mask.centers[0], 0.03)) ** 2
        assert expected[away].max() > 0.02
        torch.testing.assert_close(criterion.expected_power(mask)[away], expected[away], rtol=0, atol=1e-5)
