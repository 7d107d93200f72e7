"""PSDs against their closed forms, and what they refuse."""

from __future__ import annotations

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.spectra import NoisePSD, PowerLawPSD, evaluate_psd, resample_psd


def grid(n_pixels: int | tuple[int, int] = 64) -> Grid:
    return Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=n_pixels)


@pytest.mark.parametrize("n_pixels", [64, 65, (48, 96)])
def test_power_law_is_its_formula_at_every_frequency(n_pixels: int | tuple[int, int]) -> None:
    here = grid(n_pixels)
    psd = PowerLawPSD(exponent=1.7, n_photons=1e5, knee=1 / 20)(here)
    rows, columns = here.shape
    assert psd.shape == here.shape
    for i in range(0, rows, 5):
        for j in range(0, columns, 7):
            nu_y = (i if 2 * i < rows else i - rows) / rows
            nu_x = (j if 2 * j < columns else j - columns) / columns
            expected = 1e10 * max(math.hypot(nu_y, nu_x) * 20, 1.0) ** -1.7
            assert float(psd[i, j]) == pytest.approx(expected, rel=1e-12)


def test_power_law_at_zero_frequency_is_the_squared_flux_on_every_grid() -> None:
    for n_pixels in (32, 33, 256):
        assert float(PowerLawPSD(1.5, 1e7)(grid(n_pixels))[0, 0]) == 1e14


def test_read_out_noise_counts_the_pixels_of_the_detector_not_those_of_the_frequency_grid() -> None:
    for n_frequencies in (32, 64):
        assert float(NoisePSD(1e5, 5.0, n_pixels=48**2)(grid(n_frequencies))[1, 2]) == 1e5 + 48**2 * 25
        assert float(NoisePSD(1e5, 5.0)(grid(n_frequencies))[1, 2]) == 1e5 + n_frequencies**2 * 25
    for wrong in (0, -4, 2.5):
        with pytest.raises(ValueError, match=f"n_pixels is {wrong}"):
            NoisePSD(1e5, 5.0, n_pixels=wrong)  # type: ignore[arg-type]


def test_exponent_zero_is_white() -> None:
    assert torch.equal(PowerLawPSD(0.0, 10.0)(grid()), torch.full((64, 64), 100.0, dtype=torch.float64))


def test_noise_adds_photon_and_readout_variance() -> None:
    psd = NoisePSD(n_photons=1e6, readout_noise=1.5)(grid((32, 64)))
    assert torch.equal(psd, torch.full((32, 64), 1e6 + 32 * 64 * 2.25, dtype=torch.float64))


def test_dtype_is_asked_for() -> None:
    for psd in (PowerLawPSD(1.5, 1e7), NoisePSD(1e7, 1.0)):
        single = psd(grid(), torch.float32)
        assert single.dtype == torch.float32
        # powf of float32: a rounding of the frequency is amplified by the exponent
        torch.testing.assert_close(single.double(), psd(grid()), rtol=1e-6, atol=0)


@pytest.mark.parametrize("bad", [0.0, -1.0, math.nan, math.inf])
def test_numbers_out_of_range_are_refused(bad: float) -> None:
    with pytest.raises(ValueError, match="n_photons"):
        PowerLawPSD(1.5, bad)
    with pytest.raises(ValueError, match="knee"):
        PowerLawPSD(1.5, 1.0, knee=bad)
    with pytest.raises(ValueError, match=r"knee is 3\.0: .* at most 0\.5, in cycles/pixel; .* 64 pixels it is 1/64"):
        PowerLawPSD(1.5, 1.0, knee=3.0)
    with pytest.raises(ValueError, match="n_photons"):
        NoisePSD(bad)
    if bad != 0:
        with pytest.raises(ValueError, match="exponent"):
            PowerLawPSD(bad, 1.0)
        with pytest.raises(ValueError, match="readout_noise"):
            NoisePSD(1.0, bad)


def test_any_tensor_or_callable_is_a_psd() -> None:
    row = torch.rand(1, 64)
    assert torch.equal(evaluate_psd(row, grid(), "psd"), row.double().expand(64, 64))
    assert torch.equal(evaluate_psd(torch.tensor(3.0), grid(), "psd"), torch.full((64, 64), 3.0, dtype=torch.float64))
    doubled = evaluate_psd(lambda g, dtype, device: 2 * NoisePSD(5.0)(g, dtype, device), grid(), "psd")
    assert torch.equal(doubled, torch.full((64, 64), 10.0, dtype=torch.float64))


def test_evaluation_is_a_copy() -> None:
    own = torch.ones(64, 64, dtype=torch.float64)
    evaluate_psd(own, grid(), "psd").zero_()
    assert bool((own == 1).all())


@pytest.mark.parametrize(
    ("psd", "error", "message"),
    [
        (torch.ones(63, 64), ValueError, "broadcast"),
        (torch.ones(2, 64, 64), ValueError, "broadcast"),
        (-torch.ones(64, 64), ValueError, "negative"),
        (torch.full((64, 64), math.nan), ValueError, "non-finite"),
        (torch.ones(64, 64, dtype=torch.complex64), TypeError, "real tensor"),
        (torch.ones(64, 64, dtype=torch.int64), TypeError, "real tensor"),
        (1.0, TypeError, "real tensor"),
        (lambda grid, dtype, device: 1.0, TypeError, "real tensor"),
    ],
)
def test_what_is_no_psd_is_refused_by_name(psd: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"some_psd .*{message}"):
        evaluate_psd(psd, grid(), "some_psd")  # type: ignore[arg-type]


def test_resampling_to_the_same_grid_and_of_white_noise_is_exact() -> None:
    psd = torch.rand(31, 48, dtype=torch.float64)
    assert torch.equal(resample_psd(psd, (31, 48)), psd)
    white = torch.full((64, 64), 0.1, dtype=torch.float64)
    assert torch.equal(resample_psd(white, (33, 96)), torch.full((33, 96), 0.1, dtype=torch.float64))


def test_resampling_keeps_common_frequencies_and_interpolates_the_rest() -> None:
    psd = torch.rand(64, 96, dtype=torch.float64)
    coarse = resample_psd(psd, (32, 32))
    torch.testing.assert_close(coarse, psd[::2, ::3], rtol=1e-12, atol=0)
    fine = resample_psd(psd, (128, 96))
    torch.testing.assert_close(fine[::2], psd, rtol=1e-12, atol=0)
    # half-way rows are means of their neighbours, across the border of the torus as well
    torch.testing.assert_close(fine[1::2], (psd + psd.roll(-1, 0)) / 2, rtol=1e-12, atol=0)


def test_resampled_smooth_psd_converges_quadratically() -> None:
    psd = PowerLawPSD(1.5, 1e3)

    def error(n_pixels: int) -> float:
        # beyond the knee, where the PSD is smooth
        target, given = psd(grid(30)), resample_psd(psd(grid(n_pixels)), (30, 30))
        return float((given / target - 1).abs()[2:15, 2:15].max())

    # the error of linear interpolation falls as the square of the spacing; the point moves within a cell as well
    assert error(128) < 0.01
    assert error(1024) < error(128) / 30
