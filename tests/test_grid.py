import math
import re

import numpy as np
import pytest
import torch
from scipy.special import jn_zeros

from torchmask.grid import Grid


def test_nyquist_places_the_cutoff_at_half_a_cycle():
    grid = Grid.nyquist(diameter=2.0, wavelength=1e-6, n_pixels=64)
    assert grid.cutoff(2.0) == pytest.approx(0.5, rel=1e-15)
    assert grid.period == pytest.approx(4.0, rel=1e-15)
    grid.require_sampling(2.0)


def test_oversampling_divides_the_pixel():
    coarse, fine = (Grid.nyquist(1.0, 550e-9, 64, q) for q in (1.0, 2.5))
    assert fine.pixel_scale == pytest.approx(coarse.pixel_scale / 2.5, rel=1e-15)


@pytest.mark.parametrize("n_pixels", [7, 8, (6, 9)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_frequencies_are_those_of_the_dft(n_pixels, dtype):
    grid = Grid(n_pixels, 1e-7, 550e-9)
    nu_y, nu_x = grid.frequencies(dtype)
    assert (nu_y.shape, nu_x.shape) == ((grid.shape[0], 1), (1, grid.shape[1]))
    assert nu_y.dtype == nu_x.dtype == dtype
    # A plane wave at frequency (k_y, k_x) has its whole energy in that bin.
    y, x = torch.arange(grid.shape[0])[:, None], torch.arange(grid.shape[1])
    wave = torch.exp(2j * math.pi * (nu_y[2, 0] * y + nu_x[0, -1] * x))
    spectrum = torch.fft.fft2(wave).abs()
    assert int(spectrum.argmax()) == 2 * grid.shape[1] + grid.shape[1] - 1


def test_undersampling_is_refused_with_a_pixel_scale_that_is_accepted():
    for diameter in (2.0, 1.7, 3.3333):
        with pytest.raises(ValueError, match="pixel_scale must be at most") as refusal:
            Grid(64, 2.75e-7, 550e-9).require_sampling(diameter)
        needed, arcsec = re.findall(r"at most (\S+) rad \((\S+) arcsec\)", str(refusal.value))[0]
        for accepted in (float(needed), float(arcsec) * math.pi / 180 / 3600):
            assert accepted == pytest.approx(550e-9 / (2 * diameter), rel=1.5e-4)
            Grid(64, accepted, 550e-9).require_sampling(diameter)


def test_numbers_of_numpy_and_torch_become_plain_ones():
    plain = Grid((64, 48), 2.75e-7, 550e-9)
    frames = torch.zeros(3, 64, 48)
    for n_pixels in (frames.shape[1:], [np.int64(64), np.int32(48)]):
        grid = Grid(n_pixels, np.float64(2.75e-7), torch.tensor(550e-9, dtype=torch.float64))
        assert (grid, hash(grid), repr(grid)) == (plain, hash(plain), repr(plain))
    assert type(Grid(np.int64(64), np.float32(2.75e-7), 550e-9).period) is float


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((1, 1e-7, 1e-6), "n_pixels"),
        ((12.5, 1e-7, 1e-6), "n_pixels"),
        (((8, 8, 8), 1e-7, 1e-6), "n_pixels"),
        (((), 1e-7, 1e-6), "n_pixels"),
        ((8, 0.0, 1e-6), "pixel_scale"),
        ((8, math.nan, 1e-6), "pixel_scale"),
        ((8, 1e-7, -1e-6), "wavelength"),
        ((8, 1e-7, math.inf), "wavelength"),
    ],
)
def test_impossible_numbers_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        Grid(*arguments)


@pytest.mark.parametrize(("diameter", "oversampling"), [(0.0, 1.0), (math.nan, 1.0), (1.0, 0.9), (1.0, math.inf)])
def test_nyquist_refuses_impossible_numbers(diameter, oversampling):
    with pytest.raises(ValueError, match=r"diameter|oversampling"):
        Grid.nyquist(diameter, 1e-6, 64, oversampling)


@pytest.mark.parametrize(("wavelength", "meant"), [(550.0, "550 nm are 550e-9"), (2.2, "2.2 micrometres are 2.2e-6")])
def test_nyquist_refuses_a_wavelength_in_another_unit(wavelength, meant):
    with pytest.raises(
        ValueError, match=f"wavelength is {wavelength:g}: it must be a wavelength of light in m.*{meant}"
    ):
        Grid.nyquist(1.0, wavelength, 48)


def rows_of(table):
    return {row.split(" | ")[0].removeprefix("| "): row for row in table.splitlines()}


def test_the_table_says_what_is_nyquist_and_what_aliases():
    diameter, hole = 1.25, 0.03
    critical = rows_of(Grid.nyquist(diameter, 1e-6, (64, 48)).describe(diameter, hole))
    assert "2 pixels" in critical["wavelength / diameter"]
    assert "0.5 cycles/pixel | at most 1/2: nothing aliases" in critical["cut-off frequency"]
    assert f"{diameter} m" in critical["largest aperture without aliasing"]
    assert "64 x 48 pixels" in critical["field"]
    # period 2.5 m: rows of 2.5 / 64 m, columns of 2.5 / 48 m, and 0.576 of the coarser across a hole
    assert "0.03906 x 0.05208 m" in critical["one pupil sample"]
    assert "0.576 | below 2: oversample by 4" in critical["samples across a hole"]
    dark = 2 * float(jn_zeros(1, 1)[0]) / math.pi * 2.5 / hole  # across the first dark ring of the Airy pattern
    assert f"{dark:.4g}" == "203.3"
    assert "| 203.3 |" in critical["pixels across the image of a hole"]
    # A quarter wider than Nyquist allows: frequency 1 - 0.625 is where the folded spectrum begins.
    aliased = rows_of(Grid.nyquist(diameter / 1.25, 1e-6, 64).describe(diameter))
    assert "0.625 cycles/pixel | above 1/2: frequencies beyond 0.375" in aliased["cut-off frequency"]
    assert "hole" not in aliased


def test_the_table_agrees_with_what_is_refused():
    grid = Grid(64, 2.75e-7, 550e-9)
    for diameter in (0.5, 1.0, 1.0 + 1e-12, 1.001, 4.0):
        try:
            grid.require_sampling(diameter)
            refused = False
        except ValueError:
            refused = True
        assert ("aliased light" in grid.describe(diameter)) == refused
    for arguments in ((0.0,), (math.inf,), (1.0, -0.1)):
        with pytest.raises(ValueError, match="finite and positive, in m"):
            grid.describe(*arguments)


def test_takes_whole_numbers_that_arithmetic_made():
    assert Grid((64.0, np.float64(32)), 1e-7, 5e-7) == Grid((64, 32), 1e-7, 5e-7)
    with pytest.raises(ValueError, match=r"n_pixels is 64\.5"):
        Grid(64.5, 1e-7, 5e-7)
