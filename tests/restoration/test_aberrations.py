"""Whitening against the covariance it factors, strength and unwrapping of aberrations, and what all frames share."""

import math

import pytest
import torch

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.restoration.aberrations import AberrationBasis, plain_basis, root, turbulent_basis, whitening
from torchmask.restoration.forward import ExposureModel

PUPIL = FullAperture(1.0)
R0, OUTER_SCALE = 0.2, 20.0


def random_basis(n_common=0, n_sub=3, n_modes=4, seed=0):
    """One without any structure: K = 7 parameters of 12 coefficients."""
    generator = torch.Generator().manual_seed(seed)
    return AberrationBasis(torch.randn(n_sub * n_modes, 7, dtype=torch.float64, generator=generator), n_modes, n_common)


def draw(*shape, seed=1):
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("aperture", [SparseAperture([[0.0, 0.3], [0.3, -0.2]], 0.2, 1.0), PUPIL])
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


def test_root_of_a_covariance():
    """Its square is the covariance, but for errors below 1 mrad."""
    half = draw(6, 4, seed=0)
    covariance = half @ half.T
    torch.testing.assert_close(root(covariance) @ root(covariance), covariance, rtol=0, atol=1.01e-6)


@pytest.mark.parametrize("aperture", [SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.1]], 0.2, 1.0), PUPIL])
def test_turbulence_strength_is_unbiased(aperture):
    """Aberrations drawn from a prior twice as strong in variance."""
    basis = turbulent_basis(aperture, 10, 0, 0.15, 20.0)
    z = 2**0.5 * draw(4000, basis.n_parameters, seed=3)
    estimates = torch.tensor([basis.turbulence_strength(part) for part in z.split(100)])
    assert abs(float(estimates.mean()) - 2) < 4 * float(estimates.std()) / math.sqrt(len(estimates))
    assert basis.turbulence_strength(0 * z) == 0.05  # within its range
    assert basis.turbulence_strength(1e3 * z) == 20.0
    few = turbulent_basis(aperture, 1, 0, 0.15, 20.0)
    assert few.turbulence_strength(draw(3, few.n_parameters)) is None


@pytest.mark.parametrize(
    ("aperture", "n_modes"), [(SparseAperture([[0.0, 0.3], [0.3, -0.2]], 0.2, 1.0), 3), (PUPIL, 5)]
)
def test_turbulence_strength_takes_two_modes_at_least(aperture, n_modes):
    """Tip and tilt of a mask, defocus and one astigmatism of a single aperture; one of them alone does not tell."""
    enough, few = (turbulent_basis(aperture, n, 0, 0.15, 20.0) for n in (n_modes, n_modes - 1))
    assert enough.turbulence_strength(draw(3, enough.n_parameters)) is not None
    assert few.turbulence_strength(draw(3, few.n_parameters)) is None


def test_what_is_common_to_all_frames_says_nothing_of_the_turbulence(five_holes):
    alone, beside = (turbulent_basis(five_holes, 3, common, R0, OUTER_SCALE) for common in (0, 6))
    z = draw(5, beside.n_parameters)
    assert beside.turbulence_strength(z) == pytest.approx(alone.turbulence_strength(z[:, : beside.n_own]), rel=1e-12)


def test_static_modes_are_the_same_coefficients_in_every_frame(five_holes):
    """More modes in common than of each frame's own; every frame sees the sum."""
    basis = turbulent_basis(five_holes, 3, 6, R0, OUTER_SCALE)
    assert basis.n_modes == 6
    assert basis.n_common == 5 * 6 - 1  # without the mean piston
    assert basis.n_own == 5 * 3 - 1
    z = torch.cat([draw(4, basis.n_own), draw(1, basis.n_common, seed=2).expand(4, -1)], dim=1)
    coefficients = basis.coefficients(z)
    # Beyond the modes of each frame all is common; up to there they differ.
    spread = coefficients.std(0)
    assert spread[:, 3:].max() < 1e-12
    assert spread[:, :3].min() > 1e-3
    own = turbulent_basis(five_holes, 3, 0, R0, OUTER_SCALE)
    common = turbulent_basis(five_holes, 6, 0, five_holes.subaperture_diameter, OUTER_SCALE)
    expected = common.coefficients(z[:, basis.n_own :])
    expected[..., :3] += own.coefficients(z[:, : basis.n_own])
    torch.testing.assert_close(coefficients, expected, rtol=0, atol=1e-12)


def test_unwhitened_parameters_are_the_coefficients(five_holes):
    basis = turbulent_basis(five_holes, 3, 0, R0, OUTER_SCALE, whitened=False)
    z = draw(4, 15)
    assert torch.equal(basis.coefficients(z).flatten(1), z)
    assert torch.equal(plain_basis(five_holes, 3).coefficients(z).flatten(1), z)


def test_parameters_of_undoes_coefficients():
    """Those that the basis reaches; what all frames share goes to the common parameters."""
    basis = random_basis(n_common=3)
    z = draw(5, 7)
    z = basis.with_common_of(z - z.mean(0), z[:1])  # a mean over the frames counts as common, as far as that reaches
    torch.testing.assert_close(basis.parameters_of(basis.coefficients(z)), z, rtol=0, atol=1e-12)


def test_parameters_of_is_exact_but_for_the_mean_piston(five_holes):
    basis = turbulent_basis(five_holes, 3, 0, R0, OUTER_SCALE)
    coefficients = draw(4, 5, 3)
    change = basis.coefficients(basis.parameters_of(coefficients)) - coefficients
    assert change[..., 1:].abs().max() < 1e-9
    assert (change[..., 0] - change[..., 0].mean(1, keepdim=True)).abs().max() < 1e-9


def test_common_parameters_are_put_in_and_averaged():
    basis = random_basis(n_common=3)
    z, other = draw(5, 7), draw(1, 7, seed=2)
    mixed = basis.with_common_of(z, other)
    assert torch.equal(mixed[:, :4], z[:, :4])
    assert torch.equal(mixed[:, 4:], other[:, 4:].expand(5, -1))
    mean = basis.mean_common(z)
    torch.testing.assert_close(mean[:, 4:], z[:, 4:].mean(0).expand(5, -1))
    assert torch.equal(mean[:, :4], z[:, :4])
    plain = random_basis()
    assert plain.with_common_of(z, other) is z
    many = draw(6, 5, 7, seed=3)  # samples of all frames at once
    assert torch.equal(basis.mean_common(many)[2], basis.mean_common(many[2]))


def test_random_parameters_have_their_rms_and_share_what_is_common():
    basis = random_basis(n_common=3)
    like = torch.empty(4000, 7, dtype=torch.float64)
    z = basis.draw(like, 0.7, torch.Generator().manual_seed(0))
    own = z[:, :4]
    assert float(own.square().mean().sqrt()) == pytest.approx(0.7, rel=4 / math.sqrt(2 * own.numel()))
    assert torch.equal(z[:, 4:], z[:1, 4:].expand(4000, -1))
    assert torch.equal(z, basis.draw(like, 0.7, torch.Generator().manual_seed(0)))
    assert not torch.equal(z, basis.draw(like, 0.7, torch.Generator().manual_seed(1)))


def test_full_waves_come_off_the_pistons(five_holes):
    """PSFs stay as they are; no piston is left beyond half a wave, and correlated ones come no further away."""
    grid, n_modes = Grid.nyquist(1.0, 550e-9, 40), 3
    basis = turbulent_basis(five_holes, n_modes, 0, R0, OUTER_SCALE)
    true = basis.coefficients(draw(8, basis.n_parameters, seed=3))
    waves = torch.zeros_like(true)
    waves[0, 1, 0], waves[1, 4, 0], waves[2, 0, 0] = 2 * math.pi, -4 * math.pi, 6 * math.pi
    far, nowhere = (true + waves).flatten(1), torch.zeros(8, 15, dtype=torch.float64)
    model = ExposureModel(five_holes, grid, n_modes)
    back = model.aberrations.unwrapped(far, nowhere)
    torch.testing.assert_close(model.psf(back), model.psf(true.flatten(1)), rtol=0, atol=1e-12)
    assert float(back[:, ::n_modes].abs().max()) <= math.pi
    model = ExposureModel(five_holes, grid, basis)
    z = far @ torch.linalg.pinv(basis.mixing).T
    back = basis.unwrapped(z, nowhere[:, 1:])
    torch.testing.assert_close(model.psf(back), model.psf(z), rtol=0, atol=1e-12)
    assert bool((back.norm(dim=1) <= z.norm(dim=1) + 1e-12).all())
    assert float(back[2].norm()) < float(z[2].norm()) - 1


def test_the_piston_of_one_aperture_stays():
    basis = plain_basis(PUPIL, 3)
    z = torch.tensor([[20.0, 1.0, 0.0]]).double()
    assert torch.equal(basis.unwrapped(z, torch.zeros_like(z)), z)
