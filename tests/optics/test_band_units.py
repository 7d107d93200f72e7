"""Wavelengths in another unit than metres, or than that of a grid, are seen wherever both are given."""

import pytest
import torch

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import mean_square_otf
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposed_psf import ExposedPSF
from torchmask.spectra import NoisePSD, PowerLawPSD

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture([[0.0, 0.3], [-0.3, -0.2], [0.3, -0.2]], 0.2, 1.0)
MICROMETRES = Band.of([0.5, 0.6])


def test_nanometres_are_refused():
    with pytest.raises(ValueError, match=r"the longest of wavelengths is 560: .* of light in m, .*; 560 nm are 560e-9"):
        Band.of([550.0, 560.0])


def test_wavelengths_may_be_in_the_units_of_a_grid():
    """As of `Grid`, in which only the wavelength over the pixel scale counts."""
    band = Band.of([0.9, 1.1])
    assert band.mean == pytest.approx(1.0)
    assert Band.given(band, 1.0) is band


def test_without_a_band_light_has_the_wavelength_of_the_grid():
    assert Band.given(None, 550e-9) == Band.of([550e-9])


@pytest.mark.parametrize(("inside", "outside"), [(0.999e3, 1.001e3), (1.001e-3, 0.999e-3)])
def test_light_a_thousand_times_from_that_of_the_grid_is_the_limit(inside, outside):
    band = Band.of([1.0])
    assert Band.given(band, inside) is band
    with pytest.raises(ValueError, match="but that of the grid is"):
        Band.given(band, outside)


@pytest.mark.parametrize(
    "use",
    [
        lambda: MyopicDeconvolution(MASK, GRID, wavelengths=[0.5, 0.6]),
        lambda: TurbulentMSE(GRID, PowerLawPSD(1.5, 1e6), NoisePSD(1e6), 10, r0=0.2, wavelengths=[0.5, 0.6]),
        lambda: mean_square_otf(MASK, GRID, torch.ones(1, 2), Seeing(0.2), MICROMETRES),
        lambda: ExposedPSF(MASK, GRID, MICROMETRES),
        lambda: ExposureModel(MASK, GRID, 3, MICROMETRES),
    ],
)
def test_micrometres_beside_a_grid_in_metres_are_refused(use):
    with pytest.raises(ValueError, match=r"wavelengths are \[0\.5, 0\.6\], but that of the grid is 5\.5e-07: .* in m"):
        use()
