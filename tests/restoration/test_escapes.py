"""The ways out of a local minimum, where the answer is known: frames that are lost, an object off its pixels."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import shift
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration import escapes
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.escapes import centre_on_pixels, restart_outlier_frames, settle, tilt
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import Minimum, ProjectedLBFGS
from torchmask.restoration.schedule import Schedule

GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
FRAMES, LOST = 4, 2  # of `explained`
FIRST_INFLATION = 30.0
SCHEDULE = Schedule()


def with_lost(state, z):
    """The state whose lost frame has the aberrations z (K,)."""
    changed = state.z.clone()
    changed[LOST] = z
    return replace(state, z=changed)


class Counting:
    """A minimiser that counts the evaluations it is seen to spend."""

    def __init__(self):
        self.n_evaluations = 0
        self.inner = ProjectedLBFGS()

    def __call__(self, cost, start, lower, *, max_iterations, callback):
        reported = []
        found = self.inner(
            cost,
            start,
            lower,
            max_iterations=max_iterations,
            callback=lambda x, value, evaluations: (reported.append(evaluations), callback(x, value, evaluations)),
        )
        self.n_evaluations += reported[-1]
        return found


def idle(cost, start, lower, *, max_iterations, callback):
    """A minimiser that says it has evaluated seven times, in two iterations, and stays."""
    callback(start, cost(start)[0], 3)
    callback(start, cost(start)[0], 7)
    return Minimum(start, cost(start)[0], 2, 7, False, "idle")


# --- frames


def test_a_lost_frame_is_found_again(explained):
    """From aberrations of another frame; the residuals of the others tell that it is lost. About every other seed finds
    it: of eight fewer than two do in 4 % of such problems."""
    objective, state = explained
    lost = with_lost(state, -state.z[0])
    costs = [objective.frame_costs(one.image, one.z, one.calibration) for one in (lost, state)]
    assert float(costs[0][LOST]) > 10 * float(costs[1][LOST])
    others, successes = [frame for frame in range(FRAMES) if frame != LOST], 0
    for seed in range(8):
        minimizer = Counting()
        found, n_evaluations = restart_outlier_frames(objective, lost, FIRST_INFLATION, SCHEDULE, minimizer, seed)
        cost = float(objective.frame_costs(found.image, found.z, found.calibration)[LOST])
        successes += cost < 1.001 * float(costs[1][LOST])  # the least cost is below that of the truth
        assert cost < float(costs[0][LOST])
        assert torch.equal(found.z[others], lost.z[others])
        assert torch.equal(found.image, lost.image)
        assert found.calibration is lost.calibration
        assert minimizer.n_evaluations > SCHEDULE.restart_rounds
        # all starts in one descent, in units of evaluations of the whole stack
        assert n_evaluations == SCHEDULE.restarts * minimizer.n_evaluations // FRAMES
    assert successes >= 2


def test_frames_that_fit_are_left_alone_at_no_cost(explained):
    objective, state = explained
    found, n_evaluations = restart_outlier_frames(objective, state, FIRST_INFLATION, SCHEDULE, idle, seed=1)
    assert found is state
    assert n_evaluations == 0


def test_a_frame_keeps_its_aberrations_unless_others_are_better(explained):
    """Random ones that go nowhere are not; every evaluation counts, those in vain too."""
    objective, state = explained
    lost = with_lost(state, state.z[LOST] + 0.2)  # a poor fit, but no worse than a random one
    found, n_evaluations = restart_outlier_frames(objective, lost, FIRST_INFLATION, SCHEDULE, idle, seed=1)
    assert found is lost
    assert n_evaluations == SCHEDULE.restarts * SCHEDULE.restart_rounds * 7 // FRAMES


def test_what_is_outlying_is_a_number_of_the_schedule(explained):
    objective, state = explained
    lost = with_lost(state, state.z[LOST] + 0.2)
    blind = replace(SCHEDULE, outlying=math.inf)
    assert restart_outlier_frames(objective, lost, FIRST_INFLATION, blind, idle, seed=1) == (lost, 0)


def test_restarts_are_those_of_the_seed(explained):
    objective, state = explained
    lost = with_lost(state, -state.z[0])
    brief = replace(SCHEDULE, restarts=1, restart_rounds=1, restart_iterations=3)

    def restarted(seed):
        return restart_outlier_frames(objective, lost, FIRST_INFLATION, brief, ProjectedLBFGS(), seed)[0].z[LOST]

    assert torch.equal(restarted(1), restarted(1))
    assert not torch.equal(restarted(1), restarted(2))


def test_frames_are_lost_by_the_noise_of_the_best_quarter(explained, monkeypatch):
    """Which half of the frames being lost does not change; the limit is 1.25 times its highest residual variance."""
    objective, state = explained
    noise = torch.tensor([1.0, 3.0, 1.0, 3.0], dtype=torch.float64)
    monkeypatch.setattr(escapes, "calibrate", lambda objective, state: state.calibrated(noise_inflation=noise))
    started = []

    def descend(objective, state, *rest):
        started.append(len(state.z))
        raise StopIteration

    monkeypatch.setattr(escapes, "descend", descend)
    with pytest.raises(StopIteration):
        restart_outlier_frames(objective, state, FIRST_INFLATION, SCHEDULE, idle, seed=1)
    assert started == [2 * SCHEDULE.restarts]


def test_restarts_scatter_around_what_is_expected_by_as_much_as_the_others_do(explained, monkeypatch):
    """Whatever is expected: moved with all aberrations, it moves the starts, and nothing else changes."""
    objective, state = explained
    every, started = replace(SCHEDULE, outlying=0.0, restarts=1, restart_rounds=1), []

    def descend(objective, state, *rest):
        started.append(state.z)
        return state

    monkeypatch.setattr(escapes, "descend", descend)
    apart = torch.linspace(-3, 3, state.z.numel(), dtype=torch.float64).view_as(state.z)
    elsewhere = objective.with_changes(centre=apart), replace(state, z=state.z + apart)
    for there, now in ((objective, state), elsewhere):
        restart_outlier_frames(there, now, FIRST_INFLATION, every, idle, seed=1)
    assert started[0].shape == state.z.shape
    torch.testing.assert_close(started[1] - apart, started[0], rtol=0, atol=1e-12)
    rms = float(state.z.square().mean(1).sqrt().median())
    # as many normal numbers have this rms, within four standard errors
    assert float(started[0].square().mean().sqrt()) == pytest.approx(rms, rel=4 / math.sqrt(2 * state.z.numel()))


def test_what_all_frames_share_stays_when_one_starts_anew(five_holes, five_hole_basis, explain):
    shared = AberrationBasis(five_hole_basis.mixing, 3, n_common=6)
    objective, state = explain(ExposureModel(five_holes, GRID, shared))
    lost = state.z[LOST].clone()
    lost[: shared.n_own] = -state.z[0, : shared.n_own]
    found, _ = restart_outlier_frames(
        objective, with_lost(state, lost), FIRST_INFLATION, SCHEDULE, ProjectedLBFGS(), seed=1
    )
    assert not torch.equal(found.z[LOST], lost)
    torch.testing.assert_close(found.z[:, shared.n_own :], state.z[:, shared.n_own :], rtol=1e-14, atol=0)


def test_a_start_whose_cost_is_no_number_replaces_nothing(explained):
    """As from pairs of steps without a solution."""
    objective, state = explained
    lost = with_lost(state, state.z[LOST] + 0.2)

    def diverges(cost, start, lower, *, max_iterations, callback):
        callback(start, cost(start)[0], 1)
        return Minimum(start * math.nan, math.nan, 1, 1, False, "diverged")

    found, _ = restart_outlier_frames(objective, lost, FIRST_INFLATION, SCHEDULE, diverges, seed=1)
    assert found is lost


# --- the object between the pixels


@pytest.mark.parametrize("band", [None, Band.of((540e-9, 580e-9))])
@pytest.mark.parametrize("offset", [(2.0, -3.0), (0.4, -0.2)])
def test_tilt_moves_every_image(offset, band, five_holes, five_hole_basis):
    model = ExposureModel(five_holes, GRID, five_hole_basis, band)
    z = torch.randn(2, five_hole_basis.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = model.psf(z + tilt(model, offset))
    torch.testing.assert_close(moved, shift(model.psf(z), offset), rtol=0, atol=1e-9)


def test_tilt_moves_images_of_a_mask_that_is_off_its_centre():
    """Its holes have a mean piston then, which modes of turbulence do not include, and no image shows."""
    mask = SparseAperture([[0.1, 0.4], [0.4, 0.0], [0.0, -0.1]], 0.36, 1.2)
    basis = turbulent_basis(mask, 3, 0, 0.25, 20.0)
    model = ExposureModel(mask, GRID, basis)
    z = torch.randn(2, basis.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    moved = model.psf(z + tilt(model, (1.3, -0.6)))
    torch.testing.assert_close(moved, shift(model.psf(z), (1.3, -0.6)), rtol=0, atol=1e-9)


def moved_away(objective, state, offset):
    """The state whose object lies `offset` away and whose aberrations make up for it: nothing changes in the frames."""
    image = shift(state.image, offset)
    return replace(state, image=image, z=state.z - tilt(objective.model, offset))


@pytest.mark.parametrize(
    ("offset", "whole"),
    [
        ((0.0, -0.2), (0, 0)),
        ((-0.4, 0.2), (0, 0)),
        ((0.4, 0.0), (0, 0)),  # 0.4 further on it would be at 0.8, and then at (1, 0), which is as good
        ((0.6, -0.4), (1, 0)),
        ((-0.2, -0.6), (0, -1)),
    ],
)
def test_an_object_off_its_pixels_comes_back_to_them(offset, whole, explained):
    """To its own or to the next, which no frame can tell; settled there it costs less than the truth itself."""
    objective, state = explained
    state = state.calibrated(aberration_weight=0.0)
    away = moved_away(objective, state, offset)
    torch.testing.assert_close(objective.model(away.image, away.z), objective.model(state.image, state.z))
    found = centre_on_pixels(objective, away, SCHEDULE)
    torch.testing.assert_close(found.z, state.z - tilt(objective.model, whole), rtol=0, atol=1e-9)
    assert bool((found.image >= 0).all())
    assert float((found.image - state.image.roll(whole, (0, 1))).norm()) < 0.5 * float(
        (away.image - state.image).norm()
    )
    assert found.calibration is away.calibration
    values = [objective.value_and_gradients(one.image, one.z, one.calibration).value for one in (found, state, away)]
    assert values[0] < values[1] < values[2]


@pytest.mark.parametrize("noise", [0.3, 1.0])
@pytest.mark.parametrize("background", [Background.PER_FRAME, Background.COMMON])
def test_beside_a_sky_an_object_that_is_moved_costs_no_more_than_before(background, noise, explain):
    """The object's light has a price there: without it a settled object gains light that the sky should have."""
    told, state = explain(noise=noise)
    objective = MyopicObjective(told.model.beside(background), told.frames + 3.0, told.precision, told.prior)
    begun = settle(objective, state.calibrated(aberration_weight=0.0), 1000)
    found = centre_on_pixels(objective, begun, SCHEDULE)
    before, after = (float(objective.evaluator(one.calibration)(one.image, one.z).value) for one in (begun, found))
    assert found is not begun
    assert after < before


@pytest.mark.parametrize("background", [Background.NONE, Background.PER_FRAME, Background.COMMON])
def test_an_object_is_settled_in_the_misfit_and_the_price_of_its_light(background, explained, monkeypatch):
    told, state = explained
    objective = MyopicObjective(told.model.beside(background), told.frames + 0.5, told.precision, told.prior)
    asked = []

    def settle_object(image, slope, power, prior, n_iterations):
        asked.append((image, slope, power, prior, n_iterations))
        return 0.0, 2 * image

    monkeypatch.setattr(escapes, "settle_object", settle_object)
    found = settle(objective, state, 7)
    ((image, slope, power, prior, n_iterations),) = asked
    misfit, curved = objective.object_quadratic(state.image, state.z, state.calibration)
    torch.testing.assert_close(slope, misfit + (0.0 if background is Background.NONE else 1.0), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(power, curved)
    assert (image is state.image, prior is objective.prior, n_iterations) == (True, True, 7)
    assert torch.equal(found.image, 2 * state.image)
    assert found.z is state.z


def test_an_object_on_its_pixels_is_the_very_same_state(explained):
    objective, state = explained
    assert centre_on_pixels(objective, state, SCHEDULE) is state


def test_a_prior_on_the_aberrations_that_holds_more_than_the_object_gains_keeps_it(explained):
    objective, state = explained
    away = moved_away(objective, state, (0.4, 0.0))
    held = objective.with_changes(centre=away.z)
    for weight, stays in ((1e9, True), (1e-9, False)):
        begun = away.calibrated(aberration_weight=weight)
        assert (centre_on_pixels(held, begun, SCHEDULE) is begun) == stays


def test_places_are_those_of_the_schedule(explained):
    objective, state = explained
    away = moved_away(objective, state.calibrated(aberration_weight=0.0), (0.4, 0.0))
    assert centre_on_pixels(objective, away, replace(SCHEDULE, pixel_steps=())) is away
