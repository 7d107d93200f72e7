"""The exposure model against the PSF layer, and its adjoint against autograd and finite differences."""

import math

import pytest
import torch
from torchmask.restoration.model import ExposureModel, fast_size, weighted_misfit

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import ZernikePhase

GRID = Grid((12, 15), 2.75e-7, 550e-9)


def mask(dtype=torch.float64):
    return SparseAperture(torch.tensor([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]], dtype=dtype), 0.36, 1.0)


def setup(dtype=torch.float64, aperture=None, n_frames=3, n_modes=4):
    model = ExposureModel(aperture or mask(), GRID, n_modes, dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(model.field.shape, dtype=torch.float64, generator=generator)
    z = 0.5 * torch.randn(n_frames, model.n_parameters, dtype=torch.float64, generator=generator)
    frames = torch.rand(n_frames, *GRID.shape, dtype=torch.float64, generator=generator).to(dtype)
    precision = torch.rand(frames.shape, dtype=torch.float64, generator=generator).to(dtype)
    return model, image, z, frames, precision


@pytest.mark.parametrize("aperture", [mask(), FullAperture(0.9), FullAperture(0.9, 0.3)])
def test_psf_is_that_of_the_layer_without_the_deconvolution_of_its_cells(aperture):
    model, _, z, _, _ = setup(aperture=aperture)
    phase = ZernikePhase(aperture, model.field, 4)(z.unflatten(1, (-1, 4)))
    cells = [torch.sinc(torch.fft.fftfreq(side, dtype=torch.float64)) ** 2 for side in model.field.shape]
    expected = psf_from_samples(aperture.samples(model.field), phase) * cells[0][:, None] * cells[1]
    expected = expected / expected.sum((1, 2), keepdim=True)
    assert (model.psf(z).sum((1, 2)) - 1).abs().max() < 1e-13
    assert (model.psf(z) - expected).abs().max() < 1e-14


def test_forward_is_a_convolution_seen_through_the_window():
    """Brute force over every pixel of the object, on a periodic field."""
    model, image, z, _, _ = setup()
    psf, expected = model.psf(z[:1])[0], torch.zeros(GRID.shape, dtype=torch.float64)
    for row in range(GRID.shape[0]):
        for column in range(GRID.shape[1]):
            expected[row, column] = (psf.roll((-row, -column), (0, 1)).flip(0, 1).roll((1, 1), (0, 1)) * image).sum()
    assert (model(image, z[:1])[0] - expected).abs().max() < 1e-13
    rows, columns = model.field.shape
    assert rows >= 1.25 * GRID.shape[0]
    assert columns >= 1.25 * GRID.shape[1]


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_misfit_and_gradients_are_those_of_autograd(dtype, rounding):
    model, image, z, frames, precision = setup(dtype)
    image.requires_grad_()
    z.requires_grad_()
    per_frame = 0.5 * (precision * (model(image, z) - frames) ** 2).sum((1, 2))
    by_image, by_z = torch.autograd.grad(per_frame.sum(), (image, z))
    result = model.misfit(image.detach(), z.detach(), frames, precision)
    assert torch.allclose(result.value, per_frame.double(), rtol=rounding)
    assert (result.object_gradient - by_image).abs().max() < rounding * by_image.abs().max()
    assert (result.aberration_gradient - by_z).abs().max() < rounding * by_z.abs().max()
    assert by_z.abs().max() > 0


def test_gradcheck_of_the_autograd_node():
    model, image, z, frames, precision = setup(n_frames=2)
    image.requires_grad_()
    z.requires_grad_()
    assert torch.autograd.gradcheck(lambda o, a: weighted_misfit(model, o, a, frames, precision), (image, z))


def test_gradients_at_zero_aberrations_and_zero_object():
    """The degenerate start: the gradient in z vanishes with the object, and nothing is NaN."""
    model, image, z, frames, precision = setup()
    zero = model.misfit(torch.zeros_like(image), torch.zeros_like(z), frames, precision)
    assert zero.aberration_gradient.abs().max() == 0
    assert bool(torch.isfinite(zero.object_gradient).all())


def test_unwanted_gradients_are_not_computed_and_chunks_do_not_show(monkeypatch):
    model, image, z, frames, precision = setup(n_frames=5)
    whole = model.misfit(image, z, frames, precision)
    monkeypatch.setattr("torchmask.restoration.model._CHUNK", 2 * 16 * math.prod(model.field.shape))
    assert len(list(model.chunks(5))) == 3
    parts = model.misfit(image, z, frames, precision)
    for one, other in zip(whole, parts, strict=True):
        assert (one - other).abs().max() < 1e-12 * one.abs().max()
    bare = model.misfit(image, z, frames, precision, want_object=False, want_aberrations=False)
    assert bare.object_gradient is None
    assert bare.aberration_gradient is None
    assert torch.equal(bare.value, parts.value)


def test_curvature_is_the_diagonal_of_the_gauss_newton_hessian():
    """Against the explicit Jacobian; the estimate from noise has a known scatter, chi-square of its degrees."""
    model, image, z, _, precision = setup(n_frames=30, n_modes=3)
    jacobians = [torch.autograd.functional.jacobian(lambda a: model(image, a[None])[0], a) for a in z]
    exact = torch.stack([(j**2 * w[..., None]).sum((0, 1)) for j, w in zip(jacobians, precision, strict=True)])
    estimate, pixel = model.curvature(image, z, precision, torch.Generator().manual_seed(1))
    scatter = (2 / 4 * (exact**2).sum(0)).sqrt() / len(z)  # four draws per frame, each of relative variance 2
    assert ((estimate - exact.mean(0)).abs() < 4.5 * scatter).all()
    middle = torch.zeros_like(image)
    middle[GRID.shape[0] // 2, GRID.shape[1] // 2] = 1
    brute = float((precision.mean((1, 2), keepdim=True) * model(middle, z) ** 2).sum())
    assert brute < pixel < 1.6 * brute  # `pixel` counts light that falls outside the window as well


@pytest.mark.parametrize("n", [1, 2, 3, 31, 161, 1000])
def test_fast_size(n):
    size = fast_size(n)
    assert size >= n
    assert size % 2 == 0
    for prime in (2, 3, 5):
        while size % prime == 0:
            size //= prime
    assert size == 1
