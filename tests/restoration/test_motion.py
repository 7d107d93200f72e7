"""Aberrations that change while a frame lasts: what they take from fringes, and a restoration that knows of it."""

import math
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.atmosphere.structure import coherence_distance
from torchmask.atmosphere.von_karman import modal_covariance, von_karman_structure_function
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.detector import Detector
from torchmask.restoration.aberrations import AberrationBasis, moving_basis, turbulent_basis
from torchmask.restoration.adjoint import data_fidelity
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.linearization import Linearization
from torchmask.restoration.motion import Setting
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.schedule import Schedule
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid((12, 15), 2.3e-7, 550e-9)
R0, OUTER_SCALE = 0.25, 20.0
KEPT = {0.5: 0.940, 1.0: 0.832, 2.0: 0.620, 4.0: 0.378}  # <V^2> of two independent points at T / tau0


class Smeared(NamedTuple):
    """Frames, and what they show."""

    frames: Tensor
    object: Tensor
    change: Tensor


BRISK = Schedule(sharp_after=100)
SIDE = 32


def bases(mask, exposure=1.0, n_modes=4, n_common=0):
    still = turbulent_basis(mask, n_modes, n_common, R0, OUTER_SCALE)
    return still, moving_basis(still, mask, exposure, R0, OUTER_SCALE)


# ---- the model


@pytest.mark.parametrize(("exposure", "kept"), KEPT.items())
def test_points_lose_the_contrast_of_an_even_motion(exposure, kept):
    """By two instants (1 + exp(-(T/tau0)^(5/3) / 3)) / 2; what an uneven motion takes besides is in the closed form."""
    drift, far = exposure * coherence_distance(R0), 1e6
    point = SparseAperture([[0.0, 0.0]], drift / 20, drift)
    variance = 2 * float(modal_covariance(point, 1, R0, far, drift))  # of the change of one against the other
    structure = von_karman_structure_function(torch.tensor(drift), R0, far)
    assert variance == pytest.approx(2 * float(structure), rel=0.004)  # the point has a size
    assert variance == pytest.approx(2 * exposure ** (5 / 3), rel=0.015)  # without outer scale
    instants = moving_basis(turbulent_basis(point, 1, 0, R0, far), point, exposure, R0, far).instants
    drawn = math.sqrt(variance) * torch.randn(40_000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    visibility = torch.stack([torch.exp(1j * drawn * instant) for instant in instants]).mean(0)
    power = visibility.abs() ** 2
    found, error = float(power.mean()), float(power.std()) / 200
    assert abs(found - (1 + math.exp(-variance / 6)) / 2) < 4 * error
    assert 0 < found - kept < (0.03 if exposure <= 1 else 0.15)


def test_a_frame_is_the_mean_of_its_two_instants(three_holes, random_exposures):
    """Through another part of the code: snapshots with the coefficients of either instant."""
    _, moving = bases(three_holes)
    model, image, z, *_ = random_exposures(ExposureModel(three_holes, GRID, moving))
    middle, change = moving.coefficients(z), moving.change(z)
    snapshots = ExposureModel(three_holes, GRID, 4)
    taken = [snapshots(image, (middle + sign * change / math.sqrt(12)).flatten(1)) for sign in (-1, 1)]
    assert torch.allclose(model(image, z), (taken[0] + taken[1]) / 2, rtol=1e-10)
    assert float(change[..., :3].abs().min()) > 0
    assert float(change[..., 3:].abs().max()) == 0


def test_without_change_frames_are_snapshots(three_holes, random_exposures):
    still, moving = bases(three_holes, n_common=2)
    model, image, z, *_ = random_exposures(ExposureModel(three_holes, GRID, moving))
    z[:, still.n_own : moving.n_own] = 0
    kept = torch.cat([z[:, : still.n_own], z[:, moving.n_own :]], dim=1)
    snapshot = ExposureModel(three_holes, GRID, still)(image, kept)
    assert torch.allclose(model(image, z), snapshot, rtol=1e-12)
    assert moving.n_common == still.n_common > 0


@pytest.mark.parametrize("band", [None, Band.of((500e-9, 610e-9), (1.0, 2.0))])
@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_gradients_are_those_of_autograd(dtype, rounding, band, three_holes, random_exposures):
    model, image, z, frames, precision = random_exposures(
        ExposureModel(three_holes, GRID, bases(three_holes)[1], band, dtype=dtype)
    )
    image.requires_grad_()
    z.requires_grad_()
    cost = 0.5 * (precision * (model(image, z) - frames) ** 2).sum()
    by_image, by_z = torch.autograd.grad(cost, (image, z))
    found = data_fidelity(model, image.detach(), z.detach(), frames, precision)
    assert (found.object_gradient - by_image).abs().max() < rounding * by_image.abs().max()
    assert (found.aberration_gradient - by_z).abs().max() < rounding * by_z.abs().max()
    tangent = Linearization(model, image.detach(), z.detach())
    pulled = tangent.adjoint((precision * (model(image, z).detach() - frames))[None])
    assert (pulled[1][0] - by_z).abs().max() < rounding * by_z.abs().max()


def test_gradcheck_and_no_slope_where_nothing_moves(three_holes, random_exposures):
    """Forwards or backwards in time makes the same frame, so the slope in the change vanishes at rest."""
    still, moving = bases(three_holes)
    model, image, z, *_ = random_exposures(ExposureModel(three_holes, GRID, moving), n_frames=1)
    for rest in (1.0, 0.0):
        there = z.clone()
        there[:, still.n_own :] *= rest
        there.requires_grad_()
        assert torch.autograd.gradcheck(lambda z: model(image, z), there)
    (slope,) = torch.autograd.grad(model(image, there).square().sum(), there)
    assert slope[:, still.n_own :].abs().max() < 1e-12 * slope.abs().max()


# ---- what a state has found


def test_an_objective_follows_the_state(explain, five_holes):
    objective, state = explain()
    moving = moving_basis(objective.model.aberrations, five_holes, 1.0, R0, OUTER_SCALE)
    setting = Setting.of(objective, moving)
    moved = setting.in_motion(state, seed=0)
    assert setting.awaits_motion(state)
    assert not setting.awaits_motion(moved)
    assert setting.in_motion(moved, seed=1) is moved
    there = setting.objective_at(objective, moved)
    assert there.model.aberrations.n_parameters == moved.z.shape[1] == there.centre.shape[1]
    assert setting.objective_at(there, moved) is there
    back = setting.objective_at(there, state)
    args = (state.image, state.z)
    assert torch.equal(back.value_and_gradients(*args).value, objective.value_and_gradients(*args).value)
    change = 0.3 * torch.randn(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    change[..., 0] -= change[..., 0].mean(1, keepdim=True)  # of all holes alike cannot be seen
    known = setting.in_motion(state, 0, change).z
    assert torch.allclose(moving.change(known)[:2], change, atol=1e-6)
    assert torch.equal(known[2:], moved.z[2:])


def test_an_objective_has_the_basis_of_the_state_however_many_parameters_it_has(explain):
    objective, state = explain()
    still = objective.model.aberrations
    other = AberrationBasis(2 * still.mixing, still.n_modes)
    setting = Setting.of(objective, finer=lambda: other)
    finer = setting.in_finer_modes(state)
    there = setting.objective_at(objective, finer)
    assert there.model.aberrations is other
    torch.testing.assert_close(other.coefficients(finer.z), still.coefficients(state.z))
    torch.testing.assert_close(there.model(state.image, finer.z), objective.model(state.image, state.z))
    assert setting.objective_at(there, finer) is there


# ---- whole restorations


@pytest.fixture(scope="module")
def smeared(five_holes):
    """Six frames of two coherence times, made by the model, the object behind them and the true changes."""
    model = ExposureModel(five_holes, Grid.nyquist(1.0, 550e-9, SIDE), bases(five_holes, 2.0, 3)[1])
    generator, scene = torch.Generator().manual_seed(2), torch.zeros(SIDE, SIDE, dtype=torch.float64)
    scene[12:20, 13:19], scene[15:18, 6:27] = 3.0, 1.5
    scene *= 3e6 / scene.sum()
    basis = model.aberrations
    axes = torch.nn.functional.normalize(basis.mixing + basis.motion, dim=0).chunk(2, dim=1)
    drawn = torch.randn(2, 6, len(basis.mixing), dtype=torch.float64, generator=generator)
    # along the modes: on a ring some are as strong as others, and rounding chooses between them
    z = torch.cat([normal @ own for normal, own in zip(drawn, axes, strict=True)], dim=1)
    frames = torch.poisson(model(model.window.embed(scene), z), generator=generator)
    return Smeared(frames, scene, model.aberrations.change(z))


@pytest.fixture(scope="module")
def methods(five_holes):
    def make(exposure, **kwargs):
        common = {"schedule": BRISK, "max_iterations": 300, "refine_geometry": False, "n_modes": 3}
        return MyopicDeconvolution(
            five_holes, Grid.nyquist(1.0, 550e-9, SIDE), exposure_tau0=exposure, **common | kwargs
        )

    return make


def test_frames_that_last_are_restored_better_by_who_knows(smeared, methods, tmp_path):
    """Over seven seeds the error is 0.41 times that of who does not know, with a standard deviation of 0.066."""
    whole = {"schedule": Schedule(in_vain=0), "max_iterations": 4000}  # in less time
    told, not_told = (methods(exposure, **whole).restore(smeared.frames) for exposure in (2.0, 0.0))
    scores = [relative_error(result.object, smeared.object, 0.5) for result in (told, not_told)]
    assert scores[0] < (0.41 + 3 * 0.066 * math.sqrt(1 + 1 / 7)) * scores[1]
    found, true = told.motion.flatten(1), smeared.change.flatten(1)  # either direction of time
    alike = (found * true).sum(1).abs() / found.norm(dim=1) / true.norm(dim=1)
    assert float(alike.median()) > 0.7  # in 14 dimensions chance reaches that once in 400
    assert float(told.chi_square.mean()) < float(not_told.chi_square.mean())
    assert told.verdict.explained
    assert not_told.motion is None
    assert told.motion.shape == told.coefficients.shape
    assert "pistons change by" in told.summary()
    assert "pistons" not in not_told.summary()
    told.save(tmp_path / "result.npz")
    assert torch.equal(type(told).load(tmp_path / "result.npz").motion, told.motion)
    again = methods(2.0, tolerance=1.0, **whole).restore(smeared.frames, start=told)  # begins where the other has ended
    assert float(again.cost[0]) < 1.02 * float(told.cost[-1])


def test_interrupted_and_resumed_is_the_same(smeared, methods, tmp_path):
    brisk = {"schedule": Schedule(sharp_after=40, segment=20), "max_iterations": 80}
    method, path, steps = methods(2.0, tolerance=0, **brisk), tmp_path / "state.npz", []

    def interrupt(record):
        if record.step == 70:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.restore(smeared.frames, checkpoint=path, callback=interrupt)
    resumed = method.restore(smeared.frames, checkpoint=path, callback=lambda record: steps.append(record.step))
    assert steps[0] == 61  # in motion
    whole = method.restore(smeared.frames)
    assert torch.equal(resumed.motion, whole.motion)
    assert torch.equal(resumed.object, whole.object)
    with pytest.raises(ValueError, match="other frames or settings"):
        methods(1.0, **brisk).restore(smeared.frames, checkpoint=path)


def test_known_aberrations_do_not_move(smeared, methods):
    known = torch.zeros(6, 5, 3, dtype=torch.float64)
    result = methods(2.0, max_iterations=5).restore(smeared.frames, coefficients=known)
    assert result.motion is None


@pytest.mark.parametrize("exposure", [-0.1, math.nan, math.inf])
def test_an_exposure_is_a_length_of_time(exposure, methods):
    with pytest.raises(ValueError, match=r"exposure_tau0 is .*: it must be finite and at least 0, in units of tau0"):
        methods(exposure)


def test_an_exposure_without_use_is_refused(methods):
    with pytest.raises(ValueError, match="without aberration_prior"):
        methods(1.0, aberration_prior=False)
    with pytest.raises(ValueError, match="for masks only"):
        MyopicDeconvolution(FullAperture(1.0), Grid.nyquist(1.0, 550e-9, SIDE), exposure_tau0=1.0)


def test_faint_exposures_are_restored_with_the_motion_that_is_told():
    """Once their object is sharp the search asks the frames for its slopes, by the model in which holes move."""
    grid, mask = Grid.nyquist(1.0, 550e-9, 40), SparseAperture.from_catalog("golay9", 1.0, fill_factor=0.15)
    generator = torch.Generator().manual_seed(0)
    scene, turbulence = make_scene(grid.shape, 3e4), TurbulencePhase(0.2, 20.0)
    seen = simulate_observation(scene, mask, grid, turbulence, Detector(1.5), 8, generator=generator)
    method = MyopicDeconvolution(mask, grid, exposure_tau0=1.0, readout_noise=1.5, max_iterations=310)
    result = method.restore(seen.frames)
    assert result.motion.shape == result.coefficients.shape
    assert bool(torch.isfinite(result.object).all())
    assert len(result.cost) > Schedule().sharp_after
