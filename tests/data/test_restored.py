"""A restored image as a FITS file: on the sky, with its errors, never half done."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from torchmask.data.observe import read_observation
from torchmask.data.restored import save_restored
from torchmask.grid import ARCSEC
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration.result import RestorationResult

fits = pytest.importorskip("astropy.io.fits")
wcs = pytest.importorskip("astropy.wcs")


@pytest.fixture
def mask():
    return SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


@pytest.fixture
def cube(fits_cube):
    """(3, 16, 20), a star on row 9, column 12."""
    return fits_cube


@pytest.fixture
def sky(sky_cards):
    return sky_cards(0.3, 0.02 * ARCSEC) | {"WCSAXES": 2}


def result_for(observation):
    n = len(observation.frames)
    values = {
        "object": torch.rand(observation.grid.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
        "extended_object": torch.ones(2, 2),
        "coefficients": torch.zeros(n, observation.aperture.n_subapertures, 6),
        "chi_square": torch.linspace(0.9, 1.3, n),
    }
    rest = {name: torch.ones(n) for name in ("transmission", "model", "residuals", "cost")}
    return RestorationResult(
        **values,
        **rest,
        prior="TotalVariation()",
        r0=math.nan,
        noise=2.5,
        converged=True,
        message="",
        n_evaluations=1,
        seconds=1.0,
    )


def test_restored_image_lies_where_the_frames_did_on_the_sky(tmp_path, write_fits, mask, cube, sky):
    path = write_fits("a.fits", cube, **sky, TARGNAME="AB Dor")
    observation = read_observation(path, mask, crop=8)
    result = result_for(observation)
    save_restored(tmp_path / "r.fits", result, observation, ["crop 8 pixels", "α " + "long " * 40])
    with fits.open(tmp_path / "r.fits", checksum=True) as hdus:
        assert np.array_equal(hdus[0].data, result.object)
        cards = hdus[0].header
    place = wcs.WCS(cards).pixel_to_world_values(4, 4)
    np.testing.assert_allclose(place, wcs.WCS(fits.getheader(path), naxis=2).pixel_to_world_values(12, 9))
    assert cards["BUNIT"] == "electron"
    assert cards["TARGNAME"] == "AB Dor"
    assert cards["CHISQ"] == pytest.approx(1.1)
    assert cards["CHISQMAX"] == pytest.approx(1.3)
    assert cards["NFRAMES"] == 3
    assert "R0" not in cards
    assert "SKY" not in cards  # as of version 0.1, which knew none
    assert "crop 8 pixels" in str(cards["HISTORY"])
    # it is itself an image that can be read
    again = read_observation(tmp_path / "r.fits", mask)
    assert torch.equal(again.frames[0], result.object)
    assert again.grid.pixel_scale == pytest.approx(observation.grid.pixel_scale, rel=1e-12)


@pytest.mark.parametrize(
    ("prior", "card"),
    [
        ("AdaptedVariation(weight=0.420453, bending=0.25, epsilon=0.01)",) * 2,
        ("Learned(\n  (net): Conv2d(1, 8)\n  name=α\n)", "Learned( (net): Conv2d(1, 8) name=? )"),
        ("Long(" + 30 * "number=1, " + ")",) * 2,
    ],
)
def test_any_prior_has_a_card(prior, card, tmp_path, write_fits, mask, cube):
    """Without a warning that something is cut off, which would fail here."""
    observation = read_observation(write_fits("a.fits", cube), mask, crop=8)
    save_restored(tmp_path / "r.fits", dataclasses.replace(result_for(observation), prior=prior), observation)
    assert fits.getheader(tmp_path / "r.fits")["PRIOR"] == card


def test_standard_deviations_are_an_extension(tmp_path, write_fits, mask, cube, sky):
    observation = read_observation(write_fits("a.fits", cube, **sky), mask, crop=8)
    result = dataclasses.replace(result_for(observation), object_std=torch.rand(8, 8, dtype=torch.float64))
    save_restored(tmp_path / "r.fits", result, observation)
    with fits.open(tmp_path / "r.fits", checksum=True) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "ERR"]
        assert np.array_equal(hdus["ERR"].data, result.object_std)
        assert hdus["ERR"].header["BUNIT"] == "electron"
        assert hdus["ERR"].header["CRVAL1"] == hdus[0].header["CRVAL1"]
    again = read_observation(tmp_path / "r.fits", mask)
    assert torch.equal(again.errors[0], result.object_std)


def test_nothing_is_overwritten_or_left_half_done(tmp_path, write_fits, mask, cube):
    observation = read_observation(write_fits("a.fits", cube), mask, crop=8)
    result = result_for(observation)
    (tmp_path / "r.fits").write_text("mine")
    with pytest.raises(ValueError, match=r"exists and is not overwritten"):
        save_restored(tmp_path / "r.fits", result, observation)
    assert (tmp_path / "r.fits").read_text() == "mine"
    with pytest.raises(ValueError, match=r"does not end in \.fits"):
        save_restored(tmp_path / "r.png", result, observation)
    other = read_observation(tmp_path / "a.fits", mask, crop=6)
    with pytest.raises(ValueError, match=r"object has shape \(8, 8\) and the frames \(6, 6\)"):
        save_restored(tmp_path / "s.fits", result, other)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.fits", "r.fits"]
