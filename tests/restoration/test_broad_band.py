"""A broad band and aberrations common to all frames: against direct sums, against the narrow band, end to end."""

import math

import pytest
import torch
from torchmask.restoration.model import ExposureModel, weighted_misfit
from torchmask.restoration.problem import JointProblem, State

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.zernike import ZernikePhase
from torchmask.restoration.myopic import MyopicDeconvolution

GRID = Grid((12, 15), 2.3e-7, 550e-9)
BAND = {"wavelengths": (500e-9, 550e-9, 610e-9), "weights": (1.0, 2.0, 3.0)}


def mask(dtype=torch.float64, shape="disc"):
    return SparseAperture(torch.tensor([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]], dtype=dtype), 0.36, 1.0, shape)


def setup(dtype=torch.float64, n_frames=3, n_modes=4, **kwargs):
    model = ExposureModel(mask(), GRID, n_modes, dtype=dtype, **kwargs)
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(model.field.shape, dtype=torch.float64, generator=generator)
    z = 0.5 * torch.randn(n_frames, model.n_parameters, dtype=torch.float64, generator=generator)
    frames = torch.rand(n_frames, *GRID.shape, dtype=torch.float64, generator=generator).to(dtype)
    precision = torch.rand(frames.shape, dtype=torch.float64, generator=generator).to(dtype)
    return model, image, z, frames, precision


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_broad_band_psf_is_the_sum_over_wavelengths_and_pupil_samples(shape):
    """Every wavelength by an explicit sum of waves, without an FFT: metres in the pupil, radians on the sky."""
    aperture = mask(shape=shape)
    model = ExposureModel(aperture, GRID, 4, **BAND)
    path = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 550e-9 / 7  # [m] rms
    rows, columns = (torch.arange(n, dtype=torch.float64) * GRID.pixel_scale for n in model.field.shape)
    expected = torch.zeros(model.field.shape, dtype=torch.float64)
    for wavelength, weight in zip(*BAND.values(), strict=True):
        field = Grid(model.field.shape, GRID.pixel_scale, wavelength)
        samples = aperture.samples(field)
        position = (samples.offsets + aperture.centers[:, None]).flatten(0, 1)
        phase = ZernikePhase(aperture, field, 4)(path * 2 * math.pi / wavelength).flatten()
        wave = (
            2
            * math.pi
            / wavelength
            * (position[:, 1, None, None] * rows[:, None] + position[:, 0, None, None] * columns)
        )
        amplitude = (samples.weights.flatten()[:, None, None] * torch.exp(1j * (phase[:, None, None] - wave))).sum(0)
        psf = amplitude.abs() ** 2
        expected += weight / 6 * psf / psf.sum()
    found = model.psf((path * 2 * math.pi / GRID.wavelength).flatten()[None])[0]
    assert abs(float(found.sum()) - 1) < 1e-13
    assert (found - expected).abs().max() < 1e-13


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-13), (torch.float32, 2e-5)])
def test_equal_wavelengths_are_one(dtype, rounding):
    model, image, z, frames, precision = setup(dtype)
    twice = setup(dtype, wavelengths=(550e-9, 550e-9), weights=(0.3, 0.9))[0]
    assert (model.psf(z) - twice.psf(z)).abs().max() < rounding
    for one, other in zip(
        model.misfit(image, z, frames, precision), twice.misfit(image, z, frames, precision), strict=True
    ):
        assert (one - other).abs().max() < rounding * one.abs().max()
    by_curvature = [m.curvature(image, z, precision, torch.Generator().manual_seed(3)) for m in (model, twice)]
    assert (by_curvature[0][0] - by_curvature[1][0]).abs().max() < 10 * rounding * by_curvature[0][0].max()


def test_a_star_is_drawn_out_along_the_radius_and_nowhere_else():
    """The image of a wavelength is that of another, magnified: a tilt in metres moves all by the same angle."""
    model = ExposureModel(mask(), GRID, 3, **BAND)
    basis, positions = model.basis, model.positions
    tilt = 2 * math.pi * positions[:, 0]  # by one pixel along x, at every wavelength
    modes = torch.cat([basis, model.chromaticity[:, None]], dim=1)
    solution = torch.linalg.lstsq(modes, tilt[:, None], driver="gelsd").solution
    assert (modes @ solution - tilt[:, None]).abs().max() < 1e-12
    moved = model.psf(solution[:-1, 0][None])[0]
    assert (moved - model.psf(torch.zeros(1, 9, dtype=torch.float64))[0].roll(1, 1)).abs().max() < 1e-14


def test_gradcheck_in_a_broad_band():
    model, image, z, frames, precision = setup(n_frames=2, **BAND)
    image.requires_grad_()
    z.requires_grad_()
    assert torch.autograd.gradcheck(lambda o, a: weighted_misfit(model, o, a, frames, precision), (image, z))


@pytest.mark.parametrize(
    ("band", "message"),
    [
        ({"weights": (1.0,)}, "weights are given without wavelengths"),
        ({"wavelengths": ()}, "0 wavelengths have 0 weights"),
        ({"wavelengths": (5e-7, 6e-7), "weights": (1.0,)}, "2 wavelengths have 1 weights"),
        ({"wavelengths": (5e-7, math.nan)}, "wavelengths are"),
        ({"wavelengths": (5e-7, 6e-7), "weights": (1.0, 0.0)}, "weights are"),
        ({"wavelengths": (3e-7, 5.5e-7)}, "undersamples an aperture"),
    ],
)
def test_bands_that_make_no_sense_are_refused(band, message):
    with pytest.raises(ValueError, match=message):
        MyopicDeconvolution(mask(), GRID, n_modes=3, **band)


def test_static_modes_are_the_same_coefficients_in_every_frame():
    """More modes in common than of each frame's own; every frame sees the sum."""
    method = MyopicDeconvolution(mask(), GRID, n_modes=3, static_modes=6)
    model = method.model
    assert method.n_modes == 6
    assert model.n_static == 3 * 6 - 1  # without the mean piston
    generator = torch.Generator().manual_seed(2)
    own = torch.randn(4, model.n_parameters - model.n_static, dtype=torch.float64, generator=generator)
    common = torch.randn(model.n_static, dtype=torch.float64, generator=generator)
    coefficients = torch.cat([own, common.expand(4, -1)], dim=1) @ model.mixing.T
    plain = ExposureModel(mask(), GRID, 6)
    both = model.psf(torch.cat([own, common.expand(4, -1)], dim=1))
    assert (both - plain.psf(coefficients)).abs().max() < 1e-13
    # Beyond the modes of each frame all is common; up to there they differ.
    spread = coefficients.unflatten(1, (3, 6)).std(0)
    assert spread[:, 3:].max() < 1e-12
    assert spread[:, :3].min() > 1e-3


def test_gradient_of_common_aberrations_is_that_of_one_variable():
    """Central differences in one common aberration of all frames against the sum over frames; the prior counts once."""
    model, image, _, frames, precision = setup(n_frames=3, mixing=torch.eye(12, dtype=torch.float64), n_static=4)
    problem = JointProblem(model, frames, precision, torch.zeros(3, 12, dtype=torch.float64), tv_weight=1.0)
    generator = torch.Generator().manual_seed(4)
    z = 0.3 * torch.randn(3, 12, dtype=torch.float64, generator=generator)
    z[:, 8:] = z[0, 8:]
    ones = torch.ones(3, dtype=torch.float64)
    state = State(image, z, ones, 0.7, ones)
    gradient = problem.cost(state, image, z)[2]
    assert torch.equal(gradient[:, 8:], gradient[:1, 8:].expand(3, -1))
    for k in range(8, 12):
        step = torch.zeros_like(z)
        step[:, k] = 1e-5
        high, low = (float(problem.cost(state, image, z + s)[0]) for s in (step, -step))
        assert float(gradient[:, k].sum()) == pytest.approx((high - low) / 2e-5, rel=1e-6)
    without = problem.cost(state, image, z - z)[0] - model.misfit(image, z - z, frames, precision).value.sum()
    weight = problem.cost(state, image, z)[0] - model.misfit(image, z, frames, precision).value.sum() - without
    assert float(weight) == pytest.approx(0.5 * float(0.7 * (z[:, :8] ** 2).sum() + (z[0, 8:] ** 2).sum()), rel=1e-9)


@pytest.fixture(scope="module")
def observed():
    """Two stars in a band of 20 %, through strong aberrations that stay and weak ones that change."""
    grid = Grid.nyquist(1.0, 550e-9, 40, oversampling=1.2)
    band = {"wavelengths": (500e-9, 550e-9, 600e-9), "weights": (1.0, 1.0, 1.0)}
    aperture = SparseAperture([[0.0, 0.33], [0.3, -0.18], [-0.3, -0.14]], 0.34, 1.0)
    truth = ExposureModel(aperture, grid, 6, **band)
    generator = torch.Generator().manual_seed(5)
    common = 0.4 * torch.randn(1, 3, 6, dtype=torch.float64, generator=generator)
    own = 0.2 * torch.randn(8, 3, 3, dtype=torch.float64, generator=generator)
    coefficients = common + torch.nn.functional.pad(own, (0, 3))
    scene = torch.zeros(truth.field.shape, dtype=torch.float64)
    scene[20, 18], scene[16, 23] = 9e5, 1e5
    frames = torch.poisson(truth(scene, coefficients.flatten(1)), generator=generator)
    frames = frames + 2 * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    return grid, band, aperture, coefficients, frames


def test_restoration_with_the_band_explains_what_one_wavelength_cannot(observed):
    grid, band, aperture, _, frames = observed
    options = {"n_modes": 3, "static_modes": 6, "r0": 0.6, "readout_noise": 2.0, "max_iterations": 300}
    broad = MyopicDeconvolution(aperture, grid, **band, **options).restore(frames)
    narrow = MyopicDeconvolution(aperture, grid, **options).restore(frames)
    assert broad.chi_square.mean() < 0.5 * narrow.chi_square.mean()
    assert broad.coefficients.shape == (8, 3, 6)
    assert broad.coefficients.std(0)[:, 3:].max() < 1e-6  # they have stayed common
    secondary = broad.object.clone()
    secondary[18:23, 16:21] = 0  # the primary and its neighbours
    row, column = divmod(int(secondary.argmax()), 40)
    assert abs(row - 16) <= 1
    assert abs(column - 23) <= 1


def test_warm_start_goes_on_with_what_is_common(observed):
    grid, band, aperture, _, frames = observed
    method = MyopicDeconvolution(aperture, grid, 3, 0.6, readout_noise=2.0, static_modes=6, max_iterations=100, **band)
    first = method.restore(frames[:6])
    again = method.restore(frames, start=first)
    assert again.cost[0] < method.restore(frames).cost[30]
    assert again.coefficients.std(0)[:, 3:].max() < 1e-6
