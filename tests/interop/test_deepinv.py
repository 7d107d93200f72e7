"""A stack of exposures as a physics of deepinv: an exact adjoint, the detector's noise, and their solvers at work."""

import importlib.util

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation

if importlib.util.find_spec("deepinv") is None:
    pytest.skip("needs the extra deepinv", allow_module_level=True)


def import_torchvision():
    """deepinv imports torchvision, which refuses a torch that its binary was not built for (say, one without CUDA).

    deepinv needs none of its operators here, so stand-ins for the two it looks for will do.
    """
    try:
        import torchvision
    except RuntimeError:
        operators = torch.library.Library("torchvision", "FRAGMENT")
        for name in ("nms", "qnms"):
            operators.define(f"{name}(Tensor dets, Tensor scores, float iou_threshold) -> Tensor")
        import torchvision

        torchvision.operators_of_the_test = operators  # a Library is undone when it is collected


import_torchvision()
deepinv = pytest.importorskip("deepinv")
from torchmask.interop.deepinv import DeepinvPrior, StackPhysics  # noqa: E402

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture.from_catalog("golay6", mask_diameter=1.0, fill_factor=0.3)


def seeded():
    return torch.Generator().manual_seed(0)


def random_psfs(*shape, dtype=torch.float64):
    psfs = torch.rand(*shape, generator=seeded(), dtype=torch.float64)
    return (psfs / psfs.sum((-2, -1), keepdim=True)).to(dtype)


@pytest.fixture(scope="module")
def observation():
    scene = torch.zeros(32, 32, dtype=torch.float64)
    scene[11:20, 14:17] = 1.0
    scene[14:16, 9:23] = 2.0
    scene *= 1e7 / scene.sum()
    turbulence = TurbulencePhase(0.2, 20.0)
    return simulate_observation(scene, MASK, GRID, turbulence, Detector(1.5), 6, seeded())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("batch", [(), (2,)], ids=["shared", "batched"])
def test_adjoint(dtype, batch):
    physics = StackPhysics(random_psfs(*batch, 3, 15, 18, dtype=dtype))
    x = torch.randn(2, 1, 8, 9, generator=seeded(), dtype=torch.float64).to(dtype)
    y = torch.randn(2, 3, 8, 9, generator=seeded(), dtype=torch.float64).to(dtype)
    there, back = (physics.A(x) * y).sum(), (x * physics.A_adjoint(y)).sum()
    assert there.dtype == dtype
    # rounding of FFTs of 270 pixels, relative to the norms
    bound = 100 * torch.finfo(dtype).eps * float(physics.A(x).norm() * y.norm())
    assert abs(float(there - back)) < bound
    assert abs(float(there)) > 1e3 * bound


def test_the_operator_is_the_librarys_image_formation():
    psfs = random_psfs(2, 3, 16, 16)
    x = torch.rand(2, 1, 8, 8, generator=seeded(), dtype=torch.float64)
    y = StackPhysics(psfs).A(x)
    for b in range(2):
        for t in range(3):
            torch.testing.assert_close(y[b, t], image_formation(x[b, 0], psfs[b, t]), rtol=1e-12, atol=1e-15)


def test_its_norm_is_bounded_by_the_number_of_frames():
    physics = StackPhysics(random_psfs(3, 16, 16))
    x = torch.rand(1, 1, 8, 8, generator=seeded(), dtype=torch.float64)
    assert 0 < float(physics.compute_sqnorm(x, verbose=False)) <= 3


def test_noise_is_that_of_the_detector():
    """Mean and variance of 100 x 100 pixels of 50 electrons with 3 of read-out noise, in units of 20 electrons."""
    delta = torch.zeros(1, 200, 200, dtype=torch.float64)
    delta[0, 0, 0] = 1
    physics = StackPhysics(delta, unit=20.0, readout_noise=3.0, generator=seeded())
    y = physics(torch.full((1, 1, 100, 100), 50 / 20, dtype=torch.float64))
    assert y.dtype == torch.float64
    # four standard errors
    assert abs(float(y.mean()) * 20 - 50) < 4 * (59 / 1e4) ** 0.5
    assert abs(float(y.var()) * 400 / 59 - 1) < 4 * (2.05 / 1e4) ** 0.5


def test_an_observation_becomes_physics_and_measurements(observation):
    physics, y = StackPhysics.from_observation(observation, unit=500.0)
    assert y.shape == (1, 6, 32, 32)
    expected = physics.A(observation.object[None, None] / 500.0) * 500.0
    # what lies beyond the stored PSFs, and noise
    assert float((observation.frames - expected[0]).norm() / observation.frames.norm()) < 0.03
    torch.testing.assert_close(y[0] * 500.0, observation.frames)
    assert torch.equal(physics.measured(observation.frames[None]), y)


@pytest.mark.parametrize("conditions", [Conditions(transparency_scatter=0.3), Conditions(sky=500.0)])
def test_transmissions_and_sky_of_an_observation_are_known(observation, conditions):
    """The truth explains the frames as well as it does without them: but for their noise, and light beyond the PSFs."""
    scene, turbulence = observation.object, TurbulencePhase(0.2, 20.0)
    seen = simulate_observation(scene, MASK, GRID, turbulence, Detector(1.5), 6, seeded(), conditions=conditions)
    physics, y = StackPhysics.from_observation(seen)
    rest = (y - physics.A(seen.object[None, None] / physics.unit)) * physics.unit
    assert float(rest.norm() / seen.frames.norm()) < 0.03
    noise = physics.noise_model.sigma * physics.unit
    assert float(noise) == pytest.approx((1.5**2 + conditions.sky) ** 0.5)


@pytest.mark.parametrize("solver", ["FISTA", "ADMM"])
def test_total_variation_restores_the_object(observation, solver):
    """By gradients, and by the proximal operator that deepinv makes of A and its adjoint."""
    physics, y = StackPhysics.from_observation(observation)
    settings = {"FISTA": {"stepsize": 1 / 6, "max_iter": 200}, "ADMM": {"stepsize": 30.0, "max_iter": 20}}[solver]
    prior = deepinv.optim.TVPrior(n_it_max=20)
    with torch.no_grad():
        restored = getattr(deepinv.optim, solver)(deepinv.optim.L2(), prior, lambda_reg=3e-4, **settings)(y, physics)
    assert restored.dtype == torch.float64
    before, after = (
        relative_error(image, observation.object, 0.5) for image in (observation.frames.mean(0), restored[0, 0])
    )
    assert after < 0.6 * before


def test_langevin_samples_agree_with_the_exact_posterior():
    """A Gaussian prior and likelihood on one sharp frame: in every pixel N(y / (1 + s^2), s^2 / (1 + s^2))."""
    delta = torch.zeros(1, 63, 63, dtype=torch.float64)
    delta[0, 0, 0] = 1
    physics = StackPhysics(delta)
    sigma = 0.5
    y = torch.full((1, 1, 32, 32), 2.0, dtype=torch.float64)

    class Gaussian(deepinv.optim.ScorePrior):
        def __init__(self):
            super().__init__(denoiser=torch.nn.Identity())

        def forward(self, x, *args, **kwargs):
            return x

        grad = forward

    step = {"step_size": 0.02, "alpha": 1.0, "sigma": 0.0}
    options = {"params_algo": step, "max_iter": 400, "thinning": 1, "clip": None}
    sampler = deepinv.sampling.sampling_builder("ULA", deepinv.optim.L2(sigma=sigma), Gaussian(), **options)
    mean, variance = sampler.sample(y, physics, seed=0)
    assert mean.shape == (1, 1, 32, 32)
    # 1024 pixels x 320 samples, correlated over 1 / (0.02 x 5) = 10 steps: 0.45 / sqrt(1024 x 32 / 2) standard error
    assert float(mean.mean()) == pytest.approx(2 / (1 + sigma**2), abs=4 * 0.45 / (1024 * 16) ** 0.5)
    # the chain's variance is s^2 / (1 + s^2) / (1 - step 5 / 2); a sample's variance lacks that of its mean, 1 / 16
    assert float(variance.mean()) == pytest.approx(0.2 / 0.95 * (1 - 1 / 16), rel=0.03)


@pytest.mark.parametrize(
    ("psfs", "options", "message"),
    [
        (torch.rand(16, 16), {}, "psfs has shape"),
        (torch.rand(2, 16, 16), {"unit": 0.0}, "unit is 0.0"),
        (torch.rand(2, 16, 16), {"readout_noise": -1.0}, "readout_noise is -1.0"),
    ],
)
def test_bad_input_is_refused(psfs, options, message):
    with pytest.raises(ValueError, match=message):
        StackPhysics(psfs, **options)


def test_bad_images_and_observations_are_refused(observation):
    physics = StackPhysics(random_psfs(2, 16, 16))
    with pytest.raises(ValueError, match="batch, 1, rows"):
        physics.A(torch.rand(1, 3, 8, 8).double())
    with pytest.raises(ValueError, match="batch, 2, rows"):
        physics.A_adjoint(torch.rand(1, 3, 8, 8).double())
    with pytest.raises(ValueError, match="too small"):
        physics.A(torch.rand(1, 1, 9, 9).double())
    with pytest.raises(ValueError, match="no psfs"):
        StackPhysics.from_observation(Observation(observation.frames, MASK, GRID, 1.5))


PRIORS = {
    "smoothed TV": lambda: deepinv.optim.SmoothedTVPrior(),
    "Tikhonov": lambda: deepinv.optim.Tikhonov(),
    "relative differences": lambda: deepinv.optim.RDP(),
    "TV": lambda: deepinv.optim.TVPrior(),
    "L12": lambda: deepinv.optim.L12Prior(),
}


@pytest.mark.parametrize("make", PRIORS.values(), ids=PRIORS)
def test_a_prior_of_deepinv_has_its_value_gradient_and_curvature(make):
    """Gradient against central differences along a random direction; the curvature is not negative."""
    prior = DeepinvPrior(make(), weight=0.7, unit=3.0)
    image = 1 + torch.rand(12, 10, dtype=torch.float64, generator=seeded())
    value, slope = prior.value_and_gradient(image)
    assert float(value) == pytest.approx(0.7 * float(make()(image[None, None] / 3.0)), rel=1e-6)
    along = torch.randn(12, 10, dtype=torch.float64, generator=seeded())
    high, low = (float(prior.value_and_gradient(image + step * along)[0]) for step in (1e-4, -1e-4))
    assert float((slope * along).sum()) == pytest.approx((high - low) / 2e-4, rel=1e-5)
    assert float(prior.curvature(image).min()) >= 0


@pytest.mark.parametrize("name", ["TVPrior", "L12Prior"])
def test_a_prior_with_kinks_has_a_curvature_in_flat_and_dark_parts(name):
    image = 1 + torch.rand(12, 10, dtype=torch.float64, generator=seeded())
    image[:4], image[4:8] = 0.0, 1.5
    curvature = DeepinvPrior(getattr(deepinv.optim, name)()).curvature(image)
    assert bool(torch.isfinite(curvature).all())
    assert float(curvature.min()) >= 0
    assert float(curvature[:3].mean()) > 1


@pytest.mark.parametrize("name", ["SmoothedTVPrior", "TVPrior"])
def test_a_restoration_takes_it(name, observation):
    prior = DeepinvPrior(getattr(deepinv.optim, name)())
    result = MyopicDeconvolution(MASK, GRID, 3, prior=prior, max_iterations=100).restore(observation.frames)
    ours, mean = (
        relative_error(image, observation.object, 0.5) for image in (result.object, observation.frames.mean(0))
    )
    assert ours < mean
    assert name in result.prior


def test_a_prior_without_a_value_is_refused():
    with pytest.raises(ValueError, match="has no value"):
        DeepinvPrior(deepinv.optim.PnP(deepinv.models.MedianFilter()))
    with pytest.raises(ValueError, match="weight is -1"):
        DeepinvPrior(deepinv.optim.Tikhonov(), weight=-1.0)
