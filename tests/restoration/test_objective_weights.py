"""What an objective weighs by: precisions in the Hessian of the object, priors of what is common, and neutral light."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.pixel import SquarePixel
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.state import Calibration
from torchmask.restoration.variation import TotalVariation

GRID = Grid((16, 18), 2.3e-7, 550e-9)


def test_the_hessian_in_the_object_has_the_mean_precision_of_each_frame(random_exposures, three_holes):
    """Times the power of its transfer function, of optics and pixels, and times transmission squared over inflation.

    Averaged over objects this is exact without a margin: the trace of J^T W J is the sum of the precisions times the
    energy of the point-spread function, for uneven precision too.
    """
    pixel = SquarePixel(0.9)
    basis = turbulent_basis(three_holes, 3, 0, 0.3, 20.0)
    model, image, z, frames, precision = random_exposures(
        ExposureModel(three_holes, GRID, basis, margin=0.0, pixel=pixel)
    )
    precision[:, :4, 3:9] = 0  # not valid
    transmission, inflation = torch.tensor([[0.7, 1.0, 1.3], [1.0, 4.0, 1.5]], dtype=torch.float64)
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    power = objective.object_quadratic(image, z, Calibration(transmission, inflation, 1.0))[1]
    transfer = torch.fft.rfft2(model.psf(z)) * model.response
    weight = (precision.mean((1, 2)) * transmission**2 / inflation)[:, None, None]
    torch.testing.assert_close(power, (weight * transfer.abs() ** 2).sum(0), rtol=1e-9, atol=0)
    # each unit of the object, weighed by the pixels to which it goes
    units = torch.eye(image.numel(), dtype=torch.float64).view(-1, *image.shape)
    made = torch.fft.irfft2(torch.fft.rfft2(units)[:, None] * transfer, s=image.shape)
    scaled = objective.scaled_data(Calibration(transmission, inflation, 1.0)).precision
    trace = float((scaled * made**2).sum())
    full = torch.fft.fft2(torch.fft.irfft2(power, s=image.shape)).real
    torch.testing.assert_close(float(full.sum()), trace, rtol=1e-9, atol=0)


@pytest.mark.parametrize("weight", [0.0, 2.5])
def test_common_aberrations_have_a_prior_if_any_has(weight, random_exposures, three_holes):
    """Once in all frames, and of weight 1, as turbulence is not what they follow."""
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common=5)
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis))
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    ones = torch.ones(3, dtype=torch.float64)
    z = basis.with_common_of(z, z[:1])
    without, held = (objective(image, z, Calibration(ones, ones, value)) for value in (0.0, weight))
    squares = z.square()
    expected = 0.5 * (weight * float(squares[:, :7].sum()) + float(squares[0, 7:].sum())) if weight else 0.0
    assert float(held - without) == pytest.approx(expected, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("background", [Background.PER_FRAME, Background.COMMON])
def test_neutral_transmissions_are_those_of_the_light_above_a_sky(background, three_holes):
    """The sky is that of the darkest part of the field; where it is common, that of all frames."""
    grid = Grid.nyquist(1.0, 550e-9, 32)
    light = torch.zeros(grid.shape, dtype=torch.float64)
    light[10:20, 12:22] = 5.0
    transmission = torch.tensor([0.5, 1.0, 1.5], dtype=torch.float64)
    frames = transmission[:, None, None] * light + 7.0
    model = ExposureModel(three_holes, grid, 3, background=background)
    objective = MyopicObjective(model, frames, torch.ones(1, 1, 1).double(), TotalVariation())
    torch.testing.assert_close(objective.neutral_calibration().transmission, transmission, rtol=1e-9, atol=0)
