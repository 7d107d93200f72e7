"""The multi-frame Wiener estimate against its closed form, its optimality and its predicted error."""

import pytest
import torch

from torchmask.design.criterion import wiener_mse
from torchmask.grid import Grid
from torchmask.restoration.wiener import multiframe_wiener
from torchmask.spectra import NoisePSD, PowerLawPSD

SHAPE = (12, 10)


def draw(n_frames, dtype=torch.float64, seed=0, batch=()):
    """Frames, and the OTFs of random positive PSFs of unit sum."""
    generator = torch.Generator().manual_seed(seed)
    psfs = torch.rand(*batch, n_frames, *SHAPE, dtype=dtype, generator=generator) ** 8
    otfs = torch.fft.fft2(psfs / psfs.sum((-2, -1), keepdim=True))
    return torch.randn(*batch, n_frames, *SHAPE, dtype=dtype, generator=generator), otfs


@pytest.mark.parametrize(("dtype", "rounding"), [(torch.float64, 1e-12), (torch.float32, 1e-4)])
def test_minimises_the_quadratic_it_stands_for(dtype, rounding):
    """Setting the gradient of sum |Y - H O|^2 / S_n + |O|^2 / S_o to zero is the definition of the estimate."""
    frames, otfs = draw(3, dtype)
    object_psd, noise_psd = PowerLawPSD(1.5, 50.0, 0.1), NoisePSD(50.0, 0.5)
    estimate = multiframe_wiener(frames, otfs, object_psd, noise_psd).requires_grad_()
    grid = Grid(SHAPE, 1.0, 1.0)
    spectrum = torch.fft.fft2(estimate)
    misfit = (torch.fft.fft2(frames) - otfs * spectrum).abs() ** 2 / noise_psd(grid, dtype)
    prior = spectrum.abs() ** 2 / object_psd(grid, dtype)
    (gradient,) = torch.autograd.grad(misfit.sum() + prior.sum(), estimate)
    (scale,) = torch.autograd.grad(
        (torch.fft.fft2(estimate * 1.01).abs() ** 2 / noise_psd(grid, dtype)).sum(), estimate
    )
    assert estimate.dtype == dtype
    assert gradient.abs().max() < rounding * scale.abs().max()


def test_without_noise_recovers_the_object_exactly():
    _, otfs = draw(4)
    scene = torch.rand(SHAPE, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    frames = torch.fft.ifft2(otfs * torch.fft.fft2(scene)).real
    estimate = multiframe_wiener(frames, otfs, torch.tensor(1.0), torch.tensor(0.0))
    assert (estimate - scene).abs().max() < 1e-10  # transfer functions are at least a few percent together


def test_its_error_is_the_predicted_one():
    """Over draws of object and noise the mean squared error is wiener_mse, within 4 standard errors."""
    n_frames, n_draws = 3, 3000
    _, otfs = draw(n_frames)
    signal, noise = torch.tensor(40.0, dtype=torch.float64), torch.tensor(9.0, dtype=torch.float64)
    generator = torch.Generator().manual_seed(2)
    n_pixels = SHAPE[0] * SHAPE[1]
    # White noise of variance v has an unnormalised DFT of power n_pixels v.
    scene = torch.randn(n_draws, *SHAPE, dtype=torch.float64, generator=generator) * (signal / n_pixels) ** 0.5
    frames = torch.fft.ifft2(otfs * torch.fft.fft2(scene)[:, None]).real
    frames = frames + torch.randn(frames.shape, dtype=torch.float64, generator=generator) * (noise / n_pixels) ** 0.5
    error = torch.fft.fft2(multiframe_wiener(frames, otfs, signal, noise) - scene).abs() ** 2
    per_draw = error.mean((-2, -1))
    expected = wiener_mse(otfs, signal, noise)
    assert abs(per_draw.mean() - expected) < 4 * per_draw.std() / n_draws**0.5


def test_batches_and_psds_that_vanish():
    frames, otfs = draw(2, batch=(3,))
    psd = torch.ones(SHAPE, dtype=torch.float64)
    psd[0, 0] = 0
    together = multiframe_wiener(frames, otfs, psd, torch.tensor(0.1))
    assert together.shape == (3, *SHAPE)
    assert together.mean((-2, -1)).abs().max() < 1e-15
    one = multiframe_wiener(frames[1], otfs[1], psd, torch.tensor(0.1))
    assert torch.allclose(together[1], one, atol=1e-14)


def test_gradient():
    frames, otfs = draw(2)
    frames, otfs = frames[:, :4, :5].clone().requires_grad_(), otfs[:, :4, :5].clone().requires_grad_()
    psd = torch.ones(4, 5, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda f, h: multiframe_wiener(f, h, psd, 0.1 * psd), (frames, otfs))


def test_power_spectra_can_be_learned():
    frames, otfs = draw(2)
    frames, otfs = frames[:, :4, :5], otfs[:, :4, :5]
    signal = (0.5 + torch.rand(4, 5, dtype=torch.float64)).requires_grad_()
    noise = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s, n: multiframe_wiener(frames, otfs, s, n), (signal, noise))
    learned = signal.detach().float().requires_grad_()
    multiframe_wiener(frames.float(), otfs.to(torch.complex64), learned, noise).square().sum().backward()
    assert float(learned.grad.abs().min()) > 0


def test_no_stacks_give_no_images():
    frames, otfs = draw(2)
    frames = frames.expand(3, 0, *frames.shape).requires_grad_()
    image = multiframe_wiener(frames, otfs, torch.tensor(1.0), torch.tensor(0.1))
    assert image.shape == (3, 0, *SHAPE)
    image.sum().backward()
    assert frames.grad.shape == frames.shape


def test_the_image_has_the_dtype_of_the_frames():
    frames, otfs = draw(2)
    psd = torch.tensor(1.0)
    exact = multiframe_wiener(frames, otfs, psd, 0.1 * psd)
    found = multiframe_wiener(frames.float(), otfs, psd, 0.1 * psd)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found.double(), exact, rtol=0, atol=1e-5 * float(exact.abs().max()))


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        (lambda f, h: (f[:1], h), ValueError, "same"),
        (lambda f, h: (f[0], h[0]), ValueError, "frame, rows"),
        (lambda f, h: (f, h.real), TypeError, "complex"),
        (lambda f, h: (f.half(), h), TypeError, "float32 or float64"),
        (lambda f, h: (f.expand(2, *f.shape), h.expand(3, *h.shape)), ValueError, "must broadcast"),
    ],
)
def test_refuses(change, error, words):
    frames, otfs = change(*draw(2))
    with pytest.raises(error, match=words):
        multiframe_wiener(frames, otfs, torch.tensor(1.0), torch.tensor(0.1))
