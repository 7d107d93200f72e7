"""What frames tell of themselves between two descents, in closed form."""

from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.calibration import (
    calibrate,
    fit_of_frames,
    follow_turbulence,
    recalibrate,
    share_noise_inflation,
    sharpen_noise_inflation,
    unwrap_pistons,
)
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation

GRID = Grid((16, 18), 2.3e-7, 550e-9)
TRANSMISSION = torch.tensor([0.7, 0.9, 1.1, 1.3], dtype=torch.float64)
FRAMES = len(TRANSMISSION)


@pytest.fixture(scope="module")
def problem(three_holes):
    """Makes objective and state of random frames."""
    basis = turbulent_basis(three_holes, 3, 0, 0.3, 20.0)

    def make(precision=None, free=Free.OBJECT | Free.ABERRATIONS | Free.COMMON, band=None, noise=0.3):
        model = ExposureModel(three_holes, GRID, basis, band)
        generator = torch.Generator().manual_seed(0)

        def normal(*shape):
            return torch.randn(*shape, dtype=torch.float64, generator=generator)

        image, z = 1 + normal(*model.window.field.shape).abs(), normal(FRAMES, basis.n_parameters)
        frames = TRANSMISSION[:, None, None] * model(image, z) + noise * normal(FRAMES, *GRID.shape)
        precision = torch.full((1, 1, 1), 4.0, dtype=torch.float64) if precision is None else precision
        objective = MyopicObjective(model, frames, precision, TotalVariation(), free=free)
        ones = torch.ones(FRAMES, dtype=torch.float64)
        return objective, State(image, z, Calibration(ones, 2 * ones, 0.8))

    return make


def random_precision():
    """With pixels that are not valid, more in some frames."""
    generator = torch.Generator().manual_seed(5)
    precision = torch.rand(FRAMES, *GRID.shape, dtype=torch.float64, generator=generator)
    precision[torch.rand(precision.shape, generator=generator) < 0.1] = 0
    precision[2, :5] = 0
    return precision


@pytest.mark.parametrize("precision", [None, random_precision()], ids=["one for all", "of each pixel"])
def test_transmission_and_chi_square_are_those_of_a_straight_line_through_zero(precision, problem):
    """Weighted least squares of each frame against its model, solved by LAPACK."""
    objective, state = problem(precision)
    transmission, chi_square = fit_of_frames(objective, state)
    weight = objective.precision.expand_as(objective.frames).sqrt()
    made = objective.model(state.image, state.z)
    for frame in range(FRAMES):
        left = (weight[frame] * made[frame]).flatten()[:, None]
        right = (weight[frame] * objective.frames[frame]).flatten()[:, None]
        found = torch.linalg.lstsq(left, right)
        residual = float(((left @ found.solution - right) ** 2).sum())
        assert float(transmission[frame]) == pytest.approx(found.solution.item(), rel=1e-12)
        n_valid = int((weight[frame] > 0).sum())
        assert float(chi_square[frame]) == pytest.approx(residual / n_valid, rel=1e-11)


def test_frames_that_are_the_model_have_their_transmission_and_no_residual(problem):
    objective, state = problem(noise=0.0)
    transmission, chi_square = fit_of_frames(objective, state)
    torch.testing.assert_close(transmission, TRANSMISSION, rtol=1e-12, atol=0)
    assert float(chi_square.max()) < 1e-24


def test_many_frames_are_fitted_in_parts(problem, monkeypatch):
    objective, state = problem(random_precision())
    whole = fit_of_frames(objective, state)
    monkeypatch.setattr("torchmask.restoration.forward._CHUNK", AtATime(1, 1))
    for one, other in zip(whole, fit_of_frames(objective, state), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-13, atol=0)


def test_a_frame_without_light_has_the_least_transmission(problem):
    objective, state = problem()
    objective.frames[0] *= -1
    assert float(fit_of_frames(objective, state)[0][0]) == 1e-3


@pytest.mark.parametrize("background", [Background.NONE, Background.PER_FRAME, Background.COMMON])
def test_an_object_without_light_leaves_the_frames_alike(background, problem):
    """A sky takes the light of frames that show no object."""
    objective, state = problem(random_precision())
    objective = objective.with_changes(model=objective.model.beside(background))
    now = calibrate(objective, replace(state, image=torch.zeros_like(state.image)))
    assert float(now.image.abs().max()) == 0
    torch.testing.assert_close(now.calibration.transmission, torch.ones_like(TRANSMISSION), rtol=1e-12, atol=0)
    assert bool(torch.isfinite(now.calibration.noise_inflation).all())


def test_calibrated_transmissions_are_one_on_average_and_noise_is_not_deflated(problem):
    objective, state = problem(noise=0.3)
    transmission, chi_square = fit_of_frames(objective, state)
    now = calibrate(objective, state).calibration
    torch.testing.assert_close(now.transmission, transmission / transmission.mean())
    assert 0 < float(chi_square.min()) < 1  # 4 x 0.3^2
    assert now.noise_inflation.tolist() == [1.0] * FRAMES
    objective, state = problem(noise=2.0)
    now = calibrate(objective, state).calibration
    torch.testing.assert_close(now.noise_inflation, fit_of_frames(objective, state)[1])
    assert now.aberration_weight == 0.8


def inflated(*values):
    inflation = torch.tensor(values, dtype=torch.float64)
    ones = torch.ones_like(inflation)
    return State(torch.ones(2, 2), torch.zeros(len(values), 1), Calibration(ones, inflation, 1.0))


@pytest.mark.parametrize(
    ("power", "given", "expected"),
    [
        (2, (1, 2, 4, 6, 8), [2.0, 2.0, 8.0, 18.0, 32.0]),
        (1, (1, 2, 4, 6, 8), [1.0, 2.0, 4.0, 6.0, 8.0]),
        (2, (2, 4), [2.0, 8.0]),  # a quarter of few frames is one
        (2, (2, 4, 6, 8), [2.0, 8.0, 18.0, 32.0]),
    ],
)
def test_frames_are_weighed_by_how_well_they_fit(power, given, expected):
    """Through a full pupil by the square, against the best quarter of the frames, which count alike."""
    assert sharpen_noise_inflation(inflated(*given), power).calibration.noise_inflation.tolist() == expected


def test_shared_noise_is_the_mean_of_all():
    assert share_noise_inflation(inflated(2, 4, 6)).calibration.noise_inflation.tolist() == [4.0] * 3


def test_the_prior_follows_the_strength_of_the_turbulence(problem):
    objective, state = problem()
    strength = objective.model.aberrations.turbulence_strength(state.z)
    assert follow_turbulence(objective, state).calibration.aberration_weight == pytest.approx(1 / strength, rel=1e-12)
    twice = follow_turbulence(objective, State(state.image, 2**0.5 * state.z, state.calibration))
    assert twice.calibration.aberration_weight == pytest.approx(1 / (2 * strength), rel=1e-12)


def test_known_aberrations_tell_no_turbulence(problem):
    objective, state = problem(free=Free.OBJECT)
    assert follow_turbulence(objective, state) is state


def test_too_few_modes_tell_no_turbulence(three_holes):
    basis = turbulent_basis(three_holes, 1, 0, 0.3, 20.0)
    objective = MyopicObjective(
        ExposureModel(three_holes, GRID, basis), torch.ones(2, *GRID.shape), torch.ones(1, 1, 1), TotalVariation()
    )
    ones = torch.ones(2, dtype=torch.float64)
    state = State(torch.ones(20, 24), torch.ones(2, 2, dtype=torch.float64), Calibration(ones, ones, 0.8))
    assert follow_turbulence(objective, state) is state


def with_waves(objective, state):
    """A full wave on the second hole of every frame, as far as the mean piston allows."""
    basis = objective.model.aberrations
    coefficients = basis.coefficients(state.z)
    coefficients[:, 1, 0] += 2 * torch.pi
    return State(state.image, basis.parameters_of(coefficients), state.calibration)


def test_full_waves_are_taken_off_the_pistons(problem):
    objective, state = problem()
    state = unwrap_pistons(objective, state)
    far = with_waves(objective, state)
    near = unwrap_pistons(objective, far)
    assert float(near.z.square().sum()) < float(far.z.square().sum())
    torch.testing.assert_close(near.z, state.z, rtol=0, atol=1e-9)


def test_what_comes_off_is_a_wave_of_the_light(problem):
    """Not of the wavelength of the grid: frames stay what they are, and pistons come as near as they can."""
    objective, state = problem(band=Band.of((620e-9,)))
    far = with_waves(objective, with_waves(objective, state))
    near = unwrap_pistons(objective, far)
    assert float(near.z.square().sum()) < float(far.z.square().sum())
    torch.testing.assert_close(objective.model(far.image, near.z), objective.model(far.image, far.z))


def test_waves_stay_where_they_are_known_unheld_or_seen(problem):
    """Of known aberrations, of those without a prior, and in a band, whose wavelengths tell them."""
    for options, weight in (
        ({"free": Free.OBJECT}, 0.8),
        ({}, 0.0),
        ({"band": Band.of((500e-9, 550e-9))}, 0.8),
    ):
        objective, state = problem(**options)
        far = with_waves(objective, state).calibrated(aberration_weight=weight)
        assert unwrap_pistons(objective, far) is far


@pytest.mark.parametrize("power", [None, 1, 2])
@pytest.mark.parametrize("follow_r0", [False, True])
def test_recalibration_is_all_of_it_in_turn(power, follow_r0, problem):
    """None: objects are still being found, and all frames count alike."""
    objective, state = problem(noise=2.0)
    found = recalibrate(objective, with_waves(objective, state), power, follow_r0=follow_r0)
    expected = calibrate(objective, state)
    expected = share_noise_inflation(expected) if power is None else sharpen_noise_inflation(expected, power)
    expected = unwrap_pistons(objective, expected)
    torch.testing.assert_close(found.z, expected.z, rtol=0, atol=1e-9)
    now, then = found.calibration, expected.calibration
    torch.testing.assert_close(now.transmission, then.transmission, rtol=1e-9, atol=0)
    torch.testing.assert_close(now.noise_inflation, then.noise_inflation, rtol=1e-9, atol=0)
    strength = objective.model.aberrations.turbulence_strength(found.z)
    assert now.aberration_weight == pytest.approx(1 / strength if follow_r0 else 0.8, rel=1e-9)
