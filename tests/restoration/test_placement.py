"""How a mask lies, found with the object: derivatives, what the frames tell of it, and whole restorations."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.geometry import MaskGeometry
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.background import Background
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.placed import PlacedSamples, centers_of, moved_centers
from torchmask.restoration.placement import (
    distance,
    information,
    is_misplaced,
    largest_magnification,
    misplacement,
    moved,
    placed_as,
    slopes_of_frames,
    smallest_magnification,
)
from torchmask.restoration.posterior import place_deviations
from torchmask.restoration.result import RestorationResult
from torchmask.restoration.schedule import Schedule

GRID = Grid.nyquist(1.05, 550e-9, (24, 30))


def gradient_in_step(model, exposures, step):
    image, z, frames, precision = exposures
    placed = PlacedSamples(model.pupil, centers_of(model.pupil), step)
    found = data_fidelity(model, image, z, frames, precision, samples=placed.samples, want_samples=True)
    return float(found.value.sum()), placed.pull_back(found.weight_gradient, found.basis_gradient)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("band", [None, Band.of([550e-9, 580e-9], [1.0, 2.0])])
def test_gradient_in_a_step_is_that_of_autograd(dtype, band, three_holes, random_exposures):
    """Through the model whose centres the step has moved, at no step and at one."""
    model = ExposureModel(three_holes, GRID, 6, band, dtype=dtype)
    _, image, z, frames, precision = random_exposures(model)
    for values in ([0.0, 0.0], [0.03, -0.02]):
        step = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        samples = model.pupil.samples_at(moved_centers(three_holes.centers, step))
        misfit = 0.5 * (precision * (model(image, z, samples) - frames) ** 2).sum()
        (expected,) = torch.autograd.grad(misfit, step)
        value, slope = gradient_in_step(model, (image, z, frames, precision), step)
        rounding = 1e-11 if dtype is torch.float64 else 2e-4  # of sums over some 1e3 pixels
        assert value == pytest.approx(misfit.item(), rel=rounding)
        assert (slope - expected).abs().max() < rounding * expected.abs().max()


def test_slope_of_the_moved_samples(three_holes):
    """gradcheck through the coverage of cells and the modes, at no step too."""
    model = ExposureModel(three_holes, GRID, 3)

    generator = torch.Generator().manual_seed(0)
    raster, modes = (
        torch.randn(n, dtype=torch.float64, generator=generator) for n in (2**12, model.pupil.basis.shape[1])
    )

    def samples(step):
        """Sums over the raster: cells open and close under the smallest of steps."""
        placed = model.pupil.samples_at(moved_centers(three_holes.centers, step))
        light = raster[placed.index] * placed.weights
        return light.sum(), (light * (placed.basis @ modes)).sum()

    for values in ([0.0, 0.0], [0.01, 0.02]):
        step = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.gradcheck(samples, step, eps=1e-7, atol=1e-6)


@settings(max_examples=30, deadline=None)
@given(st.floats(-0.3, 0.3), st.floats(-0.1, 0.1), st.floats(-0.3, 0.3), st.floats(-0.1, 0.1))
def test_steps_add_up_to_a_geometry(turn, shrinkage, more_turn, more_shrinkage):
    """Two steps one after the other are that of their sums, and what `MaskGeometry` makes of it."""
    centers = torch.tensor([[0.4, 0.1], [-0.2, 0.3], [0.0, -0.5]], dtype=torch.float64)
    one = torch.tensor([turn, shrinkage], dtype=torch.float64)
    two = torch.tensor([more_turn, more_shrinkage], dtype=torch.float64)
    together = moved_centers(centers, one + two)
    assert torch.allclose(moved_centers(moved_centers(centers, one), two), together, atol=1e-14)
    factor = math.exp(-shrinkage - more_shrinkage)
    geometry = MaskGeometry(turn + more_turn, factor, factor)
    assert torch.allclose(centers @ geometry.matrix.T, together, atol=1e-14)


def test_a_step_is_taken_from_where_the_mask_lies(explained):
    objective, state = explained
    told = objective.model.pupil.aperture
    there = moved(moved(state, torch.tensor([0.02, -0.01])), torch.tensor([0.01, 0.03]))
    assert there.geometry.rotation == pytest.approx(0.03, abs=1e-8)  # float32 steps
    assert there.geometry.magnification == pytest.approx(math.exp(-0.02), rel=1e-8)
    assert distance(state.geometry, there.geometry) == pytest.approx(math.hypot(0.03, 0.02), rel=0.02)
    placed = placed_as(objective, told, there.geometry)
    expected = there.geometry.apply(told)
    assert torch.equal(placed.model.pupil.aperture.centers, expected.centers)
    assert placed.model.pupil.aperture.subaperture_diameter == expected.subaperture_diameter
    assert placed_as(placed, told, there.geometry) is placed
    assert torch.equal(placed_as(placed, told, MaskGeometry()).model.pupil.aperture.centers, told.centers)


def test_a_mask_grows_no_further_than_the_pixels_sample():
    mask = SparseAperture([[0.4, 0.0], [-0.4, 0.0], [0.0, 0.3]], 0.2, 1.0)
    model = ExposureModel(mask, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.03), 3)
    assert largest_magnification(model) == pytest.approx(1.03)
    band = Band.of([500e-9, 550e-9])
    model = ExposureModel(mask, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2), 3, band)
    assert largest_magnification(model) == pytest.approx(1.2 * 500 / 550)


@pytest.mark.parametrize("band", [None, Band.of([500e-9, 600e-9])])
@pytest.mark.parametrize("diameter", [0.2, 0.16])
def test_a_mask_shrinks_until_its_holes_are_two_samples_wide(band, diameter):
    mask = SparseAperture([[0.4, 0.0], [-0.4, 0.0], [0.0, 0.3]], diameter, 1.0)
    model = ExposureModel(mask, Grid.nyquist(1.1, 550e-9, 32, oversampling=1.2), 3, band)
    least = smallest_magnification(model)
    assert least < 1
    model.through(MaskGeometry(0.1, least, least).apply(mask))
    smallest = SparseAperture(mask.centers, least * diameter, 1.0)
    limit = ExposureModel(smallest, model.window.grid, 3, band)
    assert smallest_magnification(limit) == pytest.approx(1.0, rel=1e-12)
    for turn in torch.linspace(-0.1, 0.1, 41).tolist():  # which rounds the diameter
        limit.through(MaskGeometry(turn, 1 - 1e-15, 1 - 1e-15).apply(smallest))
    with pytest.raises(ValueError, match="at least 2 are needed"):
        model.through(MaskGeometry(0.1, 0.99999 * least, 0.99999 * least).apply(mask))


@pytest.mark.parametrize("step", [(2e-3, 0.0), (0.0, 2e-3), (-1e-3, 1.5e-3)])
def test_what_frames_tell_of_a_misplaced_mask(step, explain):
    """With all else known, within four standard deviations, and a tenth for what is not of first order."""
    objective, state = explain(noise=0.003)
    told, step = objective.model.pupil.aperture, torch.tensor(step, dtype=torch.float64)
    elsewhere = told.replace(moved_centers(told.centers, -step))
    away = objective.with_changes(model=objective.model.through(elsewhere))
    found = misplacement(away, state)
    assert is_misplaced(away, state, Schedule())
    assert not is_misplaced(away, state, Schedule.plain())  # the published method knows no other mask than the told one
    slopes = slopes_of_frames(objective.model, state.image, state.z)
    deviations = torch.linalg.inv(information(slopes, objective.precision)).diagonal().sqrt()
    assert deviations.max() < 5e-4
    assert bool(((found.step - step).abs() < 4 * deviations + 0.1 * step.norm()).all())
    assert found.size > 5e-4
    assert found.gain > 5
    here = misplacement(objective, state)
    assert here.gain < 9.2  # half of a chi-square with two degrees of freedom, which one noise in 10000 exceeds
    assert bool((here.step.abs() < 4 * deviations).all())


@pytest.mark.parametrize("background", [Background.PER_FRAME, Background.COMMON])
def test_a_sky_does_not_look_like_a_misplaced_mask(background, explain):
    """Whatever its level, where it is free; one that is not shifts the step by many deviations."""
    told, state = explain()
    model, steps = told.model.beside(background), []
    for sky in (1.0, 4.0):
        objective = MyopicObjective(model, told.frames + sky, told.precision, told.prior)
        steps.append(misplacement(objective, state))
    torch.testing.assert_close(steps[0].step, steps[1].step, rtol=1e-9, atol=1e-12)
    assert steps[0].gain == pytest.approx(steps[1].gain, rel=1e-9)
    not_free = MyopicObjective(told.model, told.frames + 4.0, told.precision, told.prior)
    assert misplacement(not_free, state).gain > 10 * steps[1].gain


def test_the_gain_of_a_step_is_what_the_misfit_falls_by(explain):
    """To first order of the frames in the step, as far as that changes them."""
    objective, state = explain()
    found = misplacement(objective, state)
    frames, precision, _ = objective.scaled_data(state.calibration)
    left = frames - objective.model(state.image, state.z)
    slopes = slopes_of_frames(objective.model, state.image, state.z)
    moved_by = left - torch.einsum("s,stij->tij", found.step, slopes)
    falls = 0.5 * float((precision * (left**2 - moved_by**2)).sum())
    assert found.gain == pytest.approx(falls, rel=1e-6)


def test_deviations_allow_for_what_aberrations_imitate(explain):
    """Against Schur's complement of matrices that are built whole, with the object known."""
    objective, state = explain(n_frames=2)
    known_object = objective.with_changes(free=Free.ABERRATIONS)
    whole = torch.func.jacfwd(lambda z: objective.model(state.image, z))(state.z).flatten(0, 2).flatten(1)
    slopes = slopes_of_frames(objective.model, state.image, state.z).flatten(1).T
    weight = float(objective.precision)
    cross = weight * whole.T @ slopes
    hessian = weight * whole.T @ whole + torch.eye(whole.shape[1])
    told = weight * slopes.T @ slopes - cross.T @ torch.linalg.solve(hessian, cross)
    expected = torch.linalg.inv(told).diagonal().sqrt()
    assert torch.allclose(place_deviations(known_object, state, 0.4), expected, rtol=1e-3)  # of 50 conjugate gradients
    alone = (weight * slopes.square().sum(0)).rsqrt()
    assert bool((expected > alone).all())
    assert bool((place_deviations(objective, state, 0.4) > 0.999 * expected).all())  # the object imitates some more


TRUE = MaskGeometry(math.radians(1.0), 1.006, 1.006)


def test_what_is_found_by_default_is_kept(observe, five_holes, tmp_path):
    """Within three standard deviations and what the modes left out displace: 0.028 degrees and 0.25 %."""
    seen = observe(TRUE.apply(five_holes), n_frames=4, n_photons=6e6, shape=(40, 40))
    given = {"schedule": Schedule(starts=1), "max_iterations": 450}
    found, fixed = (
        MyopicDeconvolution(five_holes, seen.grid, 10, refine_geometry=refine, **given).restore(seen.frames)
        for refine in (None, False)
    )
    assert found.geometry_std is not None
    turn, scale = found.geometry_std.tolist()
    assert abs(found.rotation - TRUE.rotation) < 3 * turn + math.radians(0.028)
    assert abs(found.magnification - 1.006) < 3 * scale + 0.0025
    assert 0 < math.degrees(turn) < 0.1
    ours, plain = (relative_error(result.object, seen.object, 0.5) for result in (found, fixed))
    assert ours < plain
    assert float(found.chi_square.mean()) < float(fixed.chi_square.mean())
    assert "mask turned by" in found.summary()
    assert "mask turned by" not in fixed.summary()
    found.save(tmp_path / "result.npz")
    again = RestorationResult.load(tmp_path / "result.npz")
    assert again.geometry == found.geometry
    assert torch.equal(again.geometry_std, found.geometry_std)
    method = MyopicDeconvolution(five_holes, seen.grid, 10, refine_geometry=True, max_iterations=100)
    warm = method.restore(seen.frames, start=again)
    assert distance(warm.geometry, again.geometry) < 5e-4


def test_a_mask_that_lies_as_told_is_left_alone(observation, restored):
    assert restored.geometry == MaskGeometry()
    assert restored.geometry_std is None


def test_a_full_pupil_has_nothing_to_be_seen_by():
    with pytest.raises(ValueError, match="only a mask has baselines"):
        MyopicDeconvolution(FullAperture(1.0), GRID, 3, refine_geometry=True)


def test_a_mask_that_is_lost_is_taken_as_told(five_holes, observe):
    """In frames of a few photons nothing tells how it lies."""
    faint = observe(n_frames=2, n_photons=3000.0, seed=2)
    schedule = Schedule(farthest=1e-6, segment=5)
    method = MyopicDeconvolution(five_holes, faint.grid, 3, refine_geometry=True, schedule=schedule, max_iterations=20)
    found = method.restore(faint.frames)
    assert found.geometry == MaskGeometry()
    assert found.geometry_std is None
