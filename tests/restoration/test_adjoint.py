"""The misfit and its hand-written gradients against automatic differentiation; curvature against a Jacobian."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.band import Band
from torchmask.restoration.adjoint import curvature, data_fidelity
from torchmask.restoration.forward import ExposureModel

GRID = Grid((12, 15), 2.3e-7, 550e-9)
BANDS = [None, Band.of((500e-9, 550e-9, 610e-9), (1.0, 2.0, 3.0))]


@pytest.mark.parametrize("band", BANDS)
@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_misfit_and_gradients_are_those_of_autograd(dtype, rounding, band, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4, band, dtype=dtype))
    image.requires_grad_()
    z.requires_grad_()
    per_frame = 0.5 * (precision * (model(image, z) - frames) ** 2).sum((1, 2))
    by_image, by_z = torch.autograd.grad(per_frame.sum(), (image, z))
    found = data_fidelity(model, image.detach(), z.detach(), frames, precision)
    assert torch.allclose(found.value, per_frame.double(), rtol=rounding)
    assert (found.object_gradient - by_image).abs().max() < rounding * by_image.abs().max()
    assert (found.aberration_gradient - by_z).abs().max() < rounding * by_z.abs().max()
    assert by_z.abs().max() > 0
    assert found.object_gradient.dtype == found.aberration_gradient.dtype == torch.float64


def test_gradients_at_zero_aberrations_and_zero_object(three_holes, random_exposures):
    """The degenerate start: the gradient in z vanishes with the object, and nothing is NaN."""
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4))
    zero = data_fidelity(model, torch.zeros_like(image), torch.zeros_like(z), frames, precision)
    assert zero.aberration_gradient.abs().max() == 0
    assert bool(torch.isfinite(zero.object_gradient).all())


def test_unwanted_gradients_are_not_computed_and_chunks_do_not_show(monkeypatch, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4), n_frames=5)
    whole = data_fidelity(model, image, z, frames, precision)
    chunk = 2 * 16 * math.prod(model.window.field.shape)
    monkeypatch.setattr("torchmask.restoration.forward._CHUNK", AtATime(chunk, chunk))
    assert len(list(model.chunks(5))) == 3
    parts = data_fidelity(model, image, z, frames, precision)
    for one, other in zip(whole[:3], parts[:3], strict=True):
        assert (one - other).abs().max() < 1e-12 * one.abs().max()
    bare = data_fidelity(model, image, z, frames, precision, want_object=False, want_aberrations=False)
    assert bare.object_gradient is None
    assert bare.aberration_gradient is None
    assert torch.equal(bare.value, parts.value)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 1, 1), (1, 12, 15)])
def test_a_precision_for_all_frames_or_pixels_is_that_of_each(shape, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(ExposureModel(three_holes, GRID, 4), n_frames=5)
    shared = precision[: shape[0], : shape[1], : shape[2]]
    one = data_fidelity(model, image, z, frames, shared)
    other = data_fidelity(model, image, z, frames, shared.expand_as(frames))
    for a, b in zip(one, other, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-13, atol=1e-13)


def test_curvature_is_the_diagonal_of_the_gauss_newton_hessian(three_holes, random_exposures):
    """Against the explicit Jacobian; the estimate from noise has a known scatter, chi-square of its degrees."""
    grid = Grid((12, 15), 2.75e-7, 550e-9)
    model, image, z, _, precision = random_exposures(ExposureModel(three_holes, grid, 3), n_frames=30)
    jacobians = [torch.autograd.functional.jacobian(lambda a: model(image, a[None])[0], a) for a in z]
    exact = torch.stack([(j**2 * w[..., None]).sum((0, 1)) for j, w in zip(jacobians, precision, strict=True)])
    estimate, pixel = curvature(model, image, z, precision, torch.Generator().manual_seed(1))
    scatter = (2 / 4 * (exact**2).sum(0)).sqrt() / len(z)  # four draws per frame, each of relative variance 2
    assert ((estimate - exact.mean(0)).abs() < 4.5 * scatter).all()
    middle = torch.zeros_like(image)
    middle[grid.shape[0] // 2, grid.shape[1] // 2] = 1
    brute = float((precision.mean((1, 2), keepdim=True) * model(middle, z) ** 2).sum())
    assert brute < pixel < 1.6 * brute  # `pixel` counts light that falls outside the window as well
