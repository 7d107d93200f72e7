"""Whole restorations in a broad band with aberrations common to all frames, from frames the model itself has made."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution

WAVELENGTHS = (500e-9, 550e-9, 600e-9)


@pytest.mark.parametrize(
    ("band", "message"),
    [
        ({"weights": (1.0,)}, "weights are given without wavelengths"),
        ({"wavelengths": ()}, "0 wavelengths have 0 weights"),
        ({"wavelengths": (5e-7, 6e-7), "weights": (1.0,)}, "2 wavelengths have 1 weights"),
        ({"wavelengths": (5e-7, math.nan)}, "wavelengths are"),
        ({"wavelengths": (5e-7, 6e-7), "weights": (1.0, 0.0)}, "weights are"),
        ({"wavelengths": (3e-7, 5.5e-7)}, "undersamples an aperture"),
    ],
)
def test_bands_that_make_no_sense_are_refused(band, message, three_holes):
    with pytest.raises(ValueError, match=message):
        MyopicDeconvolution(three_holes, Grid((12, 15), 2.3e-7, 550e-9), n_modes=3, **band)


@pytest.fixture(scope="module")
def observed():
    """Two stars in a band of 20 %, through strong aberrations that stay and weak ones that change."""
    grid = Grid.nyquist(1.0, 550e-9, 40, oversampling=1.2)
    aperture = SparseAperture([[0.0, 0.33], [0.3, -0.18], [-0.3, -0.14]], 0.34, 1.0)
    truth = ExposureModel(aperture, grid, 6, Band.of(WAVELENGTHS))
    generator = torch.Generator().manual_seed(5)
    common = 0.4 * torch.randn(1, 3, 6, dtype=torch.float64, generator=generator)
    own = 0.2 * torch.randn(8, 3, 3, dtype=torch.float64, generator=generator)
    coefficients = common + torch.nn.functional.pad(own, (0, 3))
    scene = torch.zeros(truth.window.field.shape, dtype=torch.float64)
    scene[20, 18], scene[16, 23] = 9e5, 1e5
    frames = torch.poisson(truth(scene, coefficients.flatten(1)), generator=generator)
    return grid, aperture, frames + 2 * torch.randn(frames.shape, dtype=torch.float64, generator=generator)


def test_restoration_with_the_band_explains_what_one_wavelength_cannot(observed):
    grid, aperture, frames = observed
    options = {"n_modes": 3, "static_modes": 6, "r0": 0.6, "readout_noise": 2.0, "max_iterations": 300}
    broad = MyopicDeconvolution(aperture, grid, wavelengths=WAVELENGTHS, **options).restore(frames)
    narrow = MyopicDeconvolution(aperture, grid, **options).restore(frames)
    assert broad.chi_square.mean() < 0.5 * narrow.chi_square.mean()
    assert broad.coefficients.shape == (8, 3, 6)
    assert broad.coefficients.std(0)[:, 3:].max() < 1e-12  # they have stayed common, whatever a processor rounds
    secondary = broad.object.clone()
    secondary[18:23, 16:21] = 0  # the primary and its neighbours
    row, column = divmod(int(secondary.argmax()), 40)
    assert abs(row - 16) <= 1
    assert abs(column - 23) <= 1


def test_warm_start_goes_on_with_what_is_common(observed):
    grid, aperture, frames = observed
    options = {"readout_noise": 2.0, "static_modes": 6, "max_iterations": 100, "wavelengths": WAVELENGTHS}
    method = MyopicDeconvolution(aperture, grid, 3, 0.6, **options)
    first = method.restore(frames[:6])
    again = method.restore(frames, start=first)
    assert again.cost[0] < method.restore(frames).cost[30]
    assert again.coefficients.std(0)[:, 3:].max() < 1e-6
