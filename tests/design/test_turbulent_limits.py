"""The criterion under turbulence where closed forms are known: as r0 grows, E|OTF|^2 is the square of the OTF."""

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
