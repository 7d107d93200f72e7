"""What is read off the frames: noise, turbulence, and whether they are frames at all."""

import math

import pytest
import torch
from torchmask.restoration.initialization import (
    border_brightness,
    check_frames,
    expected_variance,
    mean_frame,
    noise_variance,
    turbulence_strength,
)

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.restoration.priors import whitening

GRID = Grid.nyquist(1.0, 550e-9, 32)
PUPIL = FullAperture(1.0)


def blurred(n_frames, generator, level=100.0):
    """Band-limited frames: smooth within the cut-off of the pupil."""
    nu_y, nu_x = GRID.frequencies(torch.float64)
    inside = torch.hypot(nu_y, nu_x) < 0.4
    noise = torch.rand(n_frames, *GRID.shape, dtype=torch.float64, generator=generator)
    return level * torch.fft.ifft2(torch.fft.fft2(noise) * inside).real.clamp(min=0)


@pytest.mark.parametrize("n_frames", [1, 20])
def test_noise_variance_is_measured_beyond_the_cutoff(n_frames):
    generator = torch.Generator().manual_seed(n_frames)
    ratios = []
    for _ in range(40):
        noise = 3.0 * torch.randn(n_frames, *GRID.shape, dtype=torch.float64, generator=generator)
        nu_y, nu_x = GRID.frequencies(torch.float64)
        scene = torch.fft.ifft2(
            torch.fft.fft2(torch.rand(GRID.shape, dtype=torch.float64)) * (torch.hypot(nu_y, nu_x) < 0.45)
        ).real
        ratios.append(noise_variance(1e3 * scene + noise, GRID, PUPIL) / 9)
    ratios = torch.tensor(ratios)
    # Standard error, and 2 % for the Wilson-Hilferty formula at few degrees of freedom and conjugate pairs.
    assert abs(float(ratios.mean()) - 1) < 4 * float(ratios.std()) / math.sqrt(40) + 0.02
    assert float(ratios.std()) < 2.5 / math.sqrt(n_frames * 100)


@pytest.mark.parametrize("holes", ["scattered", "a blob"])
def test_noise_variance_is_that_of_the_valid_pixels(holes):
    """What stands in dead and saturated pixels is no noise, and what is put there takes none away."""
    generator = torch.Generator().manual_seed(4)
    valid = torch.rand(GRID.shape, generator=generator) > 0.05
    if holes == "a blob":
        valid = torch.ones(GRID.shape, dtype=torch.bool)
        valid[12:18, 14:20] = False
    nu_y, nu_x = GRID.frequencies(torch.float64)
    inside, ratios, naive = torch.hypot(nu_y, nu_x) < 0.45, [], []
    for _ in range(40):
        scene = torch.rand(GRID.shape, dtype=torch.float64, generator=generator)
        scene = 1e3 * torch.fft.ifft2(torch.fft.fft2(scene) * inside).real
        frames = scene + 3.0 * torch.randn(4, *GRID.shape, dtype=torch.float64, generator=generator)
        filled, mask = check_frames(torch.where(valid, frames, math.inf), valid, GRID)
        ratios.append(noise_variance(filled, GRID, PUPIL, mask) / 9)
        naive.append(noise_variance(filled, GRID, PUPIL) / 9)
    ratios = torch.tensor(ratios)
    assert abs(float(ratios.mean()) - 1) < 4 * float(ratios.std()) / math.sqrt(40) + 0.05  # that of the white noise
    assert min(naive) > 2


def test_noise_variance_needs_frequencies_beyond_the_cutoff():
    coarse = Grid.nyquist(1.0, 550e-9, (4, 4))
    assert noise_variance(torch.rand(3, 4, 4), coarse, PUPIL) is None
    with pytest.raises(ValueError, match="give readout_noise"):
        expected_variance(torch.rand(3, 4, 4), coarse, PUPIL, None)


def test_wrong_noise_level_is_noticed():
    generator = torch.Generator().manual_seed(0)
    frames = torch.poisson(blurred(8, generator), generator=generator)
    right = expected_variance(frames, GRID, PUPIL, 0.0)
    assert right == pytest.approx(float(frames.mean()))
    assert expected_variance(frames, GRID, PUPIL, None) == pytest.approx(right, rel=0.1)
    with pytest.warns(UserWarning, match="check the gain"):
        expected_variance(frames, GRID, PUPIL, 100.0)
    with pytest.warns(UserWarning, match="check the gain"):
        expected_variance(frames * 10, GRID, PUPIL, 0.0)  # not in electrons


@pytest.mark.parametrize("aperture", [SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.1]], 0.2, 1.0), PUPIL])
def test_turbulence_strength_is_unbiased(aperture):
    """Aberrations drawn from a prior twice as strong in variance."""
    mixing = whitening(aperture, 10, 0.15, 20.0)
    z = torch.randn(4000, mixing.shape[1], dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    coefficients = (2**0.5 * z @ mixing.T).unflatten(1, (-1, 10))
    estimates = torch.tensor([turbulence_strength(part, mixing) for part in coefficients.split(100)])
    assert abs(float(estimates.mean()) - 2) < 4 * float(estimates.std()) / math.sqrt(len(estimates))
    assert turbulence_strength(coefficients[..., :1], mixing) is None
    assert turbulence_strength(0 * coefficients, mixing) == 0.05


def test_pixels_that_are_not_valid_may_hold_anything():
    generator = torch.Generator().manual_seed(1)
    frames = blurred(3, generator)
    valid = torch.ones(GRID.shape, dtype=torch.bool)
    valid[5, 6] = valid[0, 0] = False
    spoilt = frames.clone()
    spoilt[:, 5, 6], spoilt[:, 0, 0] = math.nan, math.inf
    filled, mask = check_frames(spoilt, valid, GRID)
    assert mask.shape == frames.shape
    assert torch.equal(filled[:, valid], frames[:, valid])
    around = (frames[:, 4:7, 5:8].sum((1, 2)) - frames[:, 5, 6]) / 8
    assert torch.allclose(filled[:, 5, 6], around)


def test_a_dead_region_is_filled_from_its_rim():
    frames, valid = torch.zeros(1, *GRID.shape, dtype=torch.float64), torch.ones(GRID.shape, dtype=torch.bool)
    frames[:, 8:20, 8:20] = 5.0
    valid[10:18, 10:18] = False  # saturated: wholly within the bright part
    filled, _ = check_frames(torch.where(valid, frames, math.nan), valid, GRID)
    torch.testing.assert_close(filled, frames, rtol=1e-12, atol=0)
    with pytest.raises(ValueError, match="hold no light"):
        check_frames(frames, ~torch.ones_like(valid), GRID)


def test_arrays_and_frames_with_a_gradient_are_frames_too():
    frames = blurred(3, torch.Generator().manual_seed(1))
    valid = frames > 0
    expected = check_frames(frames, valid, GRID)
    for given in ((frames.numpy(), valid.numpy()), (frames.clone().requires_grad_(), valid)):
        for one, other in zip(expected, check_frames(*given, GRID), strict=True):
            assert torch.equal(one, other)
            assert not other.requires_grad


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f[0], "at least one frame"),
        (lambda f: f[:, :-1], "as the grid says"),
        (lambda f: f[:0], "at least one frame"),
        (lambda f: f.index_fill(0, torch.tensor([1]), math.nan), r"frames \[1\] hold values that are not finite"),
        (lambda f: f.index_fill(0, torch.tensor([2]), 0.0), r"frames \[2\] hold no light"),
        (lambda f: -f, "hold no light"),
    ],
)
def test_refuses_frames(change, words):
    frames = blurred(3, torch.Generator().manual_seed(1))
    with pytest.raises(ValueError, match=words):
        check_frames(change(frames), None, GRID)


def test_refuses_a_mask_of_valid_pixels_that_does_not_fit():
    frames = blurred(3, torch.Generator().manual_seed(1))
    ones = torch.ones(2, *GRID.shape, dtype=torch.bool)  # for three frames
    for valid in (torch.ones(GRID.shape), ones[0, :4, :4], ones):
        with pytest.raises(ValueError, match="valid"):
            check_frames(frames, valid, GRID)


def test_mean_frame_and_border():
    frames = torch.zeros(2, 4, 6)
    frames[:, 1:3, 1:5] = torch.tensor([2.0, -8.0])[:, None, None]
    assert border_brightness(frames + 10) == pytest.approx(10 / (10 - 3 / 3), rel=1e-6)
    start = mean_frame(frames + 1, Grid((6, 8), 1e-7, 5e-7))
    assert start.shape == (6, 8)
    assert float(start[1, 1]) == 0  # clipped
    assert float(start[0, 0]) == 1
    assert float(start[4:].abs().sum() + start[:, 6:].abs().sum()) == 0
