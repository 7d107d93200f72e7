"""What the cards of a header mean: pixel scale, wavelength, time, units."""

import math
import warnings

import pytest

from torchmask.data.keywords import (
    closed_shutter,
    electrons_per_unit,
    exposure_seconds,
    kept_cards,
    number,
    pixel_response,
    pixel_scale,
    saturation,
    shift_cards,
    wavelength,
)
from torchmask.grid import ARCSEC
from torchmask.optics.pixel import SquarePixel

pytest.importorskip("astropy")

SCALE = 0.02  # arcsec
UNITS = {  # one of these in electrons, at 1.6 electrons per adu, 10 s, 0.25 MJy/sr per DN/s
    "electron": 1,
    "ELECTRONS": 1,
    "e-": 1,
    "photon": 1,
    "adu": 1.6,
    "ADU": 1.6,
    "DN": 1.6,
    "counts": 1.6,
    "DN/s": 16,
    "ELECTRONS/S": 10,
    "e-/s": 10,
    "electron / ms": 1e4,
    "count/sec": 16,
    "MJy/sr": 64,
    "kJy/sr": 6.4e-2,
    "250 electron": 250,
    "": 1.6,
}


def electrons(header, is_cube=False, unit=None, gain=None, exposure_time=None):
    return electrons_per_unit(header, "a.fits", is_cube, unit, gain, exposure_time)


@pytest.mark.parametrize(
    "cards",
    [
        {"CDELT1": -SCALE / 3600, "CDELT2": SCALE / 3600, "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"},
        {"CDELT1": SCALE, "CDELT2": SCALE, "CUNIT1": "arcsec", "CUNIT2": "arcsec"},
        {"CDELT1": SCALE * ARCSEC, "CDELT2": SCALE * ARCSEC, "CUNIT1": "rad", "CUNIT2": "rad"},
        {"PIXSCALE": SCALE},
        {"PIXELSCL": SCALE, "CDELT1": 1.009 * SCALE, "CDELT2": SCALE, "CUNIT1": "arcsec", "CUNIT2": "arcsec"},
    ],
)
def test_every_way_to_state_the_pixel_scale(cards):
    assert pixel_scale(cards, "a.fits", None) == pytest.approx(SCALE * math.pi / 180 / 3600, rel=1e-12)
    assert pixel_scale(cards, "a.fits", 1e-7) == 1e-7


def test_a_matrix_of_cards_states_the_pixel_scale(sky_cards):
    cards = sky_cards(0.3, SCALE * ARCSEC)
    assert pixel_scale(cards, "a.fits", None) == pytest.approx(SCALE * ARCSEC, rel=1e-12)
    with pytest.raises(ValueError, match=r"a\.fits: pixels of .* arcsec are not square"):
        pixel_scale(cards | {"CD1_1": 2 * cards["CD1_1"]}, "a.fits", None)


@pytest.mark.parametrize("name", ["PIXELSCL", "PIXSCALE"])
def test_a_card_that_contradicts_the_matrix_wins_with_a_warning_of_both(sky_cards, name):
    cards = sky_cards(0.3, 1.02 * SCALE * ARCSEC) | {name: SCALE}
    with pytest.warns(UserWarning, match=rf"a\.fits: {name} is 0\.02 arcsec, which is taken, but .* says 0\.0204"):
        assert pixel_scale(cards, "a.fits", None) == pytest.approx(SCALE * ARCSEC, rel=1e-12)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert pixel_scale(cards, "a.fits", 1e-7) == 1e-7  # what is given decides
        pixel_scale(cards | {name: 1.013 * SCALE}, "a.fits", None)


@pytest.mark.parametrize(
    "cards", [{}, {"CDELT1": 1.0, "CDELT2": 1.0}, {"CDELT1": 1.0, "CDELT2": 1.0, "CUNIT1": "mm", "CUNIT2": "mm"}]
)
def test_a_scale_that_is_no_angle_is_no_pixel_scale(cards):
    with pytest.raises(ValueError, match=r"a\.fits has no PIXELSCL, CDELT or CD matrix.*give pixel_scale \[rad\]"):
        pixel_scale(cards, "a.fits", None)


def test_the_wavelength_is_that_of_its_card_or_of_the_filter():
    cards = {"INSTRUME": "NIRISS", "FILTER": "F380M"}
    assert pixel_response(cards) == SquarePixel(1.0)
    assert pixel_response({"INSTRUME": "MY CAMERA"}) is pixel_response({}) is None
    assert wavelength(cards, "a.fits", None) == 3.828e-6
    assert wavelength(cards | {"WAVELEN": 3.8e-6}, "a.fits", None) == 3.8e-6
    assert wavelength(cards | {"WAVELEN": 3.8e-6}, "a.fits", 1e-6) == 1e-6
    with pytest.raises(ValueError, match=r"no WAVELEN.*give wavelength \[m\] \(FILTER is 'V'.*NIRISS F480M"):
        wavelength(cards | {"FILTER": "V"}, "a.fits", None)


@pytest.mark.parametrize("name", ["WAVELEN", "WAVELNTH"])
def test_a_wavelength_in_nanometres_is_refused_by_the_name_of_its_card(name):
    with pytest.raises(ValueError, match=rf"a\.fits: {name} is 550: .* 550 nm are 550e-9; correct it, or give wave"):
        wavelength({name: 550.0}, "a.fits", None)


@pytest.mark.parametrize(("unit", "factor"), UNITS.items())
def test_units_become_electrons(unit, factor):
    cards = {"GAIN": 1.6, "XPOSURE": 10.0, "PHOTMJSR": 0.25}
    assert electrons(cards | {"BUNIT": unit}) == pytest.approx(factor, rel=1e-12)
    assert electrons(cards | {"BUNIT": "parsec"}, unit=unit or "adu") == pytest.approx(factor, rel=1e-12)


def test_what_is_given_wins_over_the_header():
    cards = {"BUNIT": "DN/s", "GAIN": 1.6, "XPOSURE": 10.0}
    assert electrons(cards, gain=2.0, exposure_time=3.0) == pytest.approx(6.0)


@pytest.mark.parametrize("unit", ["electron", "photon/s"])
def test_a_gain_that_would_be_ignored_is_refused(unit):
    with pytest.raises(ValueError, match=f"gain is 3, in electrons per adu, but the unit of a.fits is {unit}: leave"):
        electrons_per_unit({"BUNIT": unit}, "a.fits", False, None, 3.0, 1.0)
    assert electrons_per_unit({"BUNIT": unit, "GAIN": 3.0}, "a.fits", False, None, None, 1.0) == 1  # of the camera


def test_pixels_without_a_unit_are_never_taken_for_electrons():
    for cards in ({}, {"GAIN": 0.0}):
        with pytest.raises(
            ValueError, match=r"no BUNIT and no GAIN: give gain \[.*\]; if pixels are not in adu, give unit"
        ):
            electrons(cards)
    assert electrons({}, unit="electron") == 1.0
    assert electrons({}, gain=2.5) == 2.5


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ({"BUNIT": "adu"}, r"no GAIN or EGAIN, which its unit adu needs: give gain"),
        ({"BUNIT": "electron/s"}, r"no XPOSURE or EXPTIME, which its unit electron/s needs: give exposure_time \[s\]"),
        ({"BUNIT": "MJy/sr"}, r"no PHOTMJSR.*give unit"),
        ({"BUNIT": "parsec"}, r"unit 'parsec' is unknown: give unit as electron"),
        ({"BUNIT": "gobbledygook"}, r"unit 'gobbledygook' is unknown: give unit"),
        ({"GAIN": -1.0}, r"GAIN is -1.0"),
        ({"GAIN": "high"}, r"GAIN is 'high'"),
    ],
)
def test_cards_that_are_missing_or_wrong_are_named(cards, message):
    with pytest.raises(ValueError, match=message) as caught:
        electrons({"BUNIT": "electron"} | cards)
    assert "a.fits" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_time_of_one_integration_counts_for_a_cube_of_jwst():
    cards = {"XPOSURE": 30.0, "EFFINTTM": 10.0}
    assert exposure_seconds(cards, "a.fits", is_cube=False, given=None) == 30.0
    assert exposure_seconds(cards, "a.fits", is_cube=True, given=None) == 10.0
    assert exposure_seconds(cards, "a.fits", is_cube=True, given=2.0) == 2.0
    assert exposure_seconds({}, "a.fits", is_cube=True, given=None) is None


@pytest.mark.parametrize("value", [True, "3", math.inf, -2.0])
def test_a_number_is_a_number(value):
    assert number({"B": 2}, ("A", "B"), "a.fits") == 2.0
    with pytest.raises(ValueError, match=r"a\.fits: A is .*, which is not a positive number"):
        number({"A": value, "B": 2}, ("A", "B"), "a.fits")


def test_cards_that_are_kept_are_of_the_sky_and_the_target(sky_cards):
    sky = sky_cards(0.3, 1e-7)
    header = sky | {"WCSAXES": 3, "CTYPE3": "TIME", "OBJECT": "star", "FILTER": "V", "NAXIS": 3, "HISTORY": "long"}
    assert kept_cards(header) == sky | {"WCSAXES": 2, "OBJECT": "star", "FILTER": "V"}


def test_shifted_cards_leave_the_originals_alone(sky_cards):
    cards = sky_cards(0.3, 1e-7)
    moved = shift_cards(cards, 3, 4)
    assert (moved.pop("CRPIX1"), moved.pop("CRPIX2")) == (2.0, 5.0)
    assert moved == {name: value for name, value in cards.items() if not name.startswith("CRPIX")}
    assert cards == sky_cards(0.3, 1e-7)
    assert shift_cards({}, 3, 4) == {}


@pytest.mark.parametrize(
    ("cards", "level"),
    [
        ({}, None),
        ({"SATURATE": 60000.0}, 60000.0),
        ({"FULLWELL": 80000}, 50000.0),  # electrons, at 1.6 for each adu
        ({"FULLWELL": 80000, "SATURATE": 40000}, 40000.0),
        ({"SATURATE": 0}, None),
    ],
)
def test_a_pixel_is_full_at_the_lower_of_converter_and_well(cards, level):
    assert saturation(cards, "a.fits", 1.6, None) == level
    assert saturation(cards, "a.fits", 1.6, 1000.0) == 1000.0


@pytest.mark.parametrize(
    ("cards", "closed"),
    [
        ({"IMAGETYP": "Dark Frame"}, True),
        ({"IMAGETYP": "bias"}, True),
        ({"OBSTYPE": "ZERO"}, True),
        ({"EXP_TYPE": "NIS_DARK"}, True),
        ({"ESO DPR TYPE": "DARK"}, True),
        ({"SHUTTER": "CLOSED"}, True),
        ({"SHUTTER": "open", "IMAGETYP": "Light Frame"}, False),
        ({"EXP_TYPE": "NIS_AMI", "OBJECT": "Dark Nebula"}, False),
        ({}, False),
    ],
)
def test_darks_and_closed_shutters_are_known_by_their_cards(cards, closed):
    said = closed_shutter(cards)
    assert (said is not None) == closed
    assert said is None or any(name in said and value in said for name, value in cards.items())
