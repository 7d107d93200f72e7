"""The target beside a hot pixel, pixels that are just full, and what files have in common that differ."""

import math

import numpy as np
import pytest

from torchmask.data.observe import read_observation
from torchmask.grid import ARCSEC
from torchmask.optics.aperture import SparseAperture

pytest.importorskip("astropy")

MASK = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


def test_a_hot_pixel_is_not_the_target_of_frames_with_pixels_far_below_the_resolution(write_fits):
    """A star of a standard deviation of 4 pixels, half of wavelength / D, and a pixel 20 times as bright as its peak.

    Blurred by as much as the star is wide the pixel has 20 / (2 pi 4^2) = 0.2 of that peak, and the star half of it;
    blurred by one pixel they have 3 and 0.94.
    """
    rows, columns = np.indices((48, 48))
    frame = 1000 * np.exp(-((rows - 26) ** 2 + (columns - 18) ** 2) / (2 * 4.0**2))
    frame[10, 38] += 20_000
    scale = 550e-9 / MASK.extent / 8
    path = write_fits("a.fits", np.stack([frame, frame]), PIXELSCL=scale / ARCSEC)
    found = read_observation(path, MASK, crop=20)
    assert np.unravel_index(int(found.frames[0].argmax()), (20, 20)) == (10, 10)
    np.testing.assert_allclose(found.frames[0].numpy(), frame[16:36, 8:28], rtol=1e-12)


def test_the_readout_noise_of_several_files_is_the_root_of_its_mean_square_over_frames(write_fits, fits_cube):
    one, three = write_fits("a.fits", fits_cube[0], RDNOISE=1.0), write_fits("b.fits", fits_cube, RDNOISE=7.0)
    assert read_observation([one, three], MASK).readout_noise == pytest.approx(math.sqrt((1 + 3 * 49) / 4), rel=1e-12)


def test_the_exposure_time_of_several_files_is_the_mean_over_their_frames(write_fits, fits_cube):
    one, three = write_fits("a.fits", fits_cube[0], XPOSURE=10.0), write_fits("b.fits", fits_cube, XPOSURE=2.0)
    assert read_observation([one, three], MASK).header["XPOSURE"] == pytest.approx((10 + 3 * 2) / 4, rel=1e-12)
    unknown = write_fits("c.fits", fits_cube)
    assert "XPOSURE" not in read_observation([unknown, unknown], MASK).header


def test_a_pixel_of_exactly_the_full_value_is_saturated(write_fits, fits_cube):
    fits_cube[:, 4, 7] = 50_000.0
    fits_cube[:, 4, 8] = np.nextafter(np.float32(50_000), np.float32(0))
    fits_cube[:, 9, 12] = 40_000.0
    with pytest.warns(UserWarning, match="3 pixels in 3 frames are saturated"):
        found = read_observation(write_fits("a.fits", fits_cube, SATURATE=50_000.0), MASK)
    assert (~found.valid).nonzero().tolist() == [[0, 4, 7], [1, 4, 7], [2, 4, 7]]


def test_each_file_has_the_gain_of_its_own_header(write_fits, fits_cube):
    paths = [write_fits(f"{gain:g}.fits", fits_cube, BUNIT="adu", GAIN=gain) for gain in (2.0, 5.0)]
    found = read_observation(paths, MASK).frames
    np.testing.assert_allclose(found.numpy(), np.concatenate([2.0 * fits_cube, 5.0 * fits_cube]), rtol=1e-12)


@pytest.mark.parametrize(
    ("there", "lacking"),
    [("ERR", ["x.fits"]), ("RDNOISE", ["x.fits"]), ("RDNOISE", [f"{number}.fits" for number in range(6)])],
)
def test_noise_that_only_some_files_tell_is_not_used_and_the_others_are_named(write_fits, fits_cube, there, lacking):
    errors = [("ERR", np.full_like(fits_cube, 2.0))] if there == "ERR" else []
    has = write_fits("has.fits", fits_cube, extensions=errors, RDNOISE=3.0 if there == "RDNOISE" else None)
    others = [write_fits(name, fits_cube, RDNOISE=None) for name in lacking]
    named = ", ".join(lacking[:4]) + (" and others" if len(lacking) > 4 else "")
    with pytest.warns(UserWarning, match=rf"only 1 of {1 + len(lacking)} files have .*{there}.* as {named} have none"):
        found = read_observation([has, *others], MASK)
    assert found.errors is None
    assert found.readout_noise is None
    if there == "RDNOISE":
        assert read_observation([has, *others], MASK, readout_noise=2.0).readout_noise == 2.0
