"""The model to first order against automatic differentiation, and its adjoint."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration import linearization
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.linearization import Linearization

GRID = Grid.nyquist(1.0, 550e-9, (20, 24))


def setup(dtype=torch.float64, band=None):
    angles = torch.arange(4, dtype=dtype) * math.pi / 2
    mask = SparseAperture(torch.stack([angles.cos(), angles.sin()], -1) * 0.37, 0.25, 1.0)
    model = ExposureModel(mask, GRID, 3, band, dtype=dtype)
    generator = torch.Generator().manual_seed(0)
    shape = (5, 3, model.aberrations.n_parameters)
    image = torch.rand(model.window.field.shape, dtype=dtype, generator=generator)
    changes = torch.randn(5, *model.window.field.shape, dtype=dtype, generator=generator)
    z = 0.5 * torch.randn(shape[1:], dtype=dtype, generator=generator)
    return model, image, z, changes, torch.randn(shape, dtype=dtype, generator=generator), generator


@pytest.mark.parametrize("band", [None, Band.of((560e-9, 600e-9))])
def test_forward_is_the_derivative(band):
    model, image, z, images, zs, _ = setup(band=band)
    linear = Linearization(model, image, z).forward(images, zs)
    for number in range(len(images)):
        exact = torch.autograd.functional.jvp(model, (image, z), (images[number], zs[number]))[1]
        torch.testing.assert_close(linear[number], exact, rtol=1e-10, atol=1e-12 * float(exact.abs().max()))


@pytest.mark.parametrize("n_bytes", [1, 2**30])
@pytest.mark.parametrize("band", [None, Band.of((560e-9, 600e-9))])
def test_modes_are_changes_of_one_aberration_each(band, n_bytes, monkeypatch):
    model, image, z, *_ = setup(band=band)
    tangent, n = Linearization(model, image, z), 4
    monkeypatch.setattr(linearization, "_AT_A_TIME", AtATime(processor=n_bytes, gpu=1))
    each = torch.eye(n, z.shape[1], dtype=z.dtype)[:, None].expand(-1, len(z), -1)
    expected = tangent.forward(torch.zeros(n, *image.shape, dtype=z.dtype), each)
    found = tangent.by_modes(n)
    assert found.shape == (n, len(z), *GRID.shape)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-13 * float(expected.abs().max()))


@pytest.mark.parametrize("n_bytes", [2**17, 2**30])
def test_as_many_changes_at_a_time_as_suit_the_device(n_bytes, monkeypatch):
    """Three of five at a time, and all, give what single ones give, to the rounding of other orders of sums."""
    model, image, z, images, zs, _ = setup()
    tangent = Linearization(model, image, z)
    expected = tangent.forward(images, zs)
    monkeypatch.setattr(linearization, "_AT_A_TIME", AtATime(processor=n_bytes, gpu=1))
    torch.testing.assert_close(tangent.forward(images, zs), expected, rtol=0, atol=1e-13 * float(expected.abs().max()))


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_adjoint(dtype, rounding):
    """<J x, y> = <x, J^T y>, to the rounding of sums of a few thousand terms."""
    model, image, z, images, zs, generator = setup(dtype)
    tangent = Linearization(model, image, z)
    frames = torch.randn(5, 3, *GRID.shape, dtype=dtype, generator=generator)
    by_image, by_z = tangent.adjoint(frames)
    forward = tangent.forward(images, zs)
    left = (forward * frames).sum((1, 2, 3))
    right = (images * by_image).sum((1, 2)) + (zs * by_z).sum((1, 2))
    size = forward.flatten(1).norm(dim=1) * frames.flatten(1).norm(dim=1)
    assert float(((left - right).abs() / size).max()) < rounding
