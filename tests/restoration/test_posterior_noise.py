"""Standard deviations under uneven noise, priors of any weight and an object that is not the posterior mean."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import lowpass
from torchmask.restoration import posterior
from torchmask.restoration.aberrations import AberrationBasis, whitening
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.posterior import _filter, _sample, standard_deviations
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.structure import smooth
from torchmask.restoration.variation import TotalVariation

GRID = Grid.nyquist(1.0, 550e-9, 32)


def problem(mask, precision, *, free=Free.ABERRATIONS, n_frames=1, inflation=1.0, weight=1.0):
    """A bright block on a dim ground, through a field without margin, so that convolutions are periodic."""
    basis = AberrationBasis(whitening(mask, 3, 0.3, 20.0), 3)
    model = ExposureModel(mask, GRID, basis, margin=0.0)
    generator = torch.Generator().manual_seed(0)
    image = torch.full(GRID.shape, 0.2, dtype=torch.float64)
    image[10:14, 12:20] = 20.0
    z = 0.5 * torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=generator)
    weights = torch.full((n_frames, 1, 1), precision, dtype=torch.float64)
    objective = MyopicObjective(model, model(image, z), weights, TotalVariation(), free=free)
    ones = torch.ones(n_frames, dtype=torch.float64)
    return objective, State(image, z, Calibration(ones, inflation * ones, weight))


@pytest.fixture(scope="module")
def jacobian(five_holes):
    """Derivatives (H W, K) of the frame in its aberrations, which neither noise nor weights change."""
    objective, state = problem(five_holes, precision=1.0)
    found = torch.autograd.functional.jacobian(lambda z: objective.model(state.image, z).flatten(), state.z)
    assert isinstance(found, torch.Tensor)
    return found[:, 0]


def sampled(objective, state, share, n_samples, seed=1):
    """Samples of object and aberrations under an even prior on the object."""
    power = objective.object_quadratic(state.image, state.z, state.calibration)[1]
    prior = torch.full(GRID.shape, 40.0, dtype=torch.float64)
    generator = torch.Generator().manual_seed(seed)
    return _sample(objective, state, power, prior, share, n_samples, generator)


@pytest.mark.parametrize("weight", [1.0, 5.0])
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_photons_scatter_aberrations_more_where_there_is_more_light(share, weight, five_holes, jacobian, monkeypatch):
    """A sample solves H z = J^T (W v)^(1/2) n + weight^(1/2) m, with H = J^T W J + weight, for a known object.

    n and m are white noise, known here, and v is the variance over the one that the misfit assumes to be even:
    1 - share + share times the light over its mean. The first term has the covariance J^T W v J then.
    """
    objective, state = problem(five_holes, precision=100.0, weight=weight)
    generator, made = torch.Generator().manual_seed(3), {}

    def white(shape, like, _):
        return made.setdefault(shape, torch.randn(shape, dtype=like.dtype, generator=generator))

    monkeypatch.setattr(posterior, "_white", white)
    found = sampled(objective, state, share, 1)[1][0, 0]
    light = objective.model(state.image, state.z).flatten()
    variance = 1 - share + share * light / light.mean()
    hessian = 100.0 * jacobian.T @ jacobian + weight * torch.eye(state.z.shape[1], dtype=torch.float64)
    noise, of_prior = made[1, 1, *GRID.shape].flatten(), made[1, 1, state.z.shape[1]].flatten()
    right = jacobian.T @ ((100.0 * variance).sqrt() * noise) + math.sqrt(weight) * of_prior
    expected = torch.linalg.solve(hessian, right)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-8 * float(expected.abs().max()))


def test_noise_that_was_inflated_has_the_photons_that_it_had(five_holes):
    """Inflating the noise of given precision is giving less precision, of which photons are a smaller share."""
    free = Free.OBJECT | Free.ABERRATIONS
    inflated = sampled(*problem(five_holes, precision=100.0, free=free, inflation=4.0), 0.8, 2)
    given = sampled(*problem(five_holes, precision=25.0, free=free), 0.2, 2)
    for one, other in zip(inflated, given, strict=True):  # the same numbers, divided and multiplied in another order
        torch.testing.assert_close(one, other, rtol=0, atol=1e-9 * float(other.abs().max()))


@pytest.mark.parametrize("weight", [0.25, 9.0])
def test_aberrations_that_frames_do_not_show_scatter_as_their_prior(weight, five_holes):
    """With the variance 1 / weight, within four standard errors."""
    objective, state = problem(five_holes, precision=1e-12, n_frames=3, weight=weight)
    samples = sampled(objective, state, 0.0, 8)[1]
    scatter = math.sqrt(2 / samples.numel())
    assert float(samples.square().mean()) * weight == pytest.approx(1, abs=4 * scatter)


@pytest.mark.parametrize("known", [False, True])
def test_the_deviation_of_the_object_includes_what_it_is_off_the_posterior_mean(known, five_holes, monkeypatch):
    """By sum: the mean square of the samples and the square of the bias, both below the cut-off, and then smoothed.

    Under an even prior, of 2.5 times the likeliest inverse variance, the bias is a filter of the slope of the cost. An
    object that is known is the posterior mean.
    """
    free, cutoff, likeliest = Free.ABERRATIONS if known else Free.OBJECT, 0.3, 4.0
    objective, state = problem(five_holes, precision=100.0, free=free)
    state = State(state.image.roll(1, 0), state.z, state.calibration)  # not what the frames show
    drawn = torch.randn(3, *GRID.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    asked = []

    def drawn_before(*arguments):
        asked.append(arguments[3])
        return drawn, torch.zeros(3, *state.z.shape, dtype=torch.float64)

    monkeypatch.setattr(posterior, "_sample", drawn_before)
    monkeypatch.setattr(posterior, "_gradient_prior", lambda *_: torch.full(GRID.shape, likeliest, dtype=torch.float64))
    found, _ = standard_deviations(objective, state, cutoff, 0.0, 3)

    prior, nu = 2.5 * likeliest, torch.fft.fftfreq(32, dtype=torch.float64)
    assert asked[0].unique().tolist() == [prior]
    smoothness = 4 * ((math.pi * nu[:, None]).sin() ** 2 + (math.pi * nu[None, :17]).sin() ** 2)
    slope, power = objective.object_quadratic(state.image, state.z, state.calibration)
    away = _filter(slope, 1 / (power + prior * smoothness)) + _filter(
        state.image, prior * smoothness / (power + prior * smoothness)
    )
    off = 0.0 if known else lowpass(away, cutoff).square()
    expected = smooth(lowpass(drawn, cutoff).square().mean(0) + off, 0.7 / cutoff).sqrt()
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=0)
