"""Pistons alone, for holes much smaller than r0: derivatives that have no part in the modes, and whole restorations."""

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.placed import PlacedSamples, centers_of, moved_centers
from torchmask.restoration.schedule import Schedule

GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
NOISE = 0.03  # of a mean pixel


def small_holes():
    """Six holes of 0.15 m on no symmetric figure."""
    centers = [[0.44, 0.02], [0.15, 0.4], [-0.31, 0.3], [-0.42, -0.12], [-0.05, -0.43], [0.33, -0.28]]
    return SparseAperture(torch.tensor(centers, dtype=torch.float64), 0.15, 1.0)


def observe_pistons(n_frames=8, static_modes=0):
    """Frames [electrons] of a body with an arm through pistons of each frame, and other modes common to all."""
    basis = turbulent_basis(small_holes(), 1, static_modes, 0.3, 20.0)
    model = ExposureModel(small_holes(), GRID, basis)
    generator = torch.Generator().manual_seed(4)
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[11:19, 8:16], image[14:16, 16:25] = 6.0, 3.0
    z = basis.mean_common(torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=generator))
    frames = model(image, z)
    noise = NOISE * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    return model.window.crop(image), 1e3 * (frames + noise)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_step_of_the_mask_has_the_gradient_of_autograd(dtype, random_exposures):
    """The pistons of a hole are the same wherever it stands, so all of the gradient is that of the weights."""
    mask = small_holes()
    model = ExposureModel(mask, GRID, 1, dtype=dtype)
    _, image, z, frames, precision = random_exposures(model)
    for values in ([0.0, 0.0], [0.03, -0.02]):
        step = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        samples = model.pupil.samples_at(moved_centers(mask.centers, step))
        assert not samples.basis.requires_grad
        misfit = 0.5 * (precision * (model(image, z, samples) - frames) ** 2).sum()
        (expected,) = torch.autograd.grad(misfit, step)
        placed = PlacedSamples(model.pupil, centers_of(model.pupil), step)
        found = data_fidelity(model, image, z, frames, precision, samples=placed.samples, want_samples=True)
        slope = placed.pull_back(found.weight_gradient, found.basis_gradient)
        rounding = 1e-11 if dtype is torch.float64 else 2e-4  # of sums over some 1e3 pixels
        assert (slope - expected).abs().max() < rounding * expected.abs().max()


@pytest.mark.parametrize(("n_modes", "tells"), [(1, False), (2, False), (3, True)])
def test_common_modes_tell_no_strength_of_the_turbulence(n_modes, tells, five_holes):
    """Whatever is common to all frames, tip and tilt of each frame do, as without common modes."""
    z = torch.ones(4, 200, dtype=torch.float64)
    for common in (0, 6):
        basis = turbulent_basis(five_holes, n_modes, common, 0.25, 20.0)
        assert (basis.turbulence_strength(z[:, : basis.n_parameters]) is not None) is tells


@pytest.mark.parametrize("options", [{}, {"static_modes": 6, "refine_geometry": True}])
def test_an_object_is_found_through_pistons_alone(options):
    """The residual is the noise, and the object is near the true one, however the rest of the model is.

    In one start, whose object no other one has to improve.
    """
    image, frames = observe_pistons(static_modes=options.get("static_modes", 0))
    given = {"n_modes": 1, "r0": 0.3, "max_iterations": 800, "schedule": Schedule(in_vain=0)}
    result = MyopicDeconvolution(small_holes(), GRID, **given, **options).restore(frames)
    assert result.coefficients.shape == (8, 6, max(1, options.get("static_modes", 0)))
    assert float(result.chi_square.mean()) == pytest.approx(1, abs=0.1)
    cutoff = GRID.cutoff(small_holes().extent)
    assert relative_error(result.object, image, cutoff) < 0.5 * relative_error(frames.mean(0), image, cutoff)
    if "refine_geometry" in options:
        assert abs(result.rotation) < 5 * float(result.geometry_std[0])


def test_r0_stays_as_assumed_where_pistons_alone_do_not_tell_it():
    """Without a told r0 that is the diameter of a hole, also if other modes are common to all frames."""
    for static_modes in (0, 6):
        _, frames = observe_pistons(n_frames=3, static_modes=static_modes)
        method = MyopicDeconvolution(small_holes(), GRID, n_modes=1, static_modes=static_modes, max_iterations=200)
        assert method.restore(frames).r0 == pytest.approx(0.15)
