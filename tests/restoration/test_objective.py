"""The objective and its fast gradients against automatic differentiation, finite differences and known parts."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import AberrationBasis
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import TotalVariation
from torchmask.restoration.state import Calibration

GRID = Grid((12, 15), 2.3e-7, 550e-9)
BAND = Band.of((500e-9, 550e-9, 610e-9), (1.0, 2.0, 3.0))


def test_gradient_of_common_aberrations_is_that_of_one_variable(three_holes, random_exposures):
    """Central differences in one common aberration of all frames against the sum over frames; the prior counts once."""
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common=4)
    model, image, _, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis))
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    generator = torch.Generator().manual_seed(4)
    z = 0.3 * torch.randn(3, 12, dtype=torch.float64, generator=generator)
    z = basis.with_common_of(z, z[:1])
    ones = torch.ones(3, dtype=torch.float64)
    calibration = Calibration(ones, ones, 0.7)

    def cost(at):
        return float(objective.value_and_gradients(image, at, calibration).value)

    gradient = objective.value_and_gradients(image, z, calibration).aberration_gradient
    assert torch.equal(gradient[:, 8:], gradient[:1, 8:].expand(3, -1))
    for k in range(8, 12):
        step = torch.zeros_like(z)
        step[:, k] = 1e-5
        assert float(gradient[:, k].sum()) == pytest.approx((cost(z + step) - cost(z - step)) / 2e-5, rel=1e-6)
    misfits = [float(data_fidelity(model, image, at, frames, precision).value.sum()) for at in (z, z - z)]
    weight = (cost(z) - misfits[0]) - (cost(z - z) - misfits[1])
    assert weight == pytest.approx(0.5 * float(0.7 * (z[:, :8] ** 2).sum() + (z[0, 8:] ** 2).sum()), rel=1e-9)


@pytest.mark.parametrize("band", [None, BAND])
def test_gradcheck_in_object_and_aberrations(band, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4, band), n_frames=2)
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    assert torch.autograd.gradcheck(objective, (image.requires_grad_(), z.requires_grad_()))


def test_what_is_not_free_has_no_gradient(three_holes, random_exposures):
    basis = AberrationBasis(torch.eye(12, dtype=torch.float64), 4, n_common=4)
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, basis))
    z = basis.with_common_of(z, z[:1])
    whole = MyopicObjective(model, frames, precision, TotalVariation())
    everything = whole.value_and_gradients(image, z)
    for free in (Free.OBJECT, Free.ABERRATIONS, Free.COMMON, Free.ABERRATIONS | Free.COMMON):
        found = whole.with_changes(free=free).value_and_gradients(image, z)
        assert float(found.value) == pytest.approx(float(everything.value), rel=1e-14)
        parts = ((Free.OBJECT, 0, slice(None)), (Free.ABERRATIONS, 1, slice(0, 8)), (Free.COMMON, 1, slice(8, 12)))
        for which, place, columns in parts:
            gradient = found[1 + place][:, columns]
            if which in free:
                torch.testing.assert_close(gradient, everything[1 + place][:, columns], rtol=1e-12, atol=1e-12)
            else:
                assert float(gradient.abs().max()) == 0
