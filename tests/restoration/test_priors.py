"""Total variation against its definition and gradient; the whitening against the covariance it factors."""

import pytest
import torch

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.restoration.priors import total_variation, total_variation_curvature, whitening


def test_total_variation_of_known_images():
    step = torch.zeros(8, 10, dtype=torch.float64)
    step[2:6, 3:7] = 5.0
    # A square of side 4 and height 5: 16 unit edges, but at one corner both differences fall on one pixel.
    assert float(total_variation(step, 1e-9)[0]) == pytest.approx(5 * (14 + 2**0.5), rel=1e-6)
    assert float(total_variation(torch.full((4, 4), 3.0))[0]) == 0
    diagonal = torch.zeros(8, 8, dtype=torch.float64)
    diagonal[3, 3] = 1
    assert float(total_variation(diagonal, 1e-9)[0]) == pytest.approx(2 + 2**0.5, rel=1e-6)  # isotropic, not 4


def test_total_variation_gradient():
    image = torch.rand(5, 6, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    for epsilon in (0.01, 0.3):
        value, gradient = total_variation(image, epsilon)
        (expected,) = torch.autograd.grad(value, image)
        assert (gradient - expected).abs().max() < 1e-12
    flat = torch.ones(3, 3)
    assert total_variation(flat)[1].abs().max() == 0


def test_curvature_majorises():
    """A quadratic in one pixel with that curvature lies above TV everywhere and touches it at the image."""
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(6, 7, dtype=torch.float64, generator=generator)
    value, gradient = total_variation(image)
    curvature = total_variation_curvature(image)
    for step in (-2.0, -0.1, -0.001, 0.001, 0.1, 2.0):
        moved = image.clone()
        moved[2, 3] += step
        bound = value + gradient[2, 3] * step + 0.5 * curvature[2, 3] * step**2
        assert float(total_variation(moved)[0]) <= float(bound) + 1e-12


@pytest.mark.parametrize("aperture", [SparseAperture([[0.0, 0.3], [0.3, -0.2]], 0.2, 1.0), FullAperture(1.0)])
def test_whitening_factors_the_covariance_without_the_common_piston(aperture):
    n_sub, n_modes = aperture.n_subapertures, 4
    factor = whitening(aperture, n_modes, 0.15, 20.0)
    assert factor.shape == (n_sub * n_modes, n_sub * n_modes - 1)
    common = torch.zeros(n_sub, n_modes, dtype=torch.float64)
    common[:, 0] = n_sub**-0.5
    common = common.flatten()
    covariance = modal_covariance(aperture, n_modes, 0.15, 20.0)
    scale = covariance.abs().max()
    assert (common @ factor).abs().max() < 1e-6 * scale**0.5
    # What is left of the covariance is what no mean piston enters.
    other = torch.eye(n_sub * n_modes, dtype=torch.float64) - torch.outer(common, common)
    assert (factor @ factor.T - other @ covariance @ other).abs().max() < 1e-11 * scale
