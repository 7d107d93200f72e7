"""One pixel scale is taken of several, and sky coordinates, baselines and restored images are at that one."""

import dataclasses
import math
import warnings

import numpy as np
import pytest
import torch

from torchmask.data.observe import read_observation
from torchmask.data.restored import save_restored
from torchmask.grid import ARCSEC
from torchmask.interferometry.visibilities import sky_stations
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.sky import pixel_matrix
from torchmask.optics.sky_scale import cards_at, side_of
from torchmask.restoration.result import RestorationResult

fits = pytest.importorskip("astropy.io.fits")

SCALE = 0.02 * ARCSEC  # rad, which the fixture `write_fits` writes to PIXELSCL


@pytest.fixture
def mask():
    return SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


def result_for(observation):
    n = len(observation.frames)
    image = torch.rand(observation.grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    rest = {name: torch.ones(n) for name in ("transmission", "model", "residuals", "chi_square", "cost")}
    coefficients = torch.zeros(n, observation.aperture.n_subapertures, 6)
    return RestorationResult(
        image, torch.ones(2, 2), coefficients, **rest, prior="", r0=math.nan, noise=2.5, converged=True, message="",
        n_evaluations=1, seconds=1.0,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("stated", "carded", "given", "taken"),
    [
        (SCALE, 2 * SCALE, None, SCALE),  # PIXELSCL counts before CD
        (SCALE, 0.5 * SCALE, None, SCALE),
        (None, 2 * SCALE, SCALE, SCALE),  # and what is given before both
        (2 * SCALE, 2 * SCALE, SCALE, SCALE),
        (SCALE, 2 * SCALE, 2 * SCALE, 2 * SCALE),
    ],
)
def test_whatever_decides_the_pixel_scale_the_sky_has_it_too(
    tmp_path, write_fits, fits_cube, mask, sky_cards, sky_matrix, stated, carded, given, taken
):
    pixels = {"PIXELSCL": None if stated is None else stated / ARCSEC}
    path = write_fits("a.fits", fits_cube, **sky_cards(0.3, carded), **pixels)
    with pytest.warns(UserWarning, match=r"a\.fits: .* (100|50)\.0 % (more|less)"):
        seen = read_observation(path, mask, pixel_scale=given)
    assert seen.grid.pixel_scale == pytest.approx(taken, rel=1e-12)
    np.testing.assert_allclose(seen.sky_matrix, sky_matrix(0.3, taken), rtol=1e-9)
    # holes are as far from each other on the sky as on the pupil, so that baselines have their length
    lengths = torch.pdist(sky_stations(seen)), torch.pdist(mask.centers.detach().double())
    torch.testing.assert_close(*lengths, rtol=1e-9, atol=0)
    save_restored(tmp_path / "restored.fits", result_for(seen), seen)
    cards = fits.getheader(tmp_path / "restored.fits")
    assert cards["PIXELSCL"] == pytest.approx(taken / ARCSEC, rel=1e-12)
    np.testing.assert_allclose(pixel_matrix(cards), sky_matrix(0.3, taken), rtol=1e-9)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # it agrees with itself
        assert read_observation(tmp_path / "restored.fits", mask).grid == seen.grid


def test_a_grid_that_is_replaced_takes_the_sky_with_it(tmp_path, write_fits, fits_cube, mask, sky_cards, sky_matrix):
    seen = read_observation(write_fits("a.fits", fits_cube, **sky_cards(0.3, SCALE)), mask)
    seen = dataclasses.replace(seen, grid=dataclasses.replace(seen.grid, pixel_scale=3 * SCALE))
    np.testing.assert_allclose(seen.sky_matrix, sky_matrix(0.3, 3 * SCALE), rtol=1e-9)
    save_restored(tmp_path / "restored.fits", result_for(seen), seen)
    side = side_of(pixel_matrix(fits.getheader(tmp_path / "restored.fits")))
    assert side == pytest.approx(3 * SCALE, rel=1e-9)


def test_statements_that_differ_by_less_than_a_percent_are_no_contradiction(write_fits, fits_cube, mask, sky_cards):
    """Warnings are errors here."""
    path = write_fits("a.fits", fits_cube, **sky_cards(0.3, 1.009 * SCALE))
    for given, taken in ((None, SCALE), (1.001 * SCALE, 1.001 * SCALE)):
        seen = read_observation(path, mask, pixel_scale=given)
        assert side_of(pixel_matrix(seen.header)) == pytest.approx(taken, rel=1e-9)


def test_many_files_of_another_scale_are_told_in_one_line(write_fits, fits_cube, mask, sky_cards):
    paths = [write_fits(f"{name}.fits", fits_cube, **sky_cards(0.3, SCALE)) for name in "abc"]
    with pytest.warns(UserWarning, match=r"a\.fits \(and 2 other files\): .* given, 0\.03 arcsec, is taken") as told:
        read_observation(paths, mask, pixel_scale=1.5 * SCALE)
    assert len(told) == 1
    assert "PIXELSCL says 0.02 arcsec, 33.3 % less and the CD matrix or CDELT says 0.02 arcsec" in str(told[0].message)


def test_a_card_that_is_no_scale_is_no_contradiction_of_what_is_given(write_fits, fits_cube, mask):
    for name, value in (("negative", -1.0), ("text", "fine"), ("zero", 0.0)):
        path = write_fits(f"{name}.fits", fits_cube, PIXELSCL=value)
        assert read_observation(path, mask, pixel_scale=SCALE).grid.pixel_scale == SCALE


@pytest.mark.parametrize(
    "cards",
    [
        {"CDELT1": -2e-5, "CDELT2": 2e-5, "CROTA2": 30.0},
        {"CDELT1": -2e-5, "CDELT2": 2e-5, "PC1_1": 0.8, "PC1_2": -0.6, "PC2_1": 0.6, "PC2_2": 0.8},
        {"CD1_2": 2e-5, "CD2_1": 2e-5},
        {"CDELT1": 1.0, "CDELT2": 1.0, "CD1_1": -2e-5, "CD2_2": 2e-5},
    ],
)
def test_cards_of_every_kind_keep_their_orientation(cards):
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 3.0} | cards
    before, scaled = pixel_matrix(cards), cards_at(cards, SCALE)
    after = pixel_matrix(scaled)
    np.testing.assert_allclose(after / SCALE, before / side_of(before), rtol=1e-9, atol=1e-15)
    kept = {"CTYPE1", "CRPIX1", "CROTA2", "PC1_1"} & set(cards)
    assert {name: scaled[name] for name in kept} == {name: cards[name] for name in kept}
    assert cards_at(cards, side_of(before)) == cards
    assert cards_at({"OBJECT": "star"}, SCALE) == {"OBJECT": "star"}
