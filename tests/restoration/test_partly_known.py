"""Aberrations known up to errors of known covariance, as from a wave-front sensor."""

import math

import pytest
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.restoration.aberrations import whitening
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution

GRID = Grid.nyquist(1.0, 550e-9, 40)
N_MODES, R0, ERROR = 3, 0.2, 0.4  # rad


@pytest.fixture(scope="module")
def exposures(five_holes):
    """Mask, object, frames, and the true and the measured coefficients."""
    mask = five_holes
    generator = torch.Generator().manual_seed(3)
    columns = torch.linalg.qr(whitening(mask, N_MODES, R0, 20.0).T).R.T  # unique, as eigenvectors of a ring are not
    z = torch.randn(8, columns.shape[1], dtype=torch.float64, generator=generator)
    true = (z @ (columns * columns.diagonal().sign()).T).unflatten(1, (5, N_MODES))
    model = ExposureModel(mask, GRID, N_MODES)
    scene = torch.zeros(GRID.shape, dtype=torch.float64)
    scene[16:24, 17:23] = 3
    scene[19:22, 9:30] += 1
    scene *= 1e6 / scene.sum()
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[:40, :40] = scene
    frames = torch.poisson(model(image, true.flatten(1)), generator=generator)
    measured = true + ERROR * torch.randn(true.shape, dtype=torch.float64, generator=generator)
    return mask, scene, frames, true, measured


def error(coefficients, true):
    """Rms, without the piston common to all holes, which frames cannot tell."""
    change = coefficients - true
    change[..., 0] -= change[..., 0].mean(1, keepdim=True)
    return float(change.square().mean().sqrt())


def test_refines_what_was_measured(exposures):
    mask, scene, frames, true, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES, max_iterations=400)
    fixed = method.restore(frames, coefficients=measured)
    refined = method.restore(frames, coefficients=measured, covariance=ERROR**2 * torch.eye(15))
    assert error(measured, true) == pytest.approx(ERROR, rel=4 / math.sqrt(2 * 120))  # 4 sigma of a sample deviation
    fits = refined.chi_square < 1.3  # one frame may stay in a local minimum, which it shows
    assert int(fits.sum()) >= 7
    assert error(refined.coefficients[fits], true[fits]) < 0.2 * ERROR
    assert relative_error(refined.object, scene, 0.5) < 0.5 * relative_error(fixed.object, scene, 0.5)
    assert float(fixed.chi_square.min()) > 1.3
    assert math.isnan(refined.r0)


def test_no_error_is_known_and_one_hole_may_be_worse(exposures):
    """Zero covariance moves a coefficient by less than a few mrad; only the hole with errors moves."""
    mask, _, frames, true, _ = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES)
    covariance = torch.zeros(15, 15)
    covariance[6:9, 6:9] = ERROR**2 * torch.eye(3)  # sub-aperture by sub-aperture: the third hole
    start = true.clone()
    start[:, 2] += ERROR * torch.tensor([1.0, -1.0, 1.0])
    refined = method.restore(frames, coefficients=start, covariance=covariance)
    moved = (refined.coefficients - start).abs().amax((0, 2))
    assert float(moved[[0, 1, 3, 4]].max()) < 6e-3
    fits = refined.chi_square < 1.3  # one frame may stay in a local minimum, which it shows
    assert int(fits.sum()) >= 7
    assert error(refined.coefficients[fits], true[fits]) < 0.3 * error(start[fits], true[fits])


def test_with_a_known_object(exposures):
    mask, scene, frames, true, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES)
    refined = method.restore(frames, coefficients=measured, covariance=ERROR**2 * torch.eye(15), known_object=scene)
    fits = refined.chi_square < 1.3  # one frame may stay in a local minimum, which it shows
    assert int(fits.sum()) >= 7
    assert error(refined.coefficients[fits], true[fits]) < 0.2 * ERROR


def test_what_is_known_may_be_arrays(exposures):
    mask, scene, frames, _, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES, max_iterations=3)
    told = {"coefficients": measured, "covariance": ERROR**2 * torch.eye(15, dtype=torch.float64)}
    for given in (told, {"coefficients": measured}, {"known_object": scene}):
        tensors = method.restore(frames, **given)
        for kind in (Tensor.numpy, Tensor.tolist):
            same = method.restore(frames, **{name: kind(values) for name, values in given.items()})
            assert torch.equal(same.coefficients, tensors.coefficients)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"coefficients": None}, "without coefficients"),
        ({"covariance": torch.eye(4)}, "must be \\(15, 15\\)"),
        ({"covariance": torch.full((15, 15), math.nan)}, "not finite"),
        ({"covariance": torch.ones(15, 15).triu()}, "not symmetric"),
        ({"covariance": -torch.eye(15)}, "none may be negative"),
    ],
)
def test_refuses(exposures, options, words):
    mask, _, frames, _, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES)
    with pytest.raises(ValueError, match=words):
        method.restore(frames, **({"coefficients": measured, "covariance": torch.eye(15)} | options))


def test_refuses_static_modes(exposures):
    mask, _, frames, _, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES, static_modes=3)
    with pytest.raises(ValueError, match="static_modes"):
        method.restore(frames, coefficients=measured, covariance=torch.eye(15))
