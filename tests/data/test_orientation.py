"""Frames of one stack must show the sky in one orientation: files that differ are refused, doubts are told."""

import math

import numpy as np
import pytest

from torchmask.data.observe import read_observation
from torchmask.grid import ARCSEC
from torchmask.optics.aperture import SparseAperture

fits = pytest.importorskip("astropy.io.fits")
wcs = pytest.importorskip("astropy.wcs")

# Half a resolution element of 550 nm through 1 m is 2.84 pixels of 0.02 arcsec. The corner of 16 x 20 pixels is 12.8
# away, so that it moves by as much in a turn of 12.7 degrees.
HALF_ELEMENT = 550e-9 / 1.0 / (0.02 * ARCSEC) / 2
LIMIT = 2 * math.degrees(math.asin(HALF_ELEMENT / 2 / (math.hypot(16, 20) / 2)))


@pytest.fixture
def mask():
    """Of an extent of 1 m."""
    return SparseAperture([[0.0, 0.4], [0.0, -0.4], [0.3, 0.0]], 0.2, 1.0)


@pytest.fixture
def files(write_fits, fits_cube, sky_cards):
    """Writes a file for each angle [rad], without sky coordinates for None."""

    def write(*angles):
        cards = [{} if angle is None else sky_cards(angle, 0.02 * ARCSEC) for angle in angles]
        return [write_fits(f"{number}.fits", fits_cube, **told) for number, told in enumerate(cards)]

    return write


def test_files_are_compared_although_the_first_has_no_sky_coordinates(files, mask):
    turned = r"mix orientations: the corner of .*3\.fits lies .* pixels from that of .*1\.fits"
    with pytest.raises(ValueError, match=turned):
        read_observation(files(None, 0.3, 0.3, 0.8), mask)


def test_sky_coordinates_are_those_of_the_first_file_that_has_some(files, mask):
    paths = files(None, 0.3, None, 0.3)
    told = (
        r"only 2 of 4 files have sky coordinates: those of 1\.fits are taken for all, so see that 0\.fits, 2\.fits lie"
    )
    with pytest.warns(UserWarning, match=told) as warned:
        seen = read_observation(paths, mask, crop=8)
    assert len(warned) == 1
    place = wcs.WCS(fits.Header(dict(seen.header))).pixel_to_world_values(4, 4)
    np.testing.assert_allclose(place, wcs.WCS(fits.getheader(paths[1]), naxis=2).pixel_to_world_values(12, 9))
    assert read_observation(paths[::2], mask).sky_matrix is None


def test_the_limit_of_a_turn_is_where_the_corner_moves_by_half_a_resolution_element(write_fits, fits_cube, mask):
    assert mask.extent == pytest.approx(1.0)
    for turn in (0.98 * LIMIT, 1.02 * LIMIT):
        paths = [
            write_fits(f"{turn:.0f}-{n}.fits", fits_cube, PARANG=179.0 + angle)
            for n, angle in enumerate((0.0, turn / 2, turn))
        ]
        if turn < LIMIT:
            assert len(read_observation(paths, mask).frames) == 9
        else:
            told = rf"parallactic angle \(PARANG\) changes by {turn:.1f} degrees .* up to {LIMIT:.1f} degrees"
            with pytest.warns(UserWarning, match=told):
                assert len(read_observation(paths, mask).frames) == 9


@pytest.mark.parametrize(
    ("cards", "turn"),
    [
        ([{"PARANG": -10.0}, {"PARANG": 30.0}], 40.0),
        ([{"PARANG": 170.0}, {"PARANG": -150.0}], 40.0),  # across half a turn
        ([{"PARANG": 350.0}, {"PARANG": 30.0}], 40.0),
        ([{"ESO TEL PARANG START": 5.0, "ESO TEL PARANG END": 45.0}], 40.0),
        ([{"ESO TEL PARANG START": n * 10.0, "ESO TEL PARANG END": n * 10 + 10.0} for n in range(4)], 40.0),
        ([{"PARANG": 5.0}], 0.0),
        ([{"PARANG": 5.0}, {}], 0.0),
        ([{"PARANG": "unavailable"}, {"PARANG": 90.0}], 0.0),
        ([{}, {}], 0.0),
    ],
)
def test_a_field_that_turns_is_told_and_joined_all_the_same(write_fits, fits_cube, mask, cards, turn):
    told = [{f"HIERARCH {key}" if " " in key else key: value for key, value in own.items()} for own in cards]
    paths = [write_fits(f"{number}.fits", fits_cube, **own) for number, own in enumerate(told)]
    if not turn:
        assert len(read_observation(paths, mask).frames) == 3 * len(paths)
        return
    with pytest.warns(UserWarning, match=rf"changes by {turn:.1f} degrees among these frames: unless a derotator"):
        assert len(read_observation(paths, mask).frames) == 3 * len(paths)
