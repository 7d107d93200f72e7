"""Which card counts where a header has several that could, and from when on pixels are not square."""

import math

import pytest

from torchmask.data.keywords import electrons_per_unit, pixel_scale, wavelength
from torchmask.grid import ARCSEC

pytest.importorskip("astropy")


def test_egain_counts_before_gain():
    """Cameras write to GAIN the number of a setting, and to EGAIN what it is in electrons."""
    cards = {"EGAIN": 0.25, "GAIN": 120, "BUNIT": "adu"}
    assert electrons_per_unit(cards, "a.fits", False, None, None, None) == 0.25
    assert electrons_per_unit(cards, "a.fits", False, None, 1.6, None) == 1.6


def test_pixels_that_differ_by_a_percent_are_square_of_the_same_area_and_by_three_are_not():
    def cards(ratio):
        return {"CDELT1": -0.02 * ratio, "CDELT2": 0.02, "CUNIT1": "arcsec", "CUNIT2": "arcsec"}

    assert pixel_scale(cards(1.01), "a.fits", None) == pytest.approx(0.02 * ARCSEC * math.sqrt(1.01), rel=1e-12)
    with pytest.raises(ValueError, match=r"pixels of 0\.0206 x 0\.02 arcsec are not square"):
        pixel_scale(cards(1.03), "a.fits", None)


def test_what_the_header_tells_counts_before_the_mask_and_the_plan():
    told = {"INSTRUME": "NIRISS", "FILTER": "F380M", "PIXELSCL": 0.065}
    assert wavelength(told, "a.fits", None, 4.8e-6) == 3.828e-6
    assert wavelength(told | {"WAVELEN": 3.8e-6}, "a.fits", None, 4.8e-6) == 3.8e-6
    assert wavelength({}, "a.fits", None, 4.8e-6) == 4.8e-6
    assert pixel_scale(told, "a.fits", None, 1e-7) == pytest.approx(0.065 * ARCSEC, rel=1e-12)
    assert pixel_scale({}, "a.fits", None, 1e-7) == 1e-7
