"""Transmission curves, by name, of files and even; photons by AB magnitude and the light of black bodies."""

import math

import numpy as np
import pytest
from astropy import constants, units
from astropy.modeling.physical_models import BlackBody
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import trapezoid
from speclite import filters

from torchmask.optics.band import Band
from torchmask.optics.passband import VEGA_IN_AB, Passband


@pytest.mark.parametrize("name", ["bessell-V", "sdss2010-r", "panstarrs-y"])
def test_photons_of_magnitude_zero_are_speclites(name):
    curve = filters.load_filter(name)
    theirs = curve.convolve_with_function(filters.ab_reference_flux, photon_weighted=True)
    # its trapezoids on samples h apart differ from the exact integral by about h^2 / 12 of the relative second
    # derivative of the integrand, 2 / wavelength^2 where the response is straight
    error = float((np.diff(curve.wavelength).max() / curve.wavelength.min()) ** 2)
    assert Passband.find(name).ab_photons == pytest.approx(theirs.to_value("1 / (s m2)"), rel=max(error, 1e-6))


@pytest.mark.parametrize(
    ("band", "flux", "width", "wavelength"),
    [("J", 3.129e-13, 0.1624, 1.235), ("H", 1.133e-13, 0.2509, 1.662), ("Ks", 4.283e-14, 0.2619, 2.159)],
)
def test_2mass_bands_pass_the_photons_of_vega(band, flux, width, wavelength):
    """Cohen, Wheaton & Megeath, Astron. J. 126, 1090 (2003), table 2: W / (cm^2 um) at magnitude 0, um and um.

    Zero points are known to 2 %, and Vega in AB is quoted to 0.01 mag.
    """
    name = f"twomass-{band}"
    photons = 1e4 * flux * width * wavelength * 1e-6 / (constants.h * constants.c).value
    assert Passband.find(name).ab_photons * 10 ** (-0.4 * VEGA_IN_AB[name]) == pytest.approx(photons, rel=0.03)


@pytest.mark.parametrize(
    ("band", "flux"), [("U", 1.790), ("B", 4.063), ("V", 3.636), ("R", 3.064), ("I", 2.416), ("J", 1.589), ("H", 1.021)]
)
def test_magnitudes_of_vega_are_those_of_its_flux(band, flux):
    """Bessell, Castelli & Plez, Astron. Astrophys. 333, 231 (1998), table A2: 1e-20 erg / (s cm^2 Hz) at magnitude 0.

    Their zero points and those of Blanton & Roweis differ by 0.03 mag, as do the bands of 2MASS and theirs.
    """
    name = f"bessell-{band}" if band in "UBVRI" else f"twomass-{band}"
    assert VEGA_IN_AB[name] == pytest.approx(-2.5 * math.log10(1e-20 * flux) - 48.6, abs=0.04)


def test_an_even_band_passes_the_photons_of_the_closed_form():
    photons = 3631e-26 / constants.h.value * math.log(600 / 500)
    assert Passband.top_hat(550e-9, 100e-9).ab_photons == pytest.approx(photons, rel=1e-9)


def test_any_spectrum_of_one_magnitude_passes_as_many_photons():
    """Against speclite, whose magnitude of a black body is turned into photons by hand."""
    curve, wavelengths = filters.load_filter("bessell-R"), np.arange(5000, 9500, 1.0) * units.AA
    body = BlackBody(4000 * units.K, scale=1e-20 * units.Unit("erg / (s cm2 AA sr)"))(wavelengths) * units.sr
    magnitude = curve.get_ab_magnitude(body.to(filters.default_flux_unit), wavelengths)
    energy = wavelengths * 1e-10 / units.AA * units.m
    through = np.interp(wavelengths.value, curve.wavelength, curve.response)
    rate = (body * through * energy / (constants.h * constants.c)).to("1 / (s m2 AA)").value.sum()
    assert rate == pytest.approx(10 ** (-0.4 * magnitude) * Passband.find("bessell-R").ab_photons, rel=1e-3)


@given(st.floats(2000, 20000), st.floats(4e-7, 3e-6), st.floats(0.01, 0.5))
def test_light_of_a_black_body_is_plancks(temperature, wavelength, width):
    x, light = Passband.top_hat(wavelength, width * wavelength).light(temperature)
    radiance = BlackBody(temperature * units.K, scale=1 * units.Unit("W / (m2 m sr)"))(x * units.m).value * x
    np.testing.assert_allclose(light, radiance / radiance.max(), rtol=2e-6)  # constants of other years


def test_an_uneven_curve_has_the_mean_and_the_photons_of_its_integrals():
    """Straight from 0.2 to 1 within 20 nm, and to 0.1 within 80 nm; integrals by trapezoids of a thousandth of a nm."""
    passband = Passband((500e-9, 520e-9, 600e-9), (0.2, 1.0, 0.1))
    x = np.linspace(500e-9, 600e-9, 100_001)
    passed = np.interp(x, passband.wavelengths, passband.transmission)
    # the error of trapezoids is that of the curvature over their width, 1e-5 of the band, squared
    mean = trapezoid(passed * x, x) / trapezoid(passed, x)
    assert passband.mean_wavelength == pytest.approx(mean, rel=1e-9)
    assert passband.mean_wavelength == pytest.approx(1e-9 * (12 * 512.2222 + 44 * 549.0909) / 56, rel=1e-6)
    photons = 3631e-26 / constants.h.value * trapezoid(passed / x, x)
    assert passband.ab_photons == pytest.approx(photons, rel=1e-9)


@pytest.mark.parametrize("name", ["bessell-V", "decam2014-g"])
def test_the_mean_wavelength_is_that_of_the_band(name):
    passband, band = Passband.find(name), Band.from_filter(name, 4)
    assert passband.mean_wavelength == pytest.approx(np.dot(band.wavelengths, band.shares), rel=1e-12)
    hot = Band.from_filter(passband, 4, temperature=20000)
    assert np.dot(hot.wavelengths, hot.shares) < passband.mean_wavelength


def test_a_file_is_the_curve_that_it_holds(tmp_path):
    path = tmp_path / "filter.csv"
    path.write_text("# wavelength, transmission\n5e-7, 0\n5.5e-7, 0.9\n6e-7, 0\n")
    assert Passband.find(path) == Passband((5e-7, 5.5e-7, 6e-7), (0.0, 0.9, 0.0))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("5000 1\n6000 1\n", r"in m: multiply nm by 1e-9, Angstrom by 1e-10"),
        ("5e-7 1 1\n6e-7 1 1\n", "3 columns"),
        ("6e-7 1\n5e-7 1\n", "increasing"),
        ("5e-7 0\n5.5e-7 93\n6e-7 0\n", "transmission reaches 93: .* at most 1; is it in percent.* divide by 100"),
        ("wavelength transmission\n5e-7 1\n", "holds no transmission curve"),
    ],
)
def test_files_that_hold_no_curve_say_why(tmp_path, text, said):
    path = tmp_path / "filter.txt"
    path.write_text(text)
    with pytest.raises(ValueError, match=said):
        Passband.find(path)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("missing.txt", "there is no file missing.txt"),
        ("bessell-Q", "of bessell they are bessell-U, bessell-B, bessell-V"),
        ("V", "GROUP-BAND, such as bessell-V, with the groups .*bessell.*twomass"),
    ],
)
def test_unknown_names_list_those_that_are_known(name, said):
    with pytest.raises(ValueError, match=said):
        Passband.find(name)


@pytest.mark.parametrize("temperature", [0.0, -1.0, math.nan])
def test_impossible_temperatures_are_refused(temperature):
    with pytest.raises(ValueError, match="in K"):
        Passband.top_hat(5e-7, 1e-8).light(temperature)
