"""Endless screens: the spectrum they have, the noise they are made of, and that a place keeps its phase."""

import math

import pytest
import torch

from torchmask.atmosphere.endless import Screen, ScreenWindow
from torchmask.atmosphere.profiles import named_layers
from torchmask.atmosphere.von_karman import von_karman_covariance, von_karman_structure_function

CPU = torch.device("cpu")


def window(shape=(32, 40), step=(0.02, 0.02), outer_scale=20.0, dtype=torch.float64):
    return ScreenWindow(shape, step, outer_scale, dtype, CPU)


def wave_powers(window):
    """Frequencies (fy, fx) [cycles/m] of all waves and their mean squares, band by band; opposite waves are one."""
    for band in window.bands:
        fy, fx = band.raster.frequencies()
        power = band.amplitude.double() ** 2 * math.prod(band.raster.shape)
        yield fy[:, None], fx, power * torch.where(fx > 0, 2, 1)


def expected_difference(window, dy, dx):
    """Mean square [rad^2] for r0 = 1 m: every wave's power times 2 (1 - cos)."""
    return sum(
        float((2 * power * (1 - torch.cos(2 * math.pi * (fy * dy + fx * dx)))).sum())
        for fy, fx, power in wave_powers(window)
    )


CASES = {
    "pupil": ((128, 128), (1 / 128, 1 / 128)),
    "oblong": ((128, 40), (1 / 128, 1 / 128)),
    "oblong samples": ((64, 96), (1 / 64, 1 / 96)),
    "few samples": ((8, 8), (1 / 8, 1 / 8)),
    "one sample": ((1, 1), (1 / 8, 1 / 8)),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("outer_scale", [0.5, 2.0, 20.0, 1e6])
def test_expected_structure_function(case, outer_scale):
    """von Karman at every separation in the window and a little beyond, in all directions, to 0.15 %."""
    shape, step = CASES[case]
    look = window(shape, step, outer_scale)
    rows, columns = shape
    near = [(0, 1), (1, 0), (1, 1), (0, 2), (2, -3), (4, 4)]
    far = [(rows // 2, columns // 2), (rows // 2, -columns), (rows, 0), (0, columns), (rows, columns), (-rows, columns)]
    for y, x in near + far:
        dy, dx = y * step[0], x * step[1]
        found = expected_difference(look, dy, dx)
        distance = torch.tensor(math.hypot(dy, dx), dtype=torch.float64)
        exact = float(von_karman_structure_function(distance, 1.0, outer_scale))
        assert found == pytest.approx(exact, rel=1.5e-3), (y, x)
    variance = sum(float(power.sum()) for _, _, power in wave_powers(look))
    exact = float(von_karman_covariance(torch.zeros(1, dtype=torch.float64), 1.0, outer_scale))
    assert variance == pytest.approx(exact, rel=1.5e-3)


@pytest.mark.parametrize(("outer_scale", "kolmogorov"), [(1e7, True), (20.0, False)])
@pytest.mark.parametrize("name", ["hv57", "las_campanas"])
def test_directions_differ_by_one_square_radian_at_theta0_and_times_at_tau0(name, outer_scale, kolmogorov):
    """To 3 % for a very large outer scale, von Karman's value otherwise: expected from the waves, layer by layer."""
    layers, wavelength = named_layers(name), 500e-9
    look = window((64, 64), (1 / 128, 1 / 128), outer_scale)
    theta0, tau0 = layers.theta0(wavelength), layers.tau0(wavelength)
    for way in ((1.0, 0.0), (0.6, 0.8)):
        aside = [(h * theta0 * way[0], h * theta0 * way[1]) for h in layers.heights]
        later = [(-vx * tau0, -vy * tau0) for vx, vy in layers.winds]
        star = {"direction": (theta0 * way[0], theta0 * way[1])}
        for moves, views in ((aside, star), (later, {"delay": tau0})):
            parts = zip(layers.layer_r0(wavelength), moves, strict=True)
            found = sum(r0 ** (-5 / 3) * expected_difference(look, y, x) for r0, (x, y) in parts)
            exact = float(layers.structure_function(wavelength, outer_scale, **views))
            assert found == pytest.approx(1.0 if kolmogorov else exact, rel=0.03)
            assert (exact < 0.9) is not kolmogorov


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_phase_is_the_sum_of_its_waves(dtype):
    """FFT, matrix products and moves against the plain sum over all waves, for a window within a tile of every band."""
    look = window(dtype=dtype)
    screen = Screen(look, 0.1, seed=4)
    corner = (0.031, -0.073)  # (x, y)
    phase = screen.at(corner)
    assert phase.shape == (32, 40)
    assert phase.dtype == dtype
    rms = 0.1 ** (-5 / 6) * math.sqrt(sum(float(power.sum()) for _, _, power in wave_powers(look)))
    for row, column in [(0, 0), (31, 39), (7, 22)]:
        expected = 0.0
        for number, band in enumerate(look.bands):
            waves = torch.fft.rfft2(band.raster.draw(4, number, (0, 0)).double()) * band.amplitude.double()
            fy, fx = band.raster.frequencies()
            y = band.raster.lead[0] + corner[1] + 0.02 * row
            x = band.raster.lead[1] + corner[0] + 0.02 * column
            terms = waves * torch.exp(2j * math.pi * (fy[:, None] * y + fx * x)) * torch.where(fx > 0, 2, 1)
            expected += float(terms.real.sum())
        assert float(phase[row, column]) == pytest.approx(
            0.1 ** (-5 / 6) * expected, abs=30 * torch.finfo(dtype).eps * rms
        )


def test_single_precision_shows_the_same_screen():
    single, double = (
        Screen(window(dtype=dtype), 0.1, seed=1).at((0.3, 5.0)) for dtype in (torch.float32, torch.float64)
    )
    torch.testing.assert_close(single.double(), double, rtol=0, atol=3e-6 * float(double.abs().max()))


def test_a_place_keeps_its_phase_to_rounding_within_a_tile_and_nearly_beyond():
    """Whole samples, so that windows share some: in the same tiles, and where the first band has gone to the next one.

    Of its filter 1.5e-4 of the amplitude lie out of reach; the largest of a thousand such changes is below 4.5 of them.
    """
    screen = Screen(window(), 0.1, seed=2)
    start = screen.at((0.0, 0.0))
    for move in (1, 7, 16):  # tiles have at least 33 samples
        there = screen.at((0.02 * move, -0.02 * move))
        torch.testing.assert_close(there[move:, :-move], start[:-move, move:], rtol=0, atol=1e-10)
    rms = 0.1 ** (-5 / 6) * math.sqrt(float(next(wave_powers(screen.window))[2].sum()))
    for move in (18, 20, 22, 24, 26, 28, 30):
        there = screen.at((0.02 * move, -0.02 * move))
        change = float((there[move:, :-move] - start[:-move, move:]).abs().max()) / rms
        assert 0 < change < 4.5 * 1.5e-4
    assert torch.equal(screen.at((0.0, 0.0)), start)  # wherever one has looked meanwhile
    assert torch.equal(Screen(window(), 0.1, seed=2).at((0.0, 0.0)), start)


def test_noise_belongs_to_its_place():
    """Neighbouring windows share their tiles; seeds, bands and tiles differ; unit variance."""
    raster = window().bands[0].raster
    rows, columns = raster.size
    noise = raster.draw(7, 0, (-2, 5))
    assert noise.shape == raster.shape
    assert torch.equal(noise[rows:], raster.draw(7, 0, (-1, 5))[:-rows])
    assert torch.equal(noise[:, columns:], raster.draw(7, 0, (-2, 6))[:, :-columns])
    n = noise.numel()
    others = [raster.draw(8, 0, (-2, 5)), raster.draw(7, 1, (-2, 5)), raster.draw(7, 0, (-2 + raster.tiles, 5))]
    for other in [*others, noise.roll(rows, 0), noise.roll(columns, 1)]:
        assert abs(float((noise * other).mean())) < 4.5 / math.sqrt(n)
    assert abs(float(noise.mean())) < 4.5 / math.sqrt(n)
    assert abs(float(noise.var()) - 1) < 4.5 * math.sqrt(2 / n)


def test_there_is_no_end():
    """A thousand kilometres away, or on the other side, the screen is as good as here, and another one."""
    look = window(outer_scale=1.0)
    places = [(0.0, 0.0), (1e6, 0.0), (0.0, -1e6), (7.5, -3.2)]
    corners = torch.stack([torch.stack([Screen(look, 0.2, seed).at(p)[0, 0] for p in places]) for seed in range(100)])
    variance = float(von_karman_covariance(torch.zeros(1, dtype=torch.float64), 0.2, 1.0))
    measured = corners.T @ corners / 100 / variance
    assert float((measured - torch.eye(4)).abs().max()) < 4.5 * math.sqrt(2 / 100)  # 7 outer scales and more apart
