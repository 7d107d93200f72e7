"""The detector's pixels in the model of the exposures, its adjoint and its tangent."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import MappedPixel, SquarePixel
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.variation import TotalVariation

GRID = Grid((12, 15), 2.3e-7, 550e-9)
MASK = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]], 0.36, 1.0)
LOPSIDED = torch.zeros(3, 5, dtype=torch.float64)
LOPSIDED[0, 1:3] = LOPSIDED[2, 4] = 1.0
PIXELS = [SquarePixel(0.8), MappedPixel(LOPSIDED, 4)]


@pytest.mark.parametrize("pixel", PIXELS)
def test_pixels_multiply_the_spectrum_of_every_frame(pixel, random_exposures):
    grid = Grid((16, 20), 2.3e-7, 550e-9)  # of sizes that are FFT-friendly: no margin is added
    blurred, image, z, _, _ = random_exposures(ExposureModel(MASK, grid, 4, pixel=pixel, margin=0.0))
    bare = ExposureModel(MASK, grid, 4, margin=0.0)
    nu_y, nu_x = torch.fft.fftfreq(16, dtype=torch.float64), torch.fft.rfftfreq(20, dtype=torch.float64)
    spectrum = torch.fft.rfft2(bare(image, z)) * pixel.transfer(nu_y[:, None], nu_x[None])
    torch.testing.assert_close(blurred(image, z), torch.fft.irfft2(spectrum, s=grid.shape))


@pytest.mark.parametrize("pixel", PIXELS)
def test_gradients_behind_pixels_are_those_of_autograd(pixel, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(MASK, GRID, 4, pixel=pixel))
    image.requires_grad_()
    z.requires_grad_()
    value = 0.5 * (precision * (model(image, z) - frames) ** 2).sum()
    by_image, by_z = torch.autograd.grad(value, (image, z))
    found = data_fidelity(model, image.detach(), z.detach(), frames, precision)
    torch.testing.assert_close(found.value.sum(), value.detach())
    torch.testing.assert_close(found.object_gradient, by_image, rtol=1e-10, atol=1e-13)
    torch.testing.assert_close(found.aberration_gradient, by_z, rtol=1e-10, atol=1e-13)


@pytest.mark.parametrize("pixel", PIXELS)
def test_the_tangent_behind_pixels_has_its_adjoint(pixel, random_exposures):
    model, image, z, frames, _ = random_exposures(ExposureModel(MASK, GRID, 4, pixel=pixel))
    tangent = Linearization(model, image, z)
    d_image, d_z = image.roll(3, 0)[None], z.roll(1, 0)[None]
    there = (tangent.forward(d_image, d_z) * frames).sum()
    by_image, by_z = tangent.adjoint(frames[None])
    torch.testing.assert_close(there, (by_image * d_image).sum() + (by_z * d_z).sum())
    step = 1e-6
    moved = (
        model(image + step * d_image[0], z + step * d_z[0]) - model(image - step * d_image[0], z - step * d_z[0])
    ) / (2 * step)
    torch.testing.assert_close(tangent.forward(d_image, d_z)[0], moved, rtol=1e-6, atol=1e-9)


def test_the_quadratic_in_the_object_knows_the_pixels(random_exposures):
    """Its Hessian is that of a full field: the gradients of two objects differ by it."""
    model, image, z, frames, _ = random_exposures(
        ExposureModel(MASK, Grid(16, 2.3e-7, 550e-9), 4, pixel=PIXELS[0], margin=0.0)
    )
    objective = MyopicObjective(model, frames, torch.ones(1, 1, 1, dtype=torch.float64), TotalVariation())
    calibration = objective.neutral_calibration()
    other = image.roll(5, 1)
    (slope, power), moved = (objective.object_quadratic(x, z, calibration) for x in (image, other))
    expected = torch.fft.irfft2(torch.fft.rfft2(other - image) * power, s=image.shape)
    torch.testing.assert_close(moved[0] - slope, expected)
