"""Columns of an OIFITS file in closed form: errors of phases, fields, dates and places."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import brentq
from scipy.special import j1

from torchmask.grid import ARCSEC, Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.oifits import save_oifits
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

fits = pytest.importorskip("astropy.io.fits")
Time = pytest.importorskip("astropy.time").Time

MASK = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]], 0.1, 1.0)
GRID = Grid.nyquist(MASK.extent, 550e-9, 48, 1.1)


@pytest.fixture
def written(tmp_path, expose_points):
    """Writes the file of a star with such a header, its fringes dimmed or not, and returns its tables."""

    def write(header, dimming=1.0):
        observation = Observation(expose_points(MASK, GRID, n_frames=2), MASK, GRID, 0.0, header=header)
        seen = frame_observables(observation)
        errors = 0.01 * torch.arange(1, 7, dtype=torch.float64)
        seen = replace(seen, visibilities=dimming * seen.visibilities, visibility_errors=errors)
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}.fits"
        save_oifits(path, seen, observation, bandwidth=1e-8)
        with fits.open(path) as hdus:
            return {hdu.name: (hdu.header.copy(), hdu.data.copy()) for hdu in hdus[1:]} | {"": (hdus[0].header, None)}

    return write


def test_the_phase_of_a_dim_fringe_has_the_larger_error(written):
    """Noise of rms e across a vector of length a turns it by e / a."""
    bright, dim = (written({}, dimming)["OI_VIS"][1] for dimming in (1.0, 0.25))
    for table in (bright, dim):
        expected = np.degrees(0.01 * np.arange(1, 7) / table["VISAMP"].ravel())
        np.testing.assert_allclose(table["VISPHIERR"].ravel(), expected, rtol=1e-12)
        np.testing.assert_allclose(table["VISAMPERR"].ravel(), 0.01 * np.arange(1, 7), rtol=1e-12)
    np.testing.assert_allclose(dim["VISAMP"], bright["VISAMP"] / 4, rtol=1e-12)


def test_the_field_is_as_wide_as_the_image_of_a_hole_at_half_its_maximum(written):
    """The standard knows the full width at half maximum; wavelength over diameter is 3 % less."""
    half = brentq(lambda x: (2 * j1(math.pi * x) / (math.pi * x)) ** 2 - 0.5, 0.1, 1.0)
    table = written({})["OI_ARRAY"][1]
    assert set(table["FOVTYPE"]) == {"FWHM"}
    np.testing.assert_allclose(table["FOV"], 2 * half * GRID.wavelength / 0.1 / ARCSEC, rtol=0.03)
    np.testing.assert_allclose(table["DIAMETER"], 0.1, rtol=1e-6)  # of single precision


def test_the_middle_of_the_exposures_is_preferred_to_their_beginning(written):
    dates = {"MJD-AVG": 59735.5, "MJD-OBS": 59735.25, "DATE-OBS": "2022-06-04"}
    for known, expected in ((dates, 59735.5), ({"MJD-OBS": 59735.25, "DATE-OBS": "2022-06-04"}, 59735.25)):
        tables = written(known)
        assert tables[""][0]["DATE-OBS"] == Time(expected, format="mjd").isot[:19]
        for name in ("OI_VIS", "OI_VIS2", "OI_T3"):
            np.testing.assert_allclose(tables[name][1]["MJD"], expected, rtol=0, atol=1e-9)
            assert tables[name][0]["DATE-OBS"] == "2022-06-05"


@pytest.mark.parametrize(
    ("header", "place"),
    [
        ({"CTYPE1": "LINEAR", "CTYPE2": "LINEAR", "CRVAL1": 7.0, "CRVAL2": 8.0}, (0.0, 0.0)),
        ({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 7.0, "CRVAL2": 8.0}, (7.0, 8.0)),
        (
            {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 7.0, "CRVAL2": 8.0, "RA": 9.0, "DEC": 10.0},
            (9.0, 10.0),
        ),
    ],
)
def test_the_place_of_the_target_is_taken_from_a_sky_only(written, header, place):
    table = written(header)["OI_TARGET"][1]
    assert (float(table["RAEP0"][0]), float(table["DECEP0"][0])) == place
