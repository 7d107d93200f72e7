"""The power of fringes against closed forms: the pattern of a mask, its share, and how that share scatters."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringe_power import FringePower, _smoothed, expected_power, fringe_wavelengths, likeness
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.geometry import MaskGeometry

GRID = Grid.nyquist(1.0, 550e-9, 64)
MASK = SparseAperture.random(9, 1.0, 0.12, torch.Generator().manual_seed(4))


def power_of(values: torch.Tensor) -> FringePower:
    """Power that has `values` (H, W) above a noise of 1, at the frequencies of `MASK`."""
    some = FringePower.of(torch.rand(2, 64, 64, generator=torch.Generator().manual_seed(0)), MASK, GRID)
    assert some is not None
    return FringePower(values[some.chosen] + 1.0, 1.0, GRID, some.chosen, some.rings)


def test_expected_power_is_the_sum_of_the_patches_of_all_pairs():
    step = GRID.period / 64  # centres on samples, where the series that a convolution interpolates by is exact
    mask, nu = MASK.replace((0.5 * MASK.centers / step).round() * step), torch.tensor([-10, 3, 17])
    centers = mask.centers / GRID.period
    place = torch.stack(torch.meshgrid(nu / 64, nu / 64, indexing="ij"), -1).double()  # (y, x)
    total = torch.zeros(3, 3, dtype=torch.float64)
    for m in range(9):
        for n in range(9):
            if m != n:
                shift = (place.flip(-1) - centers[m] + centers[n]) * GRID.period
                total += mask.shape.otf(shift, mask.subaperture_diameter) ** 2
    torch.testing.assert_close(expected_power(mask, GRID)[nu[:, None], nu], total)


def test_the_power_of_a_band_is_the_mean_over_its_wavelengths():
    parts = [expected_power(MASK, replace(GRID, wavelength=wavelength)) for wavelength in (500e-9, 600e-9)]
    torch.testing.assert_close(expected_power(MASK, GRID, [500e-9, 600e-9]), (parts[0] + parts[1]) / 2)


@pytest.mark.parametrize("width", [0.02, 0.2, 0.8])
def test_the_fringes_of_neighbouring_wavelengths_are_half_a_hole_apart_at_most(width):
    band = Band.top_hat(550e-9, width * 550e-9)
    found = torch.tensor([1 / wavelength for wavelength in fringe_wavelengths(MASK, GRID, band)], dtype=torch.float64)
    ends = torch.tensor([1 / max(band.wavelengths), 1 / band.shortest], dtype=torch.float64)
    half = MASK.subaperture_diameter / 2 / (float(MASK.extent) * 550e-9)  # [1/m]
    # all of the band is within a quarter of a hole of one of them, to the rounding of float32
    assert float((found - ends[:, None]).abs().amin(1).max()) <= half / 2 * (1 + 1e-6)
    assert len(found) == 1 or 0.5 * half < float(found.diff().max()) <= half * (1 + 1e-6)
    assert float(found.mean()) == pytest.approx(float(ends.mean()), rel=1e-12)


def test_wavelengths_of_hardly_any_light_do_not_count():
    band = Band.of([400e-9, 500e-9, 600e-9], [0.97, 0.02, 0.01])
    assert fringe_wavelengths(MASK, GRID, band) == pytest.approx([400e-9], rel=1e-12)
    power = FringePower.of(torch.rand(2, 64, 64), MASK, Grid.nyquist(1.0, 400e-9, 64), [300e-9, 400e-9])
    assert power is not None
    radius = torch.hypot(*torch.broadcast_tensors(*power.grid.frequencies(torch.float64)))[power.chosen]
    assert float(radius.min()) > power.grid.cutoff(MASK.outer_diameter) * 4 / 3  # beyond one hole in the bluest light


def test_smoothing_is_what_a_hann_window_does_to_white_noise():
    """Its transform is 1/2 at zero and -1/4 beside it on each axis: squared 4 : 1, which sum to 6 with both sides."""
    window = 0.5 - 0.5 * torch.cos(2 * math.pi * torch.arange(64, dtype=torch.float64) / 64)
    response = torch.fft.fft2(window[:, None] * window).abs() ** 2
    point = torch.zeros(64, 64, dtype=torch.float64)
    point[0, 0] = 1.0
    torch.testing.assert_close(_smoothed(point), response / response.sum(), atol=1e-15, rtol=1e-12)


@pytest.mark.parametrize("light", [0.1, 3.0, 1e4])
def test_a_mask_has_all_of_its_own_pattern_however_bright_and_steep(light):
    """Where each ring has its own brightness; the logarithm is of pattern and noise together."""
    power = power_of(torch.ones(64, 64, dtype=torch.float64))
    steep = torch.full((64, 64), 0.0, dtype=torch.float64)
    steep[power.chosen] = light / (1.0 + power.rings.double()) ** 2
    share, error = power_of(steep * _smoothed(expected_power(MASK, GRID)).clamp(min=0)).match(MASK)
    assert share == pytest.approx(1.0, abs=1e-9)
    assert error == pytest.approx(1 / math.sqrt(72), rel=1e-9)  # N (N - 1) = 72; all that varies is the pattern


def test_other_masks_show_none_with_the_error_that_is_told():
    """60 random masks: the mean share scatters by 1 / sqrt(60), the variance by sqrt(2 / 60); four of each."""
    power = power_of(50.0 * _smoothed(expected_power(MASK, GRID)).clamp(min=0))
    generator = torch.Generator().manual_seed(1)
    matches = [power.match(SparseAperture.random(9, 1.0, 0.12, generator)) for _ in range(60)]
    pulls = torch.tensor([share / error for share, error in matches])
    assert abs(float(pulls.mean())) < 4 / math.sqrt(60)
    assert abs(float(pulls.square().mean()) - 1) < 4 * math.sqrt(2 / 60)


def test_even_power_says_nothing():
    share, error = power_of(torch.zeros(64, 64, dtype=torch.float64)).match(MASK)
    assert (share, error) == (0.0, math.inf)
    grid = Grid(8, GRID.pixel_scale / 8, GRID.wavelength)
    assert FringePower.of(torch.ones(2, 8, 8), MASK, grid) is None  # no frequency is between a hole and the mask


def test_likeness_of_a_mask_to_itself_and_to_its_mirror_image():
    symmetric = SparseAperture.from_catalog("golay3", 1.0, 0.15)
    mirror = MaskGeometry(mirrored=True)
    pairs = (MASK, MASK.replace(-MASK.centers)), (symmetric, mirror.apply(symmetric)), (MASK, mirror.apply(MASK))
    opposite, same, other = (likeness(*(expected_power(mask, GRID) for mask in pair)) for pair in pairs)
    assert opposite == pytest.approx(1.0)
    assert same == pytest.approx(1.0)
    assert other < 0.5


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_power_is_that_of_the_windowed_transform_in_either_precision(dtype):
    frames = torch.rand(40, 64, 64, generator=torch.Generator().manual_seed(0), dtype=torch.float64).to(dtype)
    power = FringePower.of(frames, MASK, GRID)
    assert power is not None
    window = torch.hann_window(64, periodic=False, dtype=torch.float64)
    still = (frames.double() - frames.double().mean((1, 2), keepdim=True)) * window[:, None] * window
    expected = (torch.fft.fft2(still).abs() ** 2).mean(0)
    torch.testing.assert_close(
        power.power, expected[power.chosen], rtol=1e-4 if dtype is torch.float32 else 1e-12, atol=0
    )
    nu = torch.hypot(*GRID.frequencies(torch.float64))
    assert power.noise == pytest.approx(float(expected[nu > 0.5].mean()), rel=1e-4)
