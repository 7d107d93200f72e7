"""The exposure model against the PSF layer, direct sums over waves and brute-force convolution."""

import copy
import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.memory import AtATime
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import SquarePixel
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import ZernikePhase
from torchmask.restoration.aberrations import AberrationBasis, plain_basis, turbulent_basis
from torchmask.restoration.adjoint import curvature, data_fidelity
from torchmask.restoration.forward import ExposureModel, Window, fast_size

GRID = Grid((12, 15), 2.75e-7, 550e-9)
FINE = Grid((12, 15), 2.3e-7, 550e-9)  # samples the bluest wavelength of the band too
WAVELENGTHS, WEIGHTS = (500e-9, 550e-9, 610e-9), (1.0, 2.0, 3.0)
BAND = Band.of(WAVELENGTHS, WEIGHTS)
MASK = SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.15]], 0.36, 1.0)


@pytest.mark.parametrize("aperture", [MASK, FullAperture(0.9), FullAperture(0.9, 0.3)])
def test_psf_is_that_of_the_layer_without_the_deconvolution_of_its_cells(aperture, random_exposures):
    model, _, z, _, _ = random_exposures(ExposureModel(aperture, GRID, 4))
    field = model.window.field
    phase = ZernikePhase(aperture, field, 4)(z.unflatten(1, (-1, 4)))
    cells = [torch.sinc(torch.fft.fftfreq(side, dtype=torch.float64)) ** 2 for side in field.shape]
    expected = psf_from_samples(aperture.samples(field), phase) * cells[0][:, None] * cells[1]
    expected = expected / expected.sum((1, 2), keepdim=True)
    assert (model.psf(z).sum((1, 2)) - 1).abs().max() < 1e-13
    assert (model.psf(z) - expected).abs().max() < 1e-14


def test_forward_is_a_convolution_seen_through_the_window(random_exposures):
    """Brute force over every pixel of the object, on a periodic field."""
    model, image, z, _, _ = random_exposures(ExposureModel(MASK, GRID, 4))
    psf, expected = model.psf(z[:1])[0], torch.zeros(GRID.shape, dtype=torch.float64)
    for row in range(GRID.shape[0]):
        for column in range(GRID.shape[1]):
            expected[row, column] = (psf.roll((-row, -column), (0, 1)).flip(0, 1).roll((1, 1), (0, 1)) * image).sum()
    assert (model(image, z[:1])[0] - expected).abs().max() < 1e-13


def slopes_of(model, dtype):
    """The gradients of a model's frames in the object and the parameters of the phase."""
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(model.window.field.shape, dtype=dtype, generator=generator).requires_grad_()
    z = torch.randn(2, model.aberrations.n_parameters, dtype=dtype, generator=generator).requires_grad_()
    return torch.autograd.grad((model(image, z) ** 2).sum(), (image, z))


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_autocast_rounds_no_frames_and_gradients(shape):
    mask = SparseAperture(MASK.centers.float(), 0.36, 1.0, shape)
    basis = turbulent_basis(mask, 3, 0, 0.2, 20.0).float()
    model = ExposureModel(mask, FINE, basis)
    z = torch.randn(2, basis.n_parameters, generator=torch.Generator().manual_seed(1))
    image, precision = torch.rand(model.window.field.shape), torch.ones(1, 1, 1)
    frames = torch.rand(2, *FINE.shape)

    def results(model):
        fit = data_fidelity(model, image, z, frames, precision, want_samples=True)
        noise = torch.Generator().manual_seed(2)
        return [
            *slopes_of(model, torch.float32),
            *fit,
            curvature(model, image, z, precision, noise)[0],
            basis.coefficients(z),
        ]

    expected = results(model)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        again = [results(model), results(ExposureModel(mask, FINE, basis))]
    for found in again:
        for one, other in zip(found, expected, strict=True):
            assert one.dtype == other.dtype
            assert float((one - other).norm()) < 1e-4 * float(other.norm())  # of bfloat16: 4e-3


def test_one_made_in_inference_mode_trains_later():
    band, pixel = Band.of(WAVELENGTHS, WEIGHTS), SquarePixel()
    expected = slopes_of(ExposureModel(MASK, FINE, 3, band, pixel=pixel), torch.float64)
    with torch.inference_mode():
        models = [ExposureModel(MASK, FINE, 3, band, pixel=pixel)]
        models.append(ExposureModel(MASK, FINE, plain_basis(MASK, 3), band, pixel=pixel))
        moved = MASK.replace(MASK.centers + 0.1)
        models.append(ExposureModel(moved, FINE, 3, band, pixel=pixel))
        moved.centers.copy_(MASK.centers)
        models[-1](torch.ones(models[-1].window.field.shape).double(), torch.zeros(2, 9).double())  # samples anew
    for model in models:
        for one, other in zip(slopes_of(model, torch.float64), expected, strict=True):
            assert torch.equal(one, other)
        basis = model.aberrations
        z = torch.ones(2, 9, dtype=torch.float64, requires_grad=True)
        assert torch.autograd.grad(basis.coefficients(z).sum(), z)[0].shape == z.shape


def test_the_window_is_the_corner_of_a_wider_field():
    window = Window.around(GRID, 0.25)
    rows, columns = window.field.shape
    assert rows >= 1.25 * GRID.shape[0]
    assert columns >= 1.25 * GRID.shape[1]
    assert (window.field.pixel_scale, window.field.wavelength) == (GRID.pixel_scale, GRID.wavelength)
    image = torch.rand(GRID.shape)
    wide = window.embed(image)
    assert wide.shape == window.field.shape
    assert torch.equal(window.crop(wide), image)
    assert float(wide[GRID.shape[0] :].abs().sum() + wide[:, GRID.shape[1] :].abs().sum()) == 0


@pytest.mark.parametrize("shape", ["disc", "hexagon"])
def test_broad_band_psf_is_the_sum_over_wavelengths_and_pupil_samples(shape):
    """Every wavelength by an explicit sum of waves, without an FFT: metres in the pupil, radians on the sky."""
    aperture = SparseAperture(MASK.centers, 0.36, 1.0, shape)
    model = ExposureModel(aperture, FINE, 4, BAND)
    size = model.window.field.shape
    path = torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 550e-9 / 7  # [m] rms
    rows, columns = (torch.arange(n, dtype=torch.float64) * FINE.pixel_scale for n in size)
    expected = torch.zeros(size, dtype=torch.float64)
    for wavelength, weight in zip(WAVELENGTHS, WEIGHTS, strict=True):
        field = Grid(size, FINE.pixel_scale, wavelength)
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
    found = model.psf((path * 2 * math.pi / FINE.wavelength).flatten()[None])[0]
    assert abs(float(found.sum()) - 1) < 1e-13
    assert (found - expected).abs().max() < 1e-13


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-13), (torch.float32, 2e-5)])
def test_equal_wavelengths_are_one(dtype, rounding, random_exposures):
    single = ExposureModel(MASK, FINE, 4, dtype=dtype)
    twice = ExposureModel(MASK, FINE, 4, Band.of((550e-9, 550e-9), (0.3, 0.9)), dtype=dtype)
    _, image, z, frames, precision = random_exposures(single)
    assert (single.psf(z) - twice.psf(z)).abs().max() < rounding
    misfits = [data_fidelity(model, image, z, frames, precision) for model in (single, twice)]
    for name in ("value", "object_gradient", "aberration_gradient"):
        one, other = (getattr(misfit, name) for misfit in misfits)
        assert (one - other).abs().max() < rounding * one.abs().max()
    one, other = (
        curvature(model, image, z, precision, torch.Generator().manual_seed(3))[0] for model in (single, twice)
    )
    assert (one - other).abs().max() < 10 * rounding * one.max()


def test_a_star_is_drawn_out_along_the_radius_and_nowhere_else():
    """The image of a wavelength is that of another, magnified: a tilt in metres moves all by the same angle."""
    model = ExposureModel(MASK, FINE, 3, BAND)
    samples = model.pupil.samples()
    tilt = 2 * math.pi * samples.positions[:, 0]  # by one pixel along x, at every wavelength
    modes = torch.cat([samples.basis, samples.chromaticity[:, None]], dim=1)
    solution = torch.linalg.lstsq(modes, tilt[:, None], driver="gelsd").solution
    assert (modes @ solution - tilt[:, None]).abs().max() < 1e-12
    moved = model.psf(solution[:-1, 0][None])[0]
    assert (moved - model.psf(torch.zeros(1, 9, dtype=torch.float64))[0].roll(1, 1)).abs().max() < 1e-14


def test_an_object_and_aberrations_of_another_model_are_refused():
    model = ExposureModel(MASK, GRID, 4)
    image, z = torch.zeros(model.window.field.shape, dtype=torch.float64), torch.zeros(2, 12, dtype=torch.float64)
    assert model(image, z).shape == (2, *GRID.shape)
    with pytest.raises(ValueError, match=r"the object has shape .*into which model\.window\.embed puts an object"):
        model(model.window.crop(image), z)
    for other in (z[:, :-1], z[0], z[None]):
        with pytest.raises(ValueError, match=r"z has shape .*: \(T, 12\) is needed"):
            model(image, other)


def test_chunks_cover_the_frames_once_and_stay_small(monkeypatch):
    model = ExposureModel(MASK, GRID, 4, Band.of((550e-9, 560e-9)))
    chunk = 2 * 16 * 2 * math.prod(model.window.field.shape)
    monkeypatch.setattr("torchmask.restoration.forward._CHUNK", AtATime(chunk, chunk))
    assert [(part.start, part.stop) for part in model.chunks(5)] == [(0, 2), (2, 4), (4, 5)]


def test_chunks_are_large_where_launches_cost_more_than_a_cache_saves():
    model = ExposureModel(copy.deepcopy(MASK), GRID, 4).to("meta")
    most = 2**28 // (16 * math.prod(model.window.field.shape))
    assert [(part.start, part.stop) for part in model.chunks(most + 3)] == [(0, most), (most, most + 3)]


def test_a_single_precision_twin_shares_the_basis_and_leaves_the_model_alone(random_exposures):
    model, image, z, _, _ = random_exposures(ExposureModel(MASK, GRID, 4))
    twin = model.single()
    assert (twin.dtype, model.dtype) == (torch.float32, torch.float64)
    assert twin.aberrations is model.aberrations
    torch.testing.assert_close(twin(image, z).double(), model(image, z), rtol=1e-5, atol=1e-5)


def test_parameters_reach_the_pupil_through_the_basis(random_exposures):
    """A model on a basis is the plain model of that basis's coefficients."""
    generator = torch.Generator().manual_seed(1)
    basis = AberrationBasis(torch.randn(12, 7, dtype=torch.float64, generator=generator), 4)
    model, image, z, _, _ = random_exposures(ExposureModel(MASK, GRID, basis))
    plain = ExposureModel(MASK, GRID, 4)
    torch.testing.assert_close(model(image, z), plain(image, basis.coefficients(z).flatten(1)), rtol=0, atol=1e-13)


@pytest.mark.parametrize("n", [1, 2, 3, 31, 161, 1000])
def test_fast_size(n):
    size = fast_size(n)
    assert size >= n
    assert size % 2 == 0
    for prime in (2, 3, 5):
        while size % prime == 0:
            size //= prime
    assert size == 1
