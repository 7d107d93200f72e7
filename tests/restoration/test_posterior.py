"""Standard deviations against closed forms, and against the errors of whole restorations."""

import math
import statistics

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.metrics import align, lowpass
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.restoration.aberrations import AberrationBasis, whitening
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.posterior import (
    _bias,
    _filter,
    _gradient_prior,
    _prior_noise,
    _sample,
    evenness,
)
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.slopes import divergence, gradient
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.structure import smooth
from torchmask.restoration.variation import TotalVariation
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

GRID = Grid.nyquist(1.0, 550e-9, 32)


def problem(mask, n_common=0, free=Free.OBJECT | Free.ABERRATIONS | Free.COMMON, n_frames=3, photons=1e4):
    """A block seen through a field without margin, so that convolutions are periodic."""
    basis = AberrationBasis(whitening(mask, 3, 0.3, 20.0), 3, n_common)
    model = ExposureModel(mask, GRID, basis, margin=0.0)
    generator = torch.Generator().manual_seed(0)
    image = torch.full(GRID.shape, 0.2, dtype=torch.float64)
    image[12:20, 10:22] = 3.0
    z = 0.5 * torch.randn(n_frames, basis.n_parameters, dtype=torch.float64, generator=generator)
    z = basis.with_common_of(z, z[:1])
    precision = torch.full((n_frames, 1, 1), photons, dtype=torch.float64)
    ones = torch.ones(n_frames, dtype=torch.float64)
    stated = MyopicObjective(model, model(image, z), precision, TotalVariation(), free=free)
    return stated, State(image, z, Calibration(ones, ones, 1.0))


def power_of(stated, state):
    return stated.object_quadratic(state.image, state.z, state.calibration)[1]


@pytest.mark.parametrize("scale", [1.0, 1e-12, 1e9])
@pytest.mark.parametrize("side", [3, 12, 30])
def test_deviations_of_even_objects_shrink_with_the_share_of_even_pixels(side, scale):
    """Of a square, whose last row and column have gradients, towards the next pixel; a faint pedestal is none of it."""
    image = torch.zeros(64, 48, dtype=torch.float64)
    image[8 : 8 + side, 6 : 6 + side] = scale
    share = (1 - 1 / side) ** 2
    for pedestal in (0.0, 0.05 * scale):
        assert evenness(image + pedestal) == pytest.approx(math.exp(-3.5 * share**2), rel=1e-12)


def test_deviations_of_objects_without_even_pixels_stay():
    """Of one pixel, and of none; of a rough one, of which one pixel in a hundred is even, they hardly change."""
    point = torch.zeros(64, 48, dtype=torch.float64)
    point[3, 4] = 1.0
    for image in (point, 0 * point):
        assert evenness(image) == 1.0
    rough = torch.rand(64, 48, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert 0.99 < evenness(rough) <= 1.0


def test_noise_of_the_prior_has_its_hessian_as_covariance():
    generator = torch.Generator().manual_seed(0)
    prior = torch.rand(5, 6, dtype=torch.float64, generator=generator) + 0.5
    n = 20000
    noise = _prior_noise(prior, n, generator).flatten(1)
    units = torch.eye(30, dtype=torch.float64).view(30, 5, 6)
    hessian = divergence(*(prior * slope for slope in gradient(units))).flatten(1)
    spread = hessian.diagonal().sqrt()
    error = (noise.T @ noise / n - hessian).abs() / torch.outer(spread, spread)
    assert float(error.max()) < 5 * math.sqrt(2 / n)  # a sample variance is off by sqrt(2 / n); 5 sigma of 465 entries


def test_the_object_alone_has_the_closed_form(five_holes):
    """With known PSFs and an even prior the posterior is diagonal in frequency: variance 1 / (power + prior |k|^2)."""
    stated, state = problem(five_holes, free=Free.OBJECT)
    power, prior = power_of(stated, state), torch.full(GRID.shape, 40.0, dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    objects, aberrations = _sample(stated, state, power, prior, 0.0, 12, generator)
    assert not bool(aberrations.any())
    nu = torch.fft.fftfreq(32, dtype=torch.float64)
    smoothness = 4 * ((math.pi * nu[:, None]).sin() ** 2 + (math.pi * nu[None]).sin() ** 2)
    full_power = torch.fft.fft2(torch.fft.irfft2(power, s=GRID.shape)).real
    expected = 1 / (full_power + 40.0 * smoothness)
    # 12 samples of each of the frequencies, half of which are independent
    relative = math.sqrt(2 * float((expected**2).sum()) / float(expected.sum()) ** 2 / 12)
    measured = float(objects.square().mean())
    assert measured == pytest.approx(float(expected.mean()), rel=4 * relative)
    assert relative < 0.03


@pytest.mark.slow
def test_aberrations_alone_have_the_inverse_of_their_hessian(five_holes):
    """With a known object the frames are apart, and the Hessian is a small matrix."""
    stated, state = problem(five_holes, free=Free.ABERRATIONS, n_frames=1)
    model = stated.model
    jacobian = torch.autograd.functional.jacobian(lambda z: model(state.image, z).flatten(), state.z)[:, 0]
    hessian = 1e4 * jacobian.T @ jacobian + torch.eye(state.z.shape[1], dtype=torch.float64)
    expected = torch.linalg.inv(hessian).diagonal()
    prior = torch.ones(GRID.shape, dtype=torch.float64)
    n = 200
    _, samples = _sample(stated, state, power_of(stated, state), prior, 0.0, n, torch.Generator().manual_seed(2))
    ratio = samples[:, 0].square().mean(0) / expected
    assert float((ratio - 1).abs().max()) < 4.5 * math.sqrt(2 / n)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_without_a_prior_what_is_seen_scatters_as_it_should_and_the_rest_stays(dtype, five_holes):
    """The mean piston has no curvature at all then: rounding must not send it to infinity."""
    model = ExposureModel(five_holes, GRID, 3, margin=0.0, dtype=dtype)
    known, truth = problem(five_holes, free=Free.ABERRATIONS, n_frames=1)
    z = known.model.aberrations.coefficients(truth.z).flatten(1)
    frames, precision = model(truth.image, z), known.precision.to(dtype)
    stated = MyopicObjective(model, frames, precision, TotalVariation(), free=known.free)
    state = State(truth.image, z, truth.calibration).calibrated(aberration_weight=0.0)
    jacobian = torch.autograd.functional.jacobian(lambda z: model(state.image, z).flatten(), z)[:, 0]
    values, vectors = torch.linalg.eigh(1e4 * jacobian.T @ jacobian)
    assert float(values[0]) < 1e-6 * float(values[1])
    prior, power = torch.ones(GRID.shape, dtype=torch.float64), power_of(stated, state)
    n = 100
    samples = _sample(stated, state, power, prior, 0.0, n, torch.Generator().manual_seed(2))[1][:, 0] @ vectors
    ratio = samples[:, 1:].square().mean(0) * values[1:]
    assert float((ratio - 1).abs().max()) < 4.5 * math.sqrt(2 / n)
    assert float(samples[:, 0].abs().max()) < float(samples[:, 1].abs().max())


def test_common_aberrations_are_alike_and_better_known(five_holes):
    single = problem(five_holes, n_frames=4)
    common = problem(five_holes, n_common=3, n_frames=4)
    prior = torch.full(GRID.shape, 40.0, dtype=torch.float64)
    spread = []
    for stated, state in (single, common):
        _, z = _sample(stated, state, power_of(stated, state), prior, 0.0, 40, torch.Generator().manual_seed(3))
        spread.append(z[..., -3:].square().mean().sqrt())
    assert float((z[..., -3:] - z[:, :1, -3:]).abs().max()) < 1e-12
    assert float(spread[1]) < 0.75 * float(spread[0])  # 0.5 if the four frames said the same


def test_an_unknown_object_leaves_aberrations_less_known_and_the_other_way_round(five_holes):
    prior = torch.full(GRID.shape, 1.0, dtype=torch.float64)
    results = {}
    everything = Free.OBJECT | Free.ABERRATIONS
    for free in (Free.OBJECT, Free.ABERRATIONS, everything):
        stated, state = problem(five_holes, free=free, photons=300.0)
        generator = torch.Generator().manual_seed(3)
        objects, z = _sample(stated, state, power_of(stated, state), prior, 0.0, 30, generator)
        results[free] = float(lowpass(objects, 0.3).square().mean()), float(z.square().mean())
    assert results[everything][0] > 1.02 * results[Free.OBJECT][0]
    assert results[everything][1] > 1.02 * results[Free.ABERRATIONS][1]


def inside(observation, result):
    """The share of bright pixels whose error is below one standard deviation."""
    truth, found = lowpass(observation.object, 0.5), align(result.object, observation.object, 0.5)
    gain = float(found.norm() / lowpass(result.object, 0.5).norm())
    bright = truth > 0.1 * float(torch.quantile(truth.flatten(), 0.995))
    return float(((found - truth).abs() < gain * result.object_std)[bright].double().mean())


@pytest.mark.slow
@pytest.mark.parametrize("photons", [1e5, 1e7])
def test_about_two_thirds_of_bright_pixels_lie_within_one_sigma(photons):
    grid, apertures = Grid.nyquist(1.0, 550e-9, 48), SparseAperture.from_catalog("golay9", 1.0, 0.15)
    scene = make_scene(grid.shape, photons, SceneOptions(size=0.5))
    turbulence, generator = TurbulencePhase(1 / 7, 20.0), torch.Generator().manual_seed(0)
    seen = simulate_observation(scene, apertures, grid, turbulence, Detector(1.5), 6, generator)
    once = Schedule(in_vain=0)  # in less time
    result = MyopicDeconvolution(apertures, grid, schedule=once).restore(seen.frames, n_samples=8)
    assert 0.5 < inside(seen, result) < 0.85


@pytest.mark.slow
def test_coefficients_scatter_as_said(five_holes):
    """Errors of the coefficients over their standard deviations, from frames that the model itself has made."""
    columns = whitening(five_holes, 3, 1.5, 20.0)
    model = ExposureModel(five_holes, GRID, 3)
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[12:20, 10:22], image[13:16, 13:28] = 3000.0, 5000.0
    method = MyopicDeconvolution(five_holes, GRID, 3, r0=1.5, outer_scale=20.0)
    pulls = []
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        z = torch.randn(6, columns.shape[1], dtype=torch.float64, generator=generator)
        true = (z @ columns.T).unflatten(1, (5, 3))
        frames = torch.poisson(model(image, true.flatten(1)).clamp(min=0), generator=generator)
        result = method.restore(frames, known_object=image[:32, :32], n_samples=12)
        error = result.coefficients - true
        error[..., 0] -= error[..., 0].mean(1, keepdim=True)
        pulls.append(float((error / result.coefficients_std).square().mean().sqrt()))
        assert result.object_std is not None
        assert not bool(result.object_std.any())  # it is known
    # The deviations are those of all frames together, while each frame has its own: one stack alone scatters by 0.15.
    assert statistics.mean(pulls) == pytest.approx(1, abs=4 * statistics.stdev(pulls) / math.sqrt(len(pulls)))


@pytest.mark.filterwarnings("ignore:the fringes of the frames are not those")  # no mask was in front of them
def test_deviations_are_kept_and_asked_for(tmp_path, five_holes):
    frames = torch.full((2, 32, 32), 20.0, dtype=torch.float64)
    frames[:, 10:20, 13:19] = 1000.0
    frames = torch.poisson(smooth(frames, 1.5), generator=torch.Generator().manual_seed(0))
    method = MyopicDeconvolution(five_holes, GRID, 3, max_iterations=3)
    plain = method.restore(frames)
    assert plain.object_std is None
    assert plain.coefficients_std is None
    result = method.restore(frames, n_samples=2)
    assert result.object_std.shape == (32, 32)
    assert result.coefficients_std.shape == (5, 3)
    result.save(tmp_path / "result.npz")
    again = type(result).load(tmp_path / "result.npz")
    assert torch.equal(again.object_std, result.object_std)
    plain.save(tmp_path / "plain.npz")
    assert type(result).load(tmp_path / "plain.npz").object_std is None
    for bad in (-1, 1):
        with pytest.raises(ValueError, match="at least 2"):
            method.restore(frames, n_samples=bad)


@pytest.mark.parametrize("noisy", [False, True])
def test_the_prior_has_the_variance_of_the_gradients(noisy):
    """Seen perfectly: 1 / 36. Not seen at all, nothing changes it: its mean is even, and all of 1 / prior is lost."""
    generator = torch.Generator().manual_seed(0)
    image = 3.0 * torch.randn(96, 96, dtype=torch.float64, generator=generator)  # gradients of variance 2 x 9
    power = torch.full((96, 49), 1e-12 if noisy else 1e12, dtype=torch.float64)
    prior = _gradient_prior(power, image, torch.zeros_like(image), 8.0, generator)
    # A Gaussian of 8 pixels averages over 4 pi 8^2 = 804 of them; neighbouring gradients are correlated by 1/2.
    scatter = 2 / math.sqrt(804)
    assert float(prior.mean()) == pytest.approx(1 / 36, rel=scatter)
    assert float(prior.std()) < scatter / 36


@pytest.mark.parametrize("smoothing", [0.1, 10.0])
def test_the_prior_is_that_of_the_object_whatever_it_was_restored_by(smoothing):
    """A Gaussian object in noise, of which nothing is seen above 0.45 cycles per pixel, restored with another prior.

    The likeliest prior has a relative error of (2 / sum w^2)^(1/2), with the share w of data in each frequency.
    """
    side, cutoff, true, precision = 96, 0.45, 0.3, 8.0
    generator = torch.Generator().manual_seed(0)
    nu = torch.fft.fftfreq(side, dtype=torch.float64)
    nu_y, nu_x = nu[:, None], nu[None, : side // 2 + 1].abs()
    smoothness = 4 * ((math.pi * nu_y).sin() ** 2 + (math.pi * nu_x).sin() ** 2)
    power = precision * (nu_y**2 + nu_x**2 < cutoff**2)
    white = torch.randn(2, side, side, dtype=torch.float64, generator=generator)
    truth = _filter(white[0], (true * smoothness.clamp(min=smoothness[0, 1])).rsqrt())
    seen = truth + white[1] / math.sqrt(precision)
    restored = _filter(seen, power / (power + smoothing * true * smoothness))
    prior = _gradient_prior(power, restored, _filter(restored - seen, power), 8.0, generator)
    share = 2 * (power / (power + true * smoothness)).square().sum()  # the half-plane twice
    assert float(1 / (1 / prior).mean()) == pytest.approx(true, rel=4 * math.sqrt(2 / float(share)))


def test_bias_leads_to_the_mean_of_the_posterior():
    """For an even prior the mean is a filter: of data o + slope/power it is power / (power + prior |k|^2)."""
    generator = torch.Generator().manual_seed(0)
    image, slope = (torch.randn(32, 32, dtype=torch.float64, generator=generator) for _ in range(2))
    power, prior = torch.full((32, 17), 2.0, dtype=torch.float64), torch.full((32, 32), 0.7, dtype=torch.float64)
    nu = torch.fft.fftfreq(32, dtype=torch.float64)
    smoothness = 4 * ((math.pi * nu[:, None]).sin() ** 2 + (math.pi * nu[None, :17]).sin() ** 2)
    seen = image - slope / 2.0  # where the quadratic misfit has its least
    mean = _filter(seen, 2.0 / (2.0 + 0.7 * smoothness))
    torch.testing.assert_close(image + _bias(image, slope, power, prior), mean, rtol=0, atol=1e-9)


def test_filter_is_periodic_convolution():
    image = torch.rand(6, 8, dtype=torch.float64)
    kernel = torch.zeros(6, 8, dtype=torch.float64)
    kernel[0, 1] = 1
    torch.testing.assert_close(_filter(image, torch.fft.rfft2(kernel)), image.roll(1, 1))
