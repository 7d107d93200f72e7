import math

import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import OTF
from torchmask.optics.psf import PSF, focal_intensity, fold, psf_from_samples
from torchmask.optics.pupil import PupilSamples
from torchmask.optics.zernike import ZernikePhase

WAVELENGTH = 550e-9

MASK = SparseAperture(
    [[0.05, 0.02], [0.31, 0.07], [-0.3, 0.11], [0.12, 0.33], [-0.1, -0.31], [0.27, -0.2], [-0.18, 0.34]], 0.12, 1.0
)


def test_psf_is_a_distribution_whose_transform_is_hermitian():
    psf = PSF(MASK, Grid.nyquist(1.0, WAVELENGTH, 32), 2)()
    assert float(psf.min()) >= 0
    assert float(psf.sum()) == pytest.approx(1, rel=1e-13)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_tilt_moves_the_image_towards_positive_pixels(axis):
    """phi = 2 pi s x pixel_scale / wavelength moves the image by +s, x on columns and y on rows."""
    grid = Grid((32, 48), WAVELENGTH / 2, WAVELENGTH)
    aperture = SparseAperture([[0.1, -0.15], [-0.25, 0.2]], 0.4, 1.0)
    model = PSF(aperture, grid)
    samples = model.samples()
    position = aperture.centers[:, None] + samples.offsets
    phase = 2 * math.pi * 3 * position[..., axis] / grid.period
    expected = torch.roll(model(), 3, dims=1 - axis)
    # Exact but for the cell's sinc, which is divided out as if the light had not moved: 3 pixels of 32.
    assert (model(phase) - expected).abs().max() < 0.05 * expected.max()
    peak = model(phase).argmax()
    assert peak == (3 * 48 if axis == 1 else 3)


def test_fold_keeps_light_and_samples_the_spectrum():
    generator = torch.Generator().manual_seed(0)
    wide = torch.rand(2, 24, 32, generator=generator, dtype=torch.float64)
    folded = fold(wide, (8, 16))
    assert torch.allclose(torch.fft.fft2(folded), torch.fft.fft2(wide)[:, ::3, ::2], atol=1e-12)
    with pytest.raises(ValueError, match="do not fold"):
        fold(wide, (10, 16))


def test_folding_a_wide_psf_keeps_the_light_that_cropping_loses():
    aperture, grid = MASK.replace(subaperture_diameter=0.1), Grid.nyquist(1.0, WAVELENGTH, 32)
    wide = psf_from_samples(aperture.samples(grid, 4))
    inside = wide[torch.fft.fftfreq(128).mul(128).abs() < 16][:, torch.fft.fftfreq(128).mul(128).abs() < 16]
    assert float(inside.sum()) < 0.9
    assert float(fold(wide, grid.shape).sum()) == pytest.approx(1, rel=1e-13)


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_psf_is_differentiable_in_positions_and_phase(shape):
    grid = Grid.nyquist(1.0, WAVELENGTH, 12)
    centers = torch.tensor([[0.0, 0.0], [0.27, -0.11]], dtype=torch.float64, requires_grad=True)
    n_samples = SparseAperture(centers, 0.4, 1.0, shape).samples(grid).weights.shape[-1]
    phase = torch.linspace(-1, 1, 2 * n_samples, dtype=torch.float64).view(2, n_samples).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda c, p: PSF(SparseAperture(c, 0.4, 1.0, shape, 0.1), grid)(p), (centers, phase)
    )


def test_float32_agrees_with_float64():
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    single = MASK.replace(centers=MASK.centers.float())
    psf = PSF(single, grid, 2)()
    assert psf.dtype == torch.float32
    exact = PSF(MASK.replace(centers=single.centers.double()), grid, 2)()
    # A weight of a sample feels the rounding of its offset, eps x 0.5 m / step of 0.016 m; the image sums amplitudes.
    assert (psf - exact).abs().max() < 100 * torch.finfo(torch.float32).eps * exact.max()


def test_an_ordinary_optimiser_finds_aberrations_through_the_psf():
    grid = Grid.nyquist(1.0, WAVELENGTH, 32)
    model = PSF(SparseAperture([[0.0, 0.3], [0.25, -0.2], [-0.3, -0.1]], 0.3, 1.0), grid)
    samples = model.samples()
    target = model(torch.tensor([0.0, 0.8, -0.6], dtype=torch.float64)[:, None].expand(-1, samples.weights.shape[-1]))
    pistons = nn.Parameter(torch.zeros(3, dtype=torch.float64))
    optimiser = torch.optim.Adam([pistons], lr=0.05)
    for _ in range(200):
        optimiser.zero_grad()
        loss = ((model(pistons[:, None].expand(-1, samples.weights.shape[-1])) - target) ** 2).sum()
        loss.backward()
        optimiser.step()
    found = (pistons - pistons[0]).detach()
    assert found.tolist() == pytest.approx([0.0, 0.8, -0.6], abs=1e-3)


def test_population_of_masks_and_frames_broadcast():
    grid = Grid.nyquist(1.0, WAVELENGTH, 32)
    centers = torch.stack([MASK.centers[:3], MASK.centers[3:6]])
    model = PSF(SparseAperture(centers, 0.2, 1.0), grid)
    assert model().shape == (2, 32, 32)
    n_samples = model.samples().weights.shape[-1]
    phase = torch.randn(2, 5, 3, n_samples, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    images = model(phase)
    assert images.shape == (2, 5, 32, 32)
    alone = PSF(SparseAperture(centers[1], 0.2, 1.0), grid)(phase[1, 3])
    assert torch.allclose(images[1, 3], alone, rtol=0, atol=1e-15)


def test_a_phase_on_other_samples_and_half_precision_are_refused():
    mask = SparseAperture([[0.0, 0.3], [0.2, -0.2]], 0.2, 1.0)
    grid = Grid.nyquist(1.0, 550e-9, 32)
    finer = ZernikePhase(mask, grid, 3, oversampling=2)(torch.zeros(4, 2, 3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"samples\) = \(2, \d+\), on samples of the same aperture, grid and over"):
        PSF(mask, grid)(finer)
    with pytest.raises(TypeError, match=r"torch\.float16: float32 or float64 is needed"):
        PSF(mask, grid).half()()


def test_a_whole_oversampling_may_be_a_float():
    grid = Grid.nyquist(1.0, WAVELENGTH, 32)
    assert torch.equal(PSF(MASK, grid, 2.0)(), PSF(MASK, grid, 2)())
    with pytest.raises(ValueError, match=r"oversampling is 2\.5: it must be a whole number of at least 1"):
        PSF(MASK, grid, 2.5)


def test_no_frames_and_no_masks_make_no_images():
    grid = Grid.nyquist(1.0, WAVELENGTH, 40)
    coefficients = torch.zeros(0, 7, 3, dtype=torch.float64, requires_grad=True)
    none = MASK.replace(centers=torch.zeros(0, 7, 2, dtype=torch.float64, requires_grad=True))
    for layer in (PSF(MASK, grid), OTF(MASK, grid)):
        images = layer(ZernikePhase(MASK, grid, 3)(coefficients))
        assert images.shape == (0, 40, 40)
        images.abs().sum().backward()
        assert coefficients.grad is not None
        assert coefficients.grad.shape == (0, 7, 3)
        coefficients.grad = None
    assert OTF(none, grid)().is_complex()
    images = PSF(none, grid)(ZernikePhase(none, grid, 3)(torch.zeros(0, 4, 7, 3, dtype=torch.float64)))
    assert images.shape == (0, 4, 40, 40)
    (PSF(none, grid)().sum() + images.sum()).backward()
    assert none.centers.grad is not None


@pytest.mark.parametrize(
    ("convert", "message"),
    [
        (lambda phase: phase.numpy(), r"phase is of type ndarray: a tensor is needed, give torch\.as_tensor\(phase\)"),
        (lambda phase: phase.long(), r"phase is torch\.int64: float32 or float64 is needed, give phase\.double\(\)"),
        (lambda phase: phase + 0j, r"phase is torch\.complex128: float32 or float64 is needed, give phase\.real"),
        (lambda phase: phase.bfloat16(), r"phase is torch\.bfloat16: float32 or float64 is needed"),
    ],
)
def test_a_phase_is_a_tensor_of_real_numbers(convert, message):
    model = PSF(MASK, Grid.nyquist(1.0, WAVELENGTH, 40))
    with pytest.raises(TypeError, match=message):
        model(convert(torch.zeros_like(model.samples().weights)))


def test_a_phase_has_the_axes_of_the_population():
    grid = Grid.nyquist(1.0, WAVELENGTH, 40)
    model = PSF(MASK.replace(centers=torch.stack([MASK.centers, -MASK.centers])), grid)
    phase = torch.zeros_like(model.samples().weights[0])
    assert model(phase).shape == (2, 40, 40)
    assert model(phase.expand(3, 1, 1, -1, -1)).shape == (3, 2, 1, 40, 40)
    for axes in ((3,), (3, 4)):
        with pytest.raises(ValueError, match=r"phase has shape \(3,.* and the population of masks \(2,\): the axes"):
            model(phase.expand(*axes, -1, -1))
    with pytest.raises(ValueError, match=r"coefficients has shape \(3, 7, 2\) and the population of masks \(2,\)"):
        ZernikePhase(model.aperture, grid, 2)(torch.zeros(3, 7, 2, dtype=torch.float64))


def test_the_image_of_a_smooth_pupil_is_its_transform_whatever_cells_it_was_averaged_over():
    """A Gaussian of 1.5 cells, whose amplitude is 2 pi 1.5^2 exp(-2 pi^2 1.5^2 nu^2) at nu cycles per cell.

    Up to a quarter of a cycle, where an average over a cell weakens light by a fifth, and aliases are below 1e-9 of it.
    """
    width, rows, columns = 1.5, 32, 40
    x = torch.arange(-12, 13, dtype=torch.float64)
    bounds = torch.erf(torch.stack([x - 0.5, x + 0.5]) / (width * math.sqrt(2)))
    mean = width * math.sqrt(math.pi / 2) * (bounds[1] - bounds[0])
    place = torch.cartesian_prod(x, x)
    weights = torch.outer(mean, mean).flatten()[None]  # of cells in the order of `place`, (y, x)
    index = ((place[:, 0] % rows) * columns + place[:, 1] % columns).long()[None]
    samples = PupilSamples(place.flip(1)[None], weights, index, (rows, columns), (1.0, 1.0))
    nu_y, nu_x = torch.fft.fftfreq(rows).double()[:, None], torch.fft.fftfreq(columns).double()
    amplitude = 2 * math.pi * width**2 * torch.exp(-2 * (math.pi * width) ** 2 * (nu_y**2 + nu_x**2))
    near = (nu_y.abs() <= 0.25) & (nu_x.abs() <= 0.25)
    found = focal_intensity(samples) * rows * columns  # of a transform that keeps the sum of squares
    torch.testing.assert_close(found[near], amplitude[near] ** 2, rtol=1e-6, atol=0)
