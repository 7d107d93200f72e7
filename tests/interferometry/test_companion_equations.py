"""The equations of a fit against dense ones: all derivatives by autograd of the images, in one row of parameters."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.companion import CompanionModel, Exposures, Parameters
from torchmask.interferometry.companion_equations import (
    BLUR,
    BLUR_RMS,
    OWN_RMS,
    STATIC_RMS,
    LeastSquares,
    NormalEquations,
)
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band

GRID = Grid.nyquist(1.0, 550e-9, 16, oversampling=1.2)


@pytest.fixture(scope="module")
def model():
    mask = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.2, 1.0)
    return CompanionModel(mask, GRID, 4, Band.of([550e-9]), radius=6.0, flux_error=0.02)


@pytest.fixture(scope="module")
def at():
    generator = torch.Generator().manual_seed(0)
    own = 0.05 * torch.randn(3, 13, dtype=torch.float64, generator=generator)
    own[:, :4] += torch.tensor([1e4, 3.0, 8.0, 8.0], dtype=torch.float64)
    static = 0.2 * torch.randn(12, dtype=torch.float64, generator=generator)
    companion = torch.tensor([0.1, 1.5, -2.0], dtype=torch.float64)
    return Parameters(static, torch.tensor([0.15, 0.05], dtype=torch.float64), own, companion)


@pytest.fixture(scope="module")
def exposures(model, at):
    """Frames that are not quite the model's, each with its own direction of north, and a dead pixel."""
    generator = torch.Generator().manual_seed(1)
    angles = torch.tensor([0.1, 0.5, 2.0], dtype=torch.float64)
    to_pixels = torch.stack([angles.cos(), angles.sin(), -angles.sin(), angles.cos()], -1).view(3, 2, 2)
    frames = model.images(at, to_pixels)
    frames = frames + 10 * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    valid = torch.ones(frames.shape, dtype=torch.bool)
    valid[1, 8, 9] = False
    return Exposures(frames, torch.full_like(frames, 10.0), valid, to_pixels)


def row(at, free):
    return torch.cat([at.static, at.blur, at.own.flatten(), at.companion[: 3 * free]])


def dense(model, exposures, at, free):
    """Weighted residuals (T, pixels) and their derivatives (T, pixels, P)."""
    weights = model.root_weights(exposures)

    def images(p):
        static, blur, own, companion = p.split([12, 2, 39, 3 * free])
        found = Parameters(static, blur, own.view(3, 13), companion if free else at.companion)
        return (model.images(found, exposures.to_pixels) * weights).flatten(1)

    jacobian = torch.autograd.functional.jacobian(images, row(at, free))
    return (exposures.frames * weights).flatten(1) - images(row(at, free)), jacobian


@pytest.mark.parametrize("free", [False, True])
def test_the_equations_are_those_of_all_derivatives(model, exposures, at, free):
    problem = LeastSquares(model, exposures, free)
    normal = problem.normal_equations(at)
    residual, jacobian = dense(model, exposures, at, free)
    matrices = torch.einsum("txp,txq->tpq", jacobian, jacobian)
    scale = matrices.sum(0).diagonal().sqrt()
    rounding = {"rtol": 0, "atol": 1e-11}
    torch.testing.assert_close(normal.matrices / scale / scale[:, None], matrices / scale / scale[:, None], **rounding)
    vectors = torch.einsum("txp,tx->tp", jacobian, residual)
    torch.testing.assert_close(normal.vectors / scale, vectors / scale, rtol=0, atol=1e-11 * float(residual.norm()))
    # what is expected beforehand: aberrations around 0, the blur around its own value, nothing of the rest
    own = 4 * [torch.inf] + 9 * [OWN_RMS**2]
    variances = 12 * [STATIC_RMS**2] + 2 * [BLUR_RMS**2] + 3 * own + 3 * free * [torch.inf]
    precision = 1 / torch.tensor(variances, dtype=torch.float64)
    torch.testing.assert_close(normal.prior_matrix, torch.diag(precision), rtol=1e-12, atol=0)
    expected = torch.zeros(len(precision), dtype=torch.float64)
    expected[12:14] = BLUR
    torch.testing.assert_close(normal.prior_vector, precision * (expected - row(at, free)), rtol=1e-12, atol=0)
    cost = float((residual**2).sum() + (precision * (row(at, free) - expected) ** 2).sum())
    assert problem.cost(at) == pytest.approx(cost, rel=1e-12)


@pytest.mark.parametrize("free", [False, True])
def test_a_step_goes_where_its_row_says(model, exposures, at, free):
    change = torch.arange(53 + 3 * free, dtype=torch.float64)
    moved = LeastSquares(model, exposures, free).move(at, change)
    torch.testing.assert_close(row(moved, free) - row(at, free), change, rtol=0, atol=1e-11)
    if not free:
        assert torch.equal(moved.companion, at.companion)


def test_leaving_an_exposure_out_is_giving_it_no_weight(model, exposures, at):
    normal = LeastSquares(model, exposures, True).normal_equations(at)
    blind = Exposures(exposures.frames, exposures.errors, exposures.valid.clone(), exposures.to_pixels)
    blind.valid[1] = False
    without = LeastSquares(model, blind, True).normal_equations(at)
    torch.testing.assert_close(normal.solve(leave_out=1)[-3:], without.solve()[-3:], rtol=1e-6, atol=0)
    assert (normal.solve()[-3:] / without.solve()[-3:] - 1).abs().min() > 1e-3


def test_equations_of_wildly_different_scales_are_solved():
    scale = torch.tensor([1e-8, 1.0, 1e7], dtype=torch.float64)
    matrix = torch.tensor([[2.0, 0.5, 0.1], [0.5, 1.0, 0.3], [0.1, 0.3, 3.0]], dtype=torch.float64)
    truth = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64) / scale
    halves = torch.stack([matrix, matrix]) / 2 * scale * scale[:, None]
    normal = NormalEquations(halves, halves @ truth, torch.zeros(3, 3).double(), torch.zeros(3).double())
    # the ridge of 1e-12 of the scaled matrix moves the solution by that times its condition number
    torch.testing.assert_close(normal.solve(), truth, rtol=1e-11, atol=0)
    torch.testing.assert_close(normal.solve(leave_out=0), truth, rtol=1e-11, atol=0)
