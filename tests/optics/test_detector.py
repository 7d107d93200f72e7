"""Linear convolution against SciPy, and the statistics of noise."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import fftconvolve
from torch.autograd import gradcheck

from torchmask.optics.detector import Detector, image_formation, image_formation_adjoint


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@settings(max_examples=25, derandomize=True, deadline=None)
@given(height=st.integers(1, 9), width=st.integers(1, 9), rows=st.integers(0, 8), columns=st.integers(0, 8))
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_agrees_with_linear_convolution_by_scipy(dtype, height, width, rows, columns):
    rows, columns = 2 * height - 1 + rows, 2 * width - 1 + columns
    draw = generator(height + 10 * width + 100 * rows + columns)
    scene = torch.rand(height, width, generator=draw, dtype=dtype)
    psf = torch.rand(rows, columns, generator=draw, dtype=dtype)
    centred = torch.roll(psf, (rows // 2, columns // 2), (0, 1))
    full = fftconvolve(scene.double(), centred.double())
    expected = full[rows // 2 : rows // 2 + height, columns // 2 : columns // 2 + width]
    image = image_formation(scene, psf)
    assert image.dtype == dtype
    # sums of at most 81 products below 1, through FFTs: a few roundings of the sum
    torch.testing.assert_close(image.double(), torch.from_numpy(expected), rtol=0, atol=200 * torch.finfo(dtype).eps)


def test_light_that_leaves_the_field_does_not_come_back():
    scene = torch.zeros(8, 8, dtype=torch.float64)
    scene[0, 7] = 1.0
    psf = torch.zeros(32, 32, dtype=torch.float64)
    psf[-1, 0] = psf[0, 1] = psf[3, 0] = psf[0, -2] = 0.25
    image = image_formation(scene, psf)
    expected = torch.zeros(8, 8, dtype=torch.float64)
    expected[3, 7] = expected[0, 5] = 0.25
    torch.testing.assert_close(image, expected, rtol=0, atol=1e-15)


def test_leading_axes_broadcast():
    scenes, psfs = torch.rand(2, 1, 4, 5, generator=generator()), torch.rand(3, 8, 10, generator=generator())
    images = image_formation(scenes, psfs)
    assert images.shape == (2, 3, 4, 5)
    torch.testing.assert_close(images[1, 2], image_formation(scenes[1, 0], psfs[2]))


def test_gradients():
    scene = torch.rand(3, 4, generator=generator(), dtype=torch.float64, requires_grad=True)
    psfs = torch.rand(2, 6, 7, generator=generator(), dtype=torch.float64, requires_grad=True)
    dark = torch.zeros(3, 4, dtype=torch.float64, requires_grad=True)
    assert gradcheck(image_formation, (scene, psfs))
    assert gradcheck(image_formation, (dark, psfs))


def test_narrow_psfs_are_refused():
    scene = torch.ones(8, 8)
    image_formation(scene, torch.ones(15, 15))
    for shape in ((14, 15), (15, 14), (8, 8)):
        with pytest.raises(ValueError, match="15 x 15"):
            image_formation(scene, torch.ones(shape))


@pytest.mark.parametrize("noise", ["poisson", "gaussian"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("mean", "readout_noise"), [(0.0, 2.0), (0.3, 0.0), (7.0, 1.5), (1e4, 30.0)])
def test_mean_and_variance_of_frames(dtype, mean, readout_noise, noise):
    n = 200_000
    frames = Detector(readout_noise, noise)(torch.full((n,), mean, dtype=dtype), generator(3)).double()
    variance = mean + readout_noise**2
    # fourth central moment of a normal variable, and what a count adds to it
    fourth = 3 * variance**2 + (mean if noise == "poisson" else 0.0)
    assert abs(float(frames.mean()) - mean) < 4 * math.sqrt(variance / n)
    assert abs(float(frames.var()) - variance) < 4 * math.sqrt((fourth - variance**2) / n)
    assert frames.numel() == n


def test_a_perfect_detector_counts_photons():
    frames = Detector()(torch.full((100, 100), 3.5, dtype=torch.float64), generator())
    assert bool((frames == frames.round()).all())
    assert bool((frames >= 0).all())
    assert not Detector()(torch.zeros(10, 10), generator()).any()


def test_read_noise_does_not_change_the_photons_drawn():
    expected = torch.full((50, 50), 20.0, dtype=torch.float64)
    quiet, noisy, loud = (Detector(noise)(expected, generator(5)) for noise in (0.0, 1.0, 3.0))
    torch.testing.assert_close(loud - quiet, 3 * (noisy - quiet), rtol=0, atol=1e-10)
    assert not torch.equal(Detector(1.0)(expected, generator(6)), noisy)
    assert torch.equal(Detector(1.0)(expected, generator(5)), noisy)


def test_gaussian_noise_is_normal_and_independent():
    """Skewness and excess kurtosis of n normal numbers, which a count of 3 electrons has as 0.58 and 0.33."""
    n = 200_000
    light = torch.full((n,), 3.0, dtype=torch.float64)
    frames = Detector(0.0, "gaussian")(light, generator(3))
    score = (frames - 3) / math.sqrt(3)
    assert abs(float((score**3).mean())) < 4 * math.sqrt(15 / n)
    assert abs(float((score**4).mean()) - 3) < 4 * math.sqrt(96 / n)
    assert abs(float((score[1:] * score[:-1]).mean())) < 4 / math.sqrt(n)
    assert torch.equal(Detector(0.0, "gaussian")(light, generator(3)), frames)


@pytest.mark.parametrize("readout_noise", [0.0, 1.5])
def test_gaussian_frames_differentiate_in_the_light_noise_included(readout_noise):
    light = torch.tensor([[1e-3, 0.5], [40.0, 1e4]], dtype=torch.float64, requires_grad=True)
    detector = Detector(readout_noise, noise="gaussian")
    assert gradcheck(lambda expected: detector(expected, generator(1)), light, atol=1e-7)
    (slope,) = torch.autograd.grad(detector(light, generator(1)).sum(), light)
    deviation = (light.detach() + readout_noise**2).sqrt()
    normal = (detector(light, generator(1)) - light).detach() / deviation
    torch.testing.assert_close(slope, 1 + normal / (2 * deviation), rtol=1e-9, atol=0)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_where_no_noise_is_known_the_gradient_is_that_of_the_mean(dtype):
    """Exact zeros, and the rounding of an FFT on either side of them: finite, and exactly 1."""
    rounding = 16 * 100 * torch.finfo(dtype).eps
    light = torch.tensor([100.0, 0.0, rounding, -rounding], dtype=dtype, requires_grad=True)
    frames = Detector(noise="gaussian")(light, generator())
    (slope,) = torch.autograd.grad(frames.sum(), light)
    assert slope[1:].tolist() == [1.0, 1.0, 1.0]
    assert float(slope[0]) not in (0.0, 1.0)
    assert float(frames[1].detach()) == 0.0
    (slope,) = torch.autograd.grad(Detector(2.0, "gaussian")(light, generator()).sum(), light)
    normal = (Detector(2.0, "gaussian")(light, generator())[1] / 2).detach()
    assert float(slope[1]) == pytest.approx(1 + float(normal) / 4, rel=1e-6)  # read-out noise is enough to know it


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("readout_noise", [0.0, 1.0])
def test_a_bright_image_beside_a_faint_one_changes_nothing_of_it(dtype, readout_noise):
    faint = torch.full((16, 16), 2.4, dtype=dtype)
    bright = torch.zeros_like(faint)
    bright[4:8, 4:8] = 1e14
    slopes = []
    for mate in (faint, bright):
        light = torch.stack([faint, mate]).requires_grad_()
        frames = Detector(readout_noise, noise="gaussian")(light, generator())
        slopes.append(torch.autograd.grad(frames[0].sum(), light)[0][0])
        with pytest.raises(ValueError, match="negative"):
            Detector(readout_noise)(torch.stack([-faint, mate]))
    assert torch.equal(*slopes)
    assert bool((slopes[0] != 1).all())


@pytest.mark.parametrize("noise", ["poisson", "gaussian"])
def test_a_detector_is_mapped_over_images(noise):
    light = torch.full((3, 50, 50), 9.0, dtype=torch.float64)
    frames = torch.func.vmap(Detector(1.5, noise), randomness="different")(light)
    assert frames.shape == light.shape
    assert abs(float(frames.var()) - 11.25) < 4 * 11.25 * math.sqrt(2 / light.numel())
    assert not torch.equal(frames[0], frames[1])


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_light_in_half_precision_is_refused(dtype):
    with pytest.raises(TypeError, match=r"expected is .*: float32 or float64 is needed"):
        Detector(1.0)(torch.ones(4, 4, dtype=dtype))


def test_counts_carry_no_gradient():
    light = torch.full((4, 4), 30.0, requires_grad=True)
    assert not Detector(2.0)(light, generator()).requires_grad
    assert Detector(2.0, "gaussian")(light, generator()).requires_grad


def test_rounding_below_zero_is_forgiven_and_negative_light_is_not():
    expected = torch.tensor([100.0, -1e-13], dtype=torch.float64)
    assert bool((Detector()(expected, generator()) >= 0).all())
    assert float(Detector(noise="gaussian")(expected, generator())[1]) == -1e-13
    for noise in ("poisson", "gaussian"):
        with pytest.raises(ValueError, match="negative"):
            Detector(noise=noise)(torch.tensor([100.0, -1e-11], dtype=torch.float64))
        for bad in (math.nan, math.inf):
            with pytest.raises(ValueError, match="not finite"):
                Detector(noise=noise)(torch.tensor([1.0, bad]))


@pytest.mark.parametrize("readout_noise", [-1.0, math.nan, math.inf])
def test_bad_read_noise_is_refused(readout_noise):
    with pytest.raises(ValueError, match="readout_noise"):
        Detector(readout_noise)


def test_what_is_no_light_and_no_pixel_is_refused():
    with pytest.raises(TypeError, match=r"expected is torch\.int64: .* give expected\.double\(\)"):
        Detector()(torch.ones(2, 2, dtype=torch.int64))
    with pytest.raises(TypeError, match=r"expected is of type ndarray: .* give torch\.as_tensor\(expected\)"):
        Detector()(np.ones((2, 2)))
    with pytest.raises(TypeError, match=r"pixel is 1\.0: a response such as SquarePixel"):
        Detector(pixel=1.0)


def test_unknown_noise_is_refused():
    with pytest.raises(ValueError, match="noise is 'normal': it must be one of poisson, gaussian"):
        Detector(noise="normal")


def test_no_frames_are_formed_from_no_psfs():
    scene = torch.ones(4, 4, dtype=torch.float64, requires_grad=True)
    psfs = torch.zeros(0, 8, 8, dtype=torch.float64, requires_grad=True)
    frames = Detector(1.5, noise="gaussian")(image_formation(scene, psfs))
    assert frames.shape == (0, 4, 4)
    assert image_formation_adjoint(frames, psfs).shape == (0, 4, 4)
    frames.sum().backward()
    assert not bool(scene.grad.any())


@pytest.mark.parametrize("noise", ["poisson", "gaussian"])
def test_single_precision_draws_the_noise_of_double_precision(noise):
    light = torch.arange(1.0, 61.0).view(6, 10)
    single, double = (Detector(2.0, noise)(light.to(dtype), generator(3)) for dtype in (torch.float32, torch.float64))
    assert single.dtype == torch.float32
    torch.testing.assert_close(single, double.float(), rtol=4 * torch.finfo(torch.float32).eps, atol=1e-5)
