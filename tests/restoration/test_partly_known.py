"""Aberrations known up to errors of known covariance, as from a wave-front sensor."""

import math

import pytest
import torch
from torchmask.restoration.model import ExposureModel

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.priors import root, whitening

GRID = Grid.nyquist(1.0, 550e-9, 40)
N_MODES, R0, ERROR = 3, 0.2, 0.4  # rad


@pytest.fixture(scope="module")
def exposures():
    """Mask, object, frames, and the true and the measured coefficients."""
    angles = torch.arange(5, dtype=torch.float64) * 2 * math.pi / 5
    mask = SparseAperture(torch.stack([angles.cos(), angles.sin()], -1) * 0.38, 0.22, 1.0)
    generator = torch.Generator().manual_seed(3)
    columns = whitening(mask, N_MODES, R0, 20.0)
    z = torch.randn(8, columns.shape[1], dtype=torch.float64, generator=generator)
    true = (z @ columns.T).unflatten(1, (5, N_MODES))
    model = ExposureModel(mask, GRID, N_MODES)
    scene = torch.zeros(GRID.shape, dtype=torch.float64)
    scene[16:24, 17:23] = 3
    scene[19:22, 9:30] += 1
    scene *= 1e6 / scene.sum()
    image = torch.zeros(model.field.shape, dtype=torch.float64)
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
    method = MyopicDeconvolution(mask, GRID, N_MODES, max_iterations=1000)
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
    refined = method.restore(frames, coefficients=start, covariance=covariance).coefficients
    moved = (refined - start).abs().amax((0, 2))
    assert float(moved[[0, 1, 3, 4]].max()) < 6e-3
    assert error(refined, true) < 0.3 * error(start, true)


def test_with_a_known_object(exposures):
    mask, scene, frames, true, measured = exposures
    method = MyopicDeconvolution(mask, GRID, N_MODES)
    refined = method.restore(frames, coefficients=measured, covariance=ERROR**2 * torch.eye(15), known_object=scene)
    fits = refined.chi_square < 1.3  # one frame may stay in a local minimum, which it shows
    assert int(fits.sum()) >= 7
    assert error(refined.coefficients[fits], true[fits]) < 0.2 * ERROR


def test_root_of_a_covariance():
    """Its square is the covariance, but for errors below 1 mrad."""
    half = torch.randn(6, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    covariance = half @ half.T
    torch.testing.assert_close(root(covariance) @ root(covariance), covariance, rtol=0, atol=1.01e-6)


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


def test_full_waves_come_off_the_pistons(exposures):
    """PSFs stay as they are; no piston is left beyond half a wave, and correlated ones come no further away."""
    mask, _, _, true, _ = exposures
    waves = torch.zeros_like(true)
    waves[0, 1, 0], waves[1, 4, 0], waves[2, 0, 0] = 2 * math.pi, -4 * math.pi, 6 * math.pi
    far, nowhere = (true + waves).flatten(1), torch.zeros(8, 15, dtype=torch.float64)
    model = ExposureModel(mask, GRID, N_MODES)
    back = model.unwrapped(far, nowhere)
    torch.testing.assert_close(model.psf(back), model.psf(true.flatten(1)), rtol=0, atol=1e-12)
    assert float(back[:, ::N_MODES].abs().max()) <= math.pi
    model = ExposureModel(mask, GRID, N_MODES, whitening(mask, N_MODES, R0, 20.0))
    z = far @ torch.linalg.pinv(model.mixing).T
    back = model.unwrapped(z, nowhere[:, 1:])
    torch.testing.assert_close(model.psf(back), model.psf(z), rtol=0, atol=1e-12)
    assert bool((back.norm(dim=1) <= z.norm(dim=1) + 1e-12).all())
    assert float(back[2].norm()) < float(z[2].norm()) - 1
