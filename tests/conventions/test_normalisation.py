"""Unit sums, origins and power spectra. docs/conventions.md, "Normalisations"."""

import math

import pytest
import torch

import torchmask as tm
from torchmask.optics.otf import analytic_otf

GRID = tm.Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
MASK = tm.SparseAperture([[0.0, 0.35], [0.3, -0.2], [-0.3, -0.2]], 0.25, 1.0)


def random_phase(layer):
    generator = torch.Generator().manual_seed(0)
    return torch.randn(5, *layer.samples().weights.shape, generator=generator, dtype=torch.float64)


def test_psfs_have_unit_sum_and_their_origin_at_the_first_pixel():
    layer = tm.PSF(MASK, GRID, oversampling=2)
    torch.testing.assert_close(layer(random_phase(layer)).sum((-2, -1)), torch.ones(5, dtype=torch.float64))
    assert int(layer().argmax()) == 0


def test_otfs_are_unshifted_dfts_of_psfs_with_value_1_at_zero_frequency():
    otf, psf = tm.OTF(MASK, GRID, oversampling=2), tm.PSF(MASK, GRID, oversampling=2)
    phase = random_phase(otf)
    transfer = otf(phase)
    torch.testing.assert_close(transfer, torch.fft.fft2(psf(phase)))
    torch.testing.assert_close(transfer[:, 0, 0], torch.ones(5, dtype=torch.complex128))


def test_the_closed_form_has_the_same_normalisation():
    transfer = analytic_otf(MASK, GRID)
    assert complex(transfer[0, 0]) == pytest.approx(1.0, abs=1e-12)
    assert float((transfer - tm.OTF(MASK, GRID, oversampling=8)()).abs().max()) < 0.6 / 64  # samples across a hole: 64


def test_frequencies_are_in_fft_order():
    for size in (63, 64):
        nu_y, nu_x = tm.Grid(size, 1e-7, 550e-9).frequencies(torch.float64)
        expected = torch.fft.fftfreq(size, dtype=torch.float64)
        assert torch.equal(nu_y[:, 0], expected)
        assert torch.equal(nu_x[0], expected)
        assert float(nu_x[0, 0]) == 0
        assert float(nu_x.min()) >= -0.5
        assert float(nu_x.max()) < 0.5


def test_psds_are_those_of_an_unnormalised_dft():
    """S_o(0) is the square of the photons whatever the grid; white noise has the sum of the pixels' variances."""
    photons, readout_noise = 1e6, 3.0
    for size in (32, 48):
        grid = tm.Grid.nyquist(1.0, 550e-9, size)
        scene = tm.make_scene(grid.shape, photons, dtype=torch.float64)
        measured = float(torch.fft.fft2(scene)[0, 0].abs() ** 2)
        assert float(tm.PowerLawPSD(1.5, photons)(grid)[0, 0]) == pytest.approx(measured, rel=1e-12)
        expected = tm.NoisePSD(photons, readout_noise)(grid)
        assert float(expected.std()) == 0
        generator = torch.Generator().manual_seed(size)
        flat = torch.full((400, size, size), photons / size**2, dtype=torch.float64)
        noise = tm.Detector(readout_noise)(flat, generator) - flat
        power = (torch.fft.fft2(noise).abs() ** 2).mean()
        # one exponential variable for each pair of frequencies: five standard errors of their mean
        assert float(power) == pytest.approx(float(expected[0, 0]), rel=5 * math.sqrt(2 / (400 * size**2)))


def test_the_object_spectrum_is_flat_below_its_knee_and_falls_as_its_exponent():
    psd = tm.PowerLawPSD(exponent=2.0, n_photons=10.0, knee=1 / 16)(GRID)
    assert float(psd[0, 4]) == pytest.approx(100.0)  # at the knee, 4/64
    assert float(psd[0, 8]) == pytest.approx(25.0)  # twice as far, a quarter
    assert float(psd[8, 0]) == float(psd[0, 8]) == float(psd[0, -8])


def test_relative_mse_is_1_for_a_restoration_of_nothing():
    blind = tm.AsymptoticMSE(GRID, tm.PowerLawPSD(1.5, 1.0), tm.NoisePSD(1e12), n_frames=1)
    assert float(blind.relative(MASK)) == pytest.approx(1.0, abs=1e-9)
    seeing = tm.AsymptoticMSE(GRID, tm.PowerLawPSD(1.5, 1e9), tm.NoisePSD(1e-9), n_frames=1)
    floor = seeing.relative_floor(MASK.mask_diameter)
    assert floor < float(seeing.relative(MASK)) < 1


def test_tv_is_isotropic_and_its_corner_is_rounded_by_epsilon():
    from torchmask.restoration.variation import TotalVariation

    image = torch.zeros(8, 8, dtype=torch.float64)
    image[3, 4] = 2.0
    # one diagonal step (2, 2), and one step of 2 to each of the pixels above and to the left
    expected = math.sqrt(8 + 1e-4) + 2 * math.sqrt(4 + 1e-4) - 3e-2
    assert float(TotalVariation()(image)) == pytest.approx(expected, rel=1e-12)
