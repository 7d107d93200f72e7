"""The score is invariant to what cannot be seen, sensitive to what can, and equal to its written definition."""

import importlib.util
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from torchmask.metrics import align, lowpass, relative_error, shift, ssim


def smooth_scene(rows: int, columns: int, cutoff: float, seed: int = 0) -> torch.Tensor:
    """Random positive image without frequencies above `cutoff`, so that moving and low-passing it is exact."""
    generator = torch.Generator().manual_seed(seed)
    image = lowpass(torch.randn(rows, columns, generator=generator, dtype=torch.float64), cutoff)
    return image - image.min() + 0.1


def moved(image: torch.Tensor, dy: float, dx: float) -> torch.Tensor:
    """The image moved by (dy, dx): the DFT written out as matrices, independent of the code under test."""

    def matrix(n: int, offset: float) -> torch.Tensor:
        k = torch.fft.fftfreq(n, 1 / n, dtype=torch.float64)
        x = torch.arange(n, dtype=torch.float64)
        back = torch.exp(2j * math.pi * k * (x[:, None] - offset) / n) / n
        return (back @ torch.exp(-2j * math.pi * k[:, None] * x / n)).real

    return matrix(image.shape[0], dy) @ image.double() @ matrix(image.shape[1], dx).T


@settings(derandomize=True, deadline=None, max_examples=30)
@given(
    st.integers(17, 40),
    st.integers(17, 40),
    st.floats(-8, 8),
    st.floats(-8, 8),
    st.floats(1e-3, 1e3),
    st.floats(0.1, 0.45),
    st.integers(0, 1000),
)
def test_position_and_brightness_do_not_count(rows, columns, dy, dx, gain, cutoff, seed):
    truth = smooth_scene(rows, columns, cutoff, seed)
    estimate = gain * moved(truth, dy, dx)
    # The correlation is stationary at its top, so a gradient of 1e-9 (the registration's tolerance) leaves the
    # shift wrong by far less than 1e-6 pixel, and the score by that times the gradient of a band-limited image.
    assert relative_error(estimate, truth, cutoff) < 1e-6
    torch.testing.assert_close(align(estimate, truth, cutoff), lowpass(truth, cutoff), rtol=0, atol=1e-5)


def test_known_error():
    """An error orthogonal to the truth, at a frequency the truth has not: NRMSE in closed form."""
    n, cutoff = 32, 0.4
    x = torch.arange(n, dtype=torch.float64)
    truth = 1 + torch.cos(2 * math.pi * 3 * x / n)[:, None] * torch.ones(n, dtype=torch.float64)
    ripple = torch.cos(2 * math.pi * 5 * x / n)[None, :].expand(n, n)
    for amplitude in (0.01, 0.3):
        # ||truth||^2 = n^2 (1 + 1/2) and ||ripple||^2 = n^2 / 2. The best gain g leaves the sine of the angle between
        # truth and estimate, a / sqrt(3 + a^2); moving along x does not help, for the truth is constant there.
        expected = amplitude / math.sqrt(3 + amplitude**2)
        assert relative_error(7 * (truth + amplitude * ripple), truth, cutoff) == pytest.approx(expected, rel=1e-9)
    hidden = torch.cos(2 * math.pi * 14 * x / n)[None, :].expand(n, n)  # 14 / 32 > 0.4: beyond the cut-off
    assert relative_error(truth + hidden, truth, cutoff) < 1e-9


def test_lowpass_keeps_the_rim_and_nothing_beyond():
    n = 20
    x = torch.arange(n, dtype=torch.float64)
    wave = torch.cos(2 * math.pi * (6 * x[:, None] + 8 * x) / n)  # |nu| = 10 / 20
    torch.testing.assert_close(lowpass(wave, 0.5), wave)
    assert lowpass(wave, 0.499).abs().max() < 1e-12
    stack = torch.stack([wave, 2 * wave + 1]).requires_grad_()
    torch.testing.assert_close(lowpass(stack, 0.499)[1], torch.ones(n, n, dtype=torch.float64))
    low = lowpass(stack.detach().float(), 0.499)
    assert low.dtype == torch.float32
    torch.testing.assert_close(low[1], torch.ones(n, n))
    assert torch.autograd.gradcheck(lambda image: lowpass(image, 0.3), (stack[:, :6, :7],))


SIDES = st.integers(3, 24)
OFFSETS = st.floats(-30, 30)


def noise(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_shift_by_whole_pixels_is_a_roll(dtype):
    image = noise(2, 12, 15, dtype=dtype)
    for dy, dx in ((0, 0), (3, -4), (-12, 15), (17, 40)):
        moved_by = shift(image, (dy, dx))
        assert moved_by.dtype == dtype
        # values of up to 4 through two FFTs, and phases of up to pi for each pixel of the way, each with its rounding
        atol = (20 + 4 * math.pi * (abs(dy) + abs(dx))) * torch.finfo(dtype).eps
        torch.testing.assert_close(moved_by, image.roll((dy, dx), (-2, -1)), rtol=0, atol=atol)


@settings(derandomize=True, deadline=None, max_examples=40)
@given(SIDES, SIDES, OFFSETS, OFFSETS, OFFSETS, OFFSETS, st.integers(0, 1000))
def test_shifts_follow_the_dft_add_and_have_their_opposite_as_adjoint(rows, columns, dy, dx, more_y, more_x, seed):
    image, other = noise(2, rows, columns, seed=seed)
    there, back = (shift(x, o) for x, o in ((image, (dy, dx)), (other, (-dy, -dx))))
    assert float((there * other).sum()) == pytest.approx(float((image * back).sum()), abs=1e-11 * rows * columns)
    close = {"rtol": 0, "atol": 1e-12 * rows * columns}
    odd = image[: rows - 1 + rows % 2, : columns - 1 + columns % 2]  # below Nyquist every frequency has its sign
    torch.testing.assert_close(shift(odd, (dy, dx)), moved(odd, dy, dx), **close)
    both = shift(shift(odd, (dy, dx)), (more_y, more_x))
    torch.testing.assert_close(both, shift(odd, (dy + more_y, dx + more_x)), **close)
    torch.testing.assert_close(shift(shift(odd, (dy, dx)), (-dy, -dx)), odd, **close)


def test_the_wave_at_nyquist_vanishes_half_a_pixel_further():
    wave = torch.tensor([1.0, -1.0], dtype=torch.float64).repeat(4, 3)
    torch.testing.assert_close(shift(wave, (0.0, 0.5)), torch.zeros_like(wave), rtol=0, atol=1e-15)
    torch.testing.assert_close(shift(wave, (0.5, 1.0)), -wave, rtol=0, atol=1e-15)


def test_each_image_has_its_offset_and_both_have_gradients():
    images, offsets = noise(3, 1, 5, 6).requires_grad_(), noise(3, 2, 2, seed=1).requires_grad_()
    shifted = shift(images, offsets)
    assert shifted.shape == (3, 2, 5, 6)
    torch.testing.assert_close(shifted[2, 1], shift(images[2, 0], tuple(offsets[2, 1].tolist())), rtol=0, atol=1e-14)
    assert torch.autograd.gradcheck(shift, (images, offsets))
    with pytest.raises(ValueError, match=r"offset has shape \(3,\): its last axis must be \(dy, dx\)"):
        shift(images, torch.zeros(3))


def test_align_in_the_units_of_the_truth():
    truth = smooth_scene(24, 30, 0.3)
    estimate = moved(truth, 2.3, -4.7) + 0.05 * smooth_scene(24, 30, 0.3, seed=5)
    aligned = align(estimate, truth, 0.3)
    residual = aligned - lowpass(truth, 0.3)
    assert abs(float((residual * aligned).sum())) < 1e-9 * float((aligned**2).sum())  # the gain is the best one
    torch.testing.assert_close(align(estimate, 1e4 * truth, 0.3), 1e4 * aligned)
    assert relative_error(estimate, truth, 0.3) == pytest.approx(
        float(residual.norm() / lowpass(truth, 0.3).norm()), rel=1e-12
    )


def test_tensors_arrays_and_dtypes_agree():
    truth = smooth_scene(20, 20, 0.4).float()
    estimate = truth.roll((3, 1), (0, 1)) + 0.1 * smooth_scene(20, 20, 0.4, seed=2).float()
    expected = relative_error(estimate, truth, 0.4)
    assert isinstance(expected, float)
    assert relative_error(estimate.requires_grad_(), truth.double(), 0.4) == expected
    assert relative_error(estimate.detach().numpy(), truth.numpy().astype(np.float64), 0.4) == expected
    assert relative_error((estimate * 1000).round().long(), truth, 0.4) == pytest.approx(expected, abs=2e-3)


def test_shared_definition(shared):
    spec = importlib.util.spec_from_file_location("shared_score", shared / "stacks" / "score.py")
    assert spec is not None
    assert spec.loader is not None
    definition = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(definition)
    rng = np.random.default_rng(0)
    # Registered to 1e-3 pixel there and far finer here, the two differ by about (1e-3)^2 times the curvature.
    for name in ("skylab_1e7_mask", "mgs_1e6_full"):
        with np.load(shared / "stacks" / f"{name}.npz", allow_pickle=False) as stack:
            truth, frames = stack["object"], stack["frames"]
        for estimate in (frames[0], frames.mean(0), truth + truth.max() * rng.random(truth.shape)):
            for cutoff in (0.5, 0.2):
                assert relative_error(estimate, truth, cutoff) == pytest.approx(
                    definition.score(estimate, truth, cutoff), abs=1e-6
                )
    for shape in ((16, 16), (17, 24)):  # without structure: the hardest to register
        truth, estimate = rng.random(shape), rng.random(shape)
        assert relative_error(estimate, truth, 0.5) == pytest.approx(definition.score(estimate, truth, 0.5), abs=1e-5)


def test_ssim():
    truth = smooth_scene(32, 32, 0.3)
    truth[4, 4] += 50  # a glint
    low = lowpass(truth, 0.3)
    assert ssim(3 * moved(low, 1.5, -2.25), truth, 0.3) == pytest.approx(1, abs=1e-5)
    worse = [ssim(low + a * smooth_scene(32, 32, 0.3, seed=9), truth, 0.3) for a in (0.1, 0.5, 2.0)]
    assert 1 > worse[0] > worse[1] > worse[2]
    estimate = align(low + 0.5 * smooth_scene(32, 32, 0.3, seed=9), truth, 0.3).numpy()
    peak = np.percentile(low.numpy(), 99.5)
    clipped = structural_similarity(np.clip(estimate, 0, peak), np.clip(low.numpy(), 0, peak), data_range=peak)
    assert worse[1] == pytest.approx(float(clipped), rel=1e-12)


@pytest.mark.parametrize(
    ("estimate", "truth", "cutoff", "message"),
    [
        (torch.ones(4, 4), torch.ones(4, 5), 0.5, r"estimate has shape \(4, 4\) and truth \(4, 5\)"),
        (torch.ones(2, 4, 4), torch.ones(4, 4), 0.5, r"estimate has shape \(2, 4, 4\): it must be one image"),
        (torch.full((4, 4), math.nan), torch.ones(4, 4), 0.5, "estimate holds values that are not finite"),
        (torch.ones(4, 4), torch.full((4, 4), math.inf), 0.5, "truth holds values that are not finite"),
        (torch.ones(4, 4), -torch.ones(4, 4), 0.5, "sum of truth is not positive"),
        (torch.zeros(4, 4), torch.ones(4, 4), 0.5, "estimate is zero"),
        (torch.ones(4, 4), torch.ones(4, 4), 0.0, "cutoff is 0.0"),
        (torch.ones(4, 4), torch.ones(4, 4), math.nan, "cutoff is nan"),
    ],
)
@pytest.mark.parametrize("function", [relative_error, align, ssim])
def test_bad_input(function, estimate, truth, cutoff, message):
    with pytest.raises(ValueError, match=message):
        function(estimate, truth, cutoff)


def test_a_flat_estimate_has_a_score():
    truth = smooth_scene(16, 16, 0.4)
    mean = float(truth.mean())
    expected = float((truth - mean).norm() / truth.norm())  # the best constant is the mean
    assert relative_error(torch.ones(16, 16), truth, 0.4) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_scores_are_the_same_where_gradients_are_off(mode):
    """As in every validation loop; the registration takes gradients of its own."""
    truth = smooth_scene(20, 24, 0.4)
    estimate = moved(truth, 0.3, -1.6) + 0.1
    expected = relative_error(estimate, truth, 0.4), ssim(estimate, truth, 0.4)
    with mode():
        inside = truth.clone()  # which inference mode lets take part in no gradient
        assert (relative_error(estimate, inside, 0.4), ssim(estimate, inside, 0.4)) == expected


def test_images_of_whole_numbers_are_taken_as_they_are_and_half_precision_is_refused():
    image = np.arange(30).reshape(5, 6) ** 2 % 17
    for changed in (lambda x: lowpass(x, 0.3), lambda x: shift(x, (0.4, -1.2))):
        assert torch.equal(changed(image), changed(torch.from_numpy(image).double()))
        with pytest.raises(TypeError, match=r"image is torch.float16: float32 or float64 is needed"):
            changed(torch.ones(4, 4, dtype=torch.float16))
