"""Pixels: closed forms of squares and of maps, against images that are averaged over finer ones."""

import math

import pytest
import torch

from torchmask.optics.pixel import JitteredPixel, MappedPixel, SquarePixel, jittered, pixel_record, read_pixel


def frequencies(rows=12, columns=10):
    nu_y = torch.fft.fftfreq(rows, dtype=torch.float64)[:, None]
    return nu_y, torch.fft.fftfreq(columns, dtype=torch.float64)[None]


def test_a_square_pixel_averages_a_wave_over_its_area():
    """The mean of cos(2 pi (nu_x x + nu_y y)) over a square of side w, by a sum over many points."""
    fill, nu = 0.49, (0.31, -0.44)
    places = (torch.arange(2000, dtype=torch.float64) + 0.5) / 2000 - 0.5
    side = math.sqrt(fill) * places
    mean = torch.cos(2 * math.pi * (nu[0] * side[:, None] + nu[1] * side)).mean()
    found = SquarePixel(fill).transfer(torch.tensor([[nu[0]]]).double(), torch.tensor([[nu[1]]]).double())
    assert float(found) == pytest.approx(float(mean), rel=1e-6)  # of the midpoint rule: (pi nu / 2000)^2 / 6


def test_an_even_map_is_a_square_and_converges_to_it():
    nu_y, nu_x = frequencies()
    exact = SquarePixel().transfer(nu_y, nu_x)
    errors = []
    for samples in (8, 16):
        found = MappedPixel(torch.full((samples, samples), 3.0), samples).transfer(nu_y, nu_x)
        assert found[0, 0].real == pytest.approx(1, rel=1e-14)
        errors.append(float((found - exact).abs().max()))
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.05)  # the midpoint rule


def test_a_map_off_centre_moves_the_image():
    nu_y, nu_x = frequencies()
    sensitivity = torch.zeros(4, 4, dtype=torch.float64)
    sensitivity[3, 0] = 2.0  # 3/8 of a pitch down, 3/8 to the left
    expected = torch.exp(-2j * math.pi * (3 / 8) * (nu_y - nu_x))
    torch.testing.assert_close(MappedPixel(sensitivity, 4).transfer(nu_y, nu_x), expected)


@pytest.mark.parametrize("fill", [0.0, -0.1, 1.1, math.nan])
def test_a_fill_factor_is_a_part_of_the_pitch(fill):
    with pytest.raises(ValueError, match="fill_factor"):
        SquarePixel(fill)


@pytest.mark.parametrize(
    ("sensitivity", "samples"),
    [(torch.ones(3), 3), (torch.ones(3, 3), 0), (torch.zeros(3, 3), 3), (-torch.eye(3), 3), (torch.ones(2, 2) / 0, 2)],
)
def test_a_map_must_be_one(sensitivity, samples):
    with pytest.raises(ValueError, match="sensitivity"):
        MappedPixel(sensitivity, samples)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_jitter_takes_from_a_wave_what_its_mean_over_the_motion_loses(dtype):
    """The mean of cos(2 pi nu . s) over normal s, on a grid that reaches so far that the rest is below rounding."""
    rms, nu = 0.4, (0.31, -0.44)
    places = torch.linspace(-10, 10, 4001, dtype=torch.float64) * rms
    weights = torch.exp(-(places**2) / (2 * rms**2))
    mean = 1.0
    for frequency in nu:
        mean *= float((weights * torch.cos(2 * math.pi * frequency * places)).sum() / weights.sum())
    at = [torch.tensor([[value]], dtype=dtype) for value in nu]
    rounding = 1e-6 if dtype is torch.float32 else 1e-12
    assert float(JitteredPixel(rms).transfer(*at)) == pytest.approx(mean, rel=rounding)
    square = float(SquarePixel(0.8).transfer(*at))
    assert float(JitteredPixel(rms, SquarePixel(0.8)).transfer(*at)) == pytest.approx(mean * square, rel=rounding)
    assert float(JitteredPixel(0.0).transfer(*at)) == 1


@pytest.mark.parametrize("pixel", [None, SquarePixel(0.7)])
def test_jitter_is_kept_in_files_and_replaced_not_added(pixel):
    moving = JitteredPixel(0.25, pixel)
    assert read_pixel(pixel_record(moving)) == moving
    assert jittered(moving, 0.5) == JitteredPixel(0.5, pixel)
    assert jittered(moving, 0.0) == pixel


@pytest.mark.parametrize("rms", [-0.1, math.nan, math.inf])
def test_a_jitter_is_a_number_of_pixels(rms):
    with pytest.raises(ValueError, match=f"rms is {rms}: it must be finite and at least 0, in pixels"):
        JitteredPixel(rms)


def test_a_map_follows_the_frequencies_and_not_the_default_device():
    nu, pixel = frequencies(), MappedPixel(torch.eye(4), 2)
    expected = pixel.transfer(*nu)
    with torch.device("meta"):
        assert torch.equal(pixel.transfer(*nu), expected)
