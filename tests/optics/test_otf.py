import math

import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import OTF, analytic_otf
from torchmask.optics.psf import PSF, fold, psf_from_samples

WAVELENGTH = 550e-9


def random_mask(seed, diameter=0.12, shape="disc", n=7):
    """Seven holes (or the first n of them) that do not overlap, turned and jittered."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64)
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    spots = [[0.02, 0.01], [0.3, 0.05], [-0.32, 0.1], [0.1, 0.3], [-0.12, -0.33], [0.25, -0.22], [-0.2, 0.31]]
    jitter = 0.05 * torch.rand(7, 2, generator=generator, dtype=torch.float64)
    centers = (torch.tensor(spots, dtype=torch.float64) + jitter)[:n] @ turn.T
    return SparseAperture(centers, diameter, 1.0, shape, orientation=0.3 * seed)


# ---- numerical against analytic


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_otf_approaches_the_autocorrelation_everywhere(shape):
    """At worst 0.6 / (samples across a hole), two-sided, and falling as the sampling grows; measured: 0.33."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    worst = []
    for oversampling in (2, 4, 8):
        errors = []
        for seed in range(4):
            aperture = random_mask(seed, shape=shape)
            numerical = OTF(aperture, grid, oversampling)()
            errors.append(float((numerical - analytic_otf(aperture, grid)).abs().max()))
            # Zero frequency is exactly one by normalisation, up to the rounding of the sums.
            assert abs(complex(numerical[0, 0]) - 1) < 1e-13
        samples_across = 0.12 * 64 * oversampling / grid.period
        worst.append(max(errors) * samples_across)
        assert worst[-1] < 0.6
    assert worst[2] < 1.1 * worst[0]  # error x sampling does not grow: the fall is at least linear


@pytest.mark.parametrize("obstruction", [0.0, 0.4])
def test_full_pupil_approaches_the_textbook_otf(obstruction):
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    aperture = FullAperture(1.0, obstruction)
    for oversampling in (1, 4):
        error = (OTF(aperture, grid, oversampling)() - analytic_otf(aperture, grid)).abs().max()
        # edges are what is misjudged: in proportion to their length over the area
        assert error < 0.6 / (32 * oversampling) / (1 - obstruction)


def test_pistons_enter_as_in_the_closed_form():
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    aperture = random_mask(5)
    pistons = torch.tensor([[0.0, 1.0, -2.0, 0.5, 3.0, -0.7, 0.1], [0.0] * 7], dtype=torch.float64)
    model = OTF(aperture, grid, 8)
    n_samples = model.samples().weights.shape[-1]
    numerical = model(pistons[..., None].expand(-1, -1, n_samples))
    analytic = analytic_otf(aperture, grid, pistons)
    assert (numerical - analytic).abs().max() < 0.6 / (0.12 * 64 * 8 / grid.period)
    # Broken on purpose: the conjugate pistons miss by far.
    assert (numerical[0] - analytic_otf(aperture, grid, -pistons)[0]).abs().max() > 0.05


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_otf_follows_a_hole_that_moves_by_a_tenth_of_a_sample(shape):
    """At 15 samples across a hole, where the error is dominated by light aliased at the border of the field."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 128)
    for seed in range(4):
        aperture = random_mask(seed, shape=shape)
        moved = aperture.centers.clone()
        moved[seed, seed % 2] += 0.1 * grid.period / 256
        other = aperture.replace(centers=moved)
        numerical = OTF(other, grid, 2)() - OTF(aperture, grid, 2)()
        analytic = analytic_otf(other, grid) - analytic_otf(aperture, grid)
        assert (numerical - analytic).abs().max() <= 1e-3
        assert analytic.abs().max() > 1e-3  # there is a change to follow


# ---- PSF conventions


def test_psf_is_a_distribution_whose_transform_is_hermitian():
    psf = PSF(random_mask(2), Grid.nyquist(1.0, WAVELENGTH, 32), 2)()
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
    aperture, grid = random_mask(1, diameter=0.1), Grid.nyquist(1.0, WAVELENGTH, 32)
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
    double = random_mask(3)
    single = SparseAperture(double.centers.float(), 0.12, 1.0)
    psf = PSF(single, grid, 2)()
    assert psf.dtype == torch.float32
    exact = PSF(SparseAperture(single.centers.double(), 0.12, 1.0), grid, 2)()
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
    centers = torch.stack([random_mask(k, n=3).centers for k in range(2)])
    model = PSF(SparseAperture(centers, 0.2, 1.0), grid)
    assert model().shape == (2, 32, 32)
    n_samples = model.samples().weights.shape[-1]
    phase = torch.randn(2, 5, 3, n_samples, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    images = model(phase)
    assert images.shape == (2, 5, 32, 32)
    alone = PSF(SparseAperture(centers[1], 0.2, 1.0), grid)(phase[1, 3])
    assert torch.allclose(images[1, 3], alone, rtol=0, atol=1e-15)
