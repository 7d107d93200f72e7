"""Observations from FITS files: units, pixels, calibration, crops, selection, lists, and the real exposures."""

import math
import warnings

import numpy as np
import pytest
import torch

from torchmask.data.calibration import frame_drift
from torchmask.data.observe import read_observation
from torchmask.grid import ARCSEC, Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.sky import pixel_matrix

fits = pytest.importorskip("astropy.io.fits")
units = pytest.importorskip("astropy.units")
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


def test_a_cube_arrives_as_it_is(write_fits, mask, cube):
    observation = read_observation(write_fits("a.fits", cube), mask)
    assert torch.equal(observation.frames, torch.from_numpy(cube).double())
    assert observation.grid == Grid((16, 20), 0.02 * ARCSEC, 550e-9)
    assert observation.readout_noise == 3.0
    assert observation.valid is not None
    assert observation.valid.all()
    assert observation.errors is None
    assert observation.aperture is mask


def test_options_stand_for_missing_cards_and_win_over_present_ones(write_fits, mask, cube):
    options = {"wavelength": 2e-6, "pixel_scale": 1e-7, "readout_noise": 0.5, "gain": 2.0, "unit": "adu"}
    bare = dict.fromkeys(("PIXELSCL", "WAVELEN", "BUNIT", "RDNOISE"))
    for name, cards in (("bare.fits", bare), ("full.fits", {"GAIN": 7.0})):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", r".*full\.fits: the pixel scale that is given")
            observation = read_observation(write_fits(name, cube, **cards), mask, **options)
        assert observation.grid == Grid((16, 20), 1e-7, 2e-6)
        assert observation.readout_noise == 0.5
        assert torch.equal(observation.frames, 2 * torch.from_numpy(cube).double())


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"wavelength": 550.0}, ValueError, "wavelength is 550: .* 550 nm are 550e-9"),
        (
            {"pixel_scale": 0.02},
            ValueError,
            r"pixel_scale is 0\.02: it must be an angle .* 0\.02 arcsec are 9\.696e-08",
        ),
        ({"wavelength": 550 * units.nm}, TypeError, r"wavelength has the unit nm: .* give wavelength\.to_value\('m'\)"),
        ({"pixel_scale": 0.02 * units.arcsec}, TypeError, r"give pixel_scale\.to_value\('rad'\)"),
        ({"gain": 1.6 * units.electron / units.adu}, TypeError, r"give gain\.value"),
        ({"readout_noise": 3 * units.electron}, TypeError, r"give readout_noise\.to_value\('electron'\)"),
        ({"unit": units.electron}, TypeError, "unit is a .*: it must be text, such as 'electron'"),
    ],
)
def test_numbers_in_other_units_and_with_units_are_refused(write_fits, mask, cube, options, error, message):
    with pytest.raises(error, match=message):
        read_observation(write_fits("a.fits", cube), mask, **options)


def test_the_masks_wavelength_counts_where_the_header_tells_none(write_fits, mask, cube):
    bare, known = write_fits("bare.fits", cube, WAVELEN=None), write_fits("known.fits", cube)
    assert read_observation(bare, mask, design_wavelength=2e-6).grid.wavelength == 2e-6
    assert read_observation(known, mask, design_wavelength=2e-6).grid.wavelength == 550e-9
    assert read_observation(bare, mask, wavelength=1e-6, design_wavelength=2e-6).grid.wavelength == 1e-6


def test_units_time_and_filter_come_from_the_header(write_fits, mask, cube):
    cards = {"BUNIT": "DN/s", "GAIN": 1.6, "XPOSURE": 10.0, "WAVELEN": None, "INSTRUME": "NIRISS", "FILTER": "F380M"}
    observation = read_observation(write_fits("a.fits", cube, **cards), mask)
    torch.testing.assert_close(observation.frames, 16 * torch.from_numpy(cube).double(), rtol=1e-12, atol=0)
    assert observation.grid.wavelength == 3.828e-6
    assert observation.header["XPOSURE"] == 10.0
    with pytest.raises(ValueError, match=r"a\.fits: unit 'parsec' is unknown|b\.fits: unit 'parsec' is unknown"):
        read_observation(write_fits("b.fits", cube, BUNIT="parsec"), mask)


def test_the_time_of_one_integration_counts_for_a_cube_of_jwst(write_fits, mask, cube):
    cards = {"BUNIT": "electron/s", "XPOSURE": 30.0, "EFFINTTM": 10.0}
    one = read_observation(write_fits("a.fits", cube[0], **cards), mask).frames
    three = read_observation(write_fits("b.fits", cube, **cards), mask).frames
    torch.testing.assert_close(one[0], 3 * three[0])


def test_errors_are_in_electrons_and_bad_pixels_are_not_valid(write_fits, mask, cube):
    quality = np.zeros((16, 20), dtype=np.int32)
    quality[2, 3] = 1
    cube[1, 6, 7] = np.nan
    extensions = [("ERR", np.full(cube.shape, 0.5, dtype=np.float32)), ("DQ", quality)]
    observation = read_observation(
        write_fits("a.fits", cube, extensions=extensions, sci=True, BUNIT="adu", GAIN=2.0), mask
    )
    assert observation.errors is not None
    assert (observation.errors == 1.0).all()  # half an adu
    assert (~observation.valid).nonzero().tolist() == [[0, 2, 3], [1, 2, 3], [1, 6, 7], [2, 2, 3]]
    assert torch.isfinite(observation.frames).all()
    dead = write_fits("b.fits", cube, extensions=[("DQ", np.ones((16, 20), dtype=np.int16))], sci=True)
    with pytest.raises(ValueError, match=r"frames \[0, 1, 2\] have no valid pixel"):
        read_observation(dead, mask)


@pytest.mark.parametrize(
    ("cards", "given"),
    [
        ({"SATURATE": 1e5}, {}),
        ({"FULLWELL": 2e5}, {}),
        ({}, {"saturation": 1e5}),
        ({"SATURATE": 1.0}, {"saturation": 1e5}),
    ],
)
def test_saturated_pixels_carry_no_weight_and_are_counted(write_fits, mask, cube, cards, given):
    """The star's pixel alone is above 1e5 adu, of 2 electrons; the dark that is taken off does not hide it."""
    path = write_fits("a.fits", cube, BUNIT="adu", GAIN=2.0, **cards)
    with pytest.warns(UserWarning, match=r"a\.fits: 3 pixels in 3 frames are saturated \(100000 or more\)"):
        seen = read_observation(path, mask, dark=np.full((16, 20), 90.0), **given)
    assert (~seen.valid).nonzero().tolist() == [[0, 9, 12], [1, 9, 12], [2, 9, 12]]


def test_a_camera_that_cuts_off_at_a_value_that_no_header_tells_is_noticed_before_calibration(write_fits, mask):
    """12 bits in a file of 16: after division by a flat the pixels at 4095 would be unequal."""
    generator = np.random.default_rng(0)
    axis = np.arange(32) - 16
    light = 6000 * np.exp(-(axis[:, None] ** 2 + axis**2) / 50)
    counts = np.minimum(generator.poisson(light, (4, 32, 32)), 4095)
    path = write_fits("a.fits", counts.astype(np.int16), BUNIT="adu", GAIN=2.0)
    flat = generator.uniform(0.9, 1.1, (32, 32))
    n = int((counts == 4095).sum())
    said = rf"a\.fits: {n} pixels in 4 frames are saturated \(4095 at which they pile up\) and ignored"
    with pytest.warns(UserWarning, match=said):
        seen = read_observation(path, mask, flat=flat)
    assert np.array_equal(~seen.valid.numpy(), counts == 4095)
    # hot pixels that a map marks may hold more
    bad = np.zeros((32, 32), dtype=int)
    bad[3, 4] = 1
    counts[:, 3, 4] = 30000
    hot = write_fits("b.fits", counts.astype(np.int16), BUNIT="adu", GAIN=2.0)
    with pytest.warns(UserWarning, match="saturated"):
        seen = read_observation(hot, mask, flat=flat, bad_pixels=bad)
    assert np.array_equal(~seen.valid.numpy(), counts >= 4095)
    # a few pixels in each of several files pile up, too
    some = np.minimum(generator.poisson(4200 * light / 6000, (6, 32, 32)), 4095)
    assert (some == 4095).sum((1, 2)).max() < 9
    files = [write_fits(f"{k}.fits", one.astype(np.int16), BUNIT="adu", GAIN=2.0) for k, one in enumerate(some)]
    with pytest.warns(UserWarning, match="saturated"):
        seen = read_observation(files, mask, flat=flat)
    assert np.array_equal(~seen.valid.numpy(), some == 4095)


def test_darks_among_the_files_are_left_out_and_alone_are_refused(write_fits, mask, cube):
    light, dark = write_fits("light.fits", cube), write_fits("dark.fits", cube[0] / 50, IMAGETYP="DARK")
    with pytest.warns(
        UserWarning, match=r"files without light are left out \(.*dark\.fits: IMAGETYP is 'DARK'\); to subtract a dark"
    ):
        seen = read_observation([light, dark, light], mask, skip=[1, 3, 5])
    assert seen.frame_numbers == (0, 2, 4, 6)  # 3 is the dark's
    assert torch.equal(seen.frames, torch.from_numpy(cube[[0, 2, 0, 2]]))
    with pytest.raises(ValueError, match=r"no file holds light \(.*dark\.fits: IMAGETYP is 'DARK'\): give exposures"):
        read_observation(dark, mask)


def test_frames_are_skipped_by_number_and_the_best_are_kept_of_the_others(write_fits, mask, cube):
    cube[1] *= 3
    cube[2] *= 2
    path = write_fits("a.fits", cube)
    best = read_observation([path], mask, skip=[1], keep=0.5, keep_by="flux").frames
    assert torch.equal(best, torch.from_numpy(cube[2:]).double())
    with pytest.raises(ValueError, match="skip names frame 3, but the stack has 3"):
        read_observation(path, mask, skip=[3])


def test_negative_frames_are_left_out_with_a_notice(write_fits, mask, cube):
    path = write_fits("a.fits", np.concatenate([-cube[:1], cube]), extensions=[("ERR", np.ones((4, 16, 20)))])
    with pytest.warns(UserWarning, match=r"frames \[0\] hold no light"):
        seen = read_observation(path, mask)
    assert torch.equal(seen.frames, torch.from_numpy(cube).double())
    assert seen.errors.shape == seen.valid.shape == seen.frames.shape


def test_calibration_files_and_arrays_are_applied(write_fits, mask, cube):
    """Dark as an array, flat as a file, bad pixels as a tensor; of a cube the median counts."""
    rng = np.random.default_rng(0)
    dark, flat = rng.uniform(10, 20, (16, 20)), rng.uniform(0.5, 1.5, (16, 20))
    bad = torch.zeros(16, 20)
    bad[3, 4] = 1
    flat /= np.median(flat[bad.numpy() == 0])
    darks = np.stack([dark - 1, dark, dark + 100])
    flats = write_fits("flat.fits", 37 * flat)
    errors = ("ERR", np.ones(cube.shape))
    path = write_fits("a.fits", cube * flat + dark, extensions=[errors], sci=True)
    observation = read_observation(path, mask, dark=darks, flat=flats, bad_pixels=bad)
    np.testing.assert_allclose(observation.frames, cube, rtol=1e-12)
    np.testing.assert_allclose(observation.errors, np.broadcast_to(1 / flat, cube.shape), rtol=1e-12)
    assert (~observation.valid).nonzero().tolist() == [[0, 3, 4], [1, 3, 4], [2, 3, 4]]


def test_a_dark_of_another_exposure_time_warns(write_fits, mask, cube):
    frames = write_fits("a.fits", cube, EXPTIME=0.02)
    darks = [write_fits(f"dark{time}.fits", cube[0] / 50, EXPTIME=time) for time in (0.05, 0.0201, 0.0, None)]
    for dark, seconds in ((darks[0], "0.05"), (darks[2], "0")):
        said = rf"the dark .*{dark.name} was exposed for {seconds} s and the frames of .*a\.fits for 0\.02 s"
        with pytest.warns(UserWarning, match=said) as warned:
            read_observation([frames, frames], mask, dark=dark, flat=darks[0])
        assert len(warned) == 1
    with warnings.catch_warnings(action="error"):
        for alike in (darks[1], darks[3]):
            read_observation(frames, mask, dark=alike)
        read_observation(frames, mask, dark=darks[0], exposure_time=0.05)
        read_observation(write_fits("bare.fits", cube), mask, dark=darks[0])
        read_observation(write_fits("rate.fits", cube, EXPTIME=0.02, BUNIT="electron/s"), mask, dark=darks[0])


def test_a_dark_of_another_shape_is_refused(write_fits, mask, cube):
    with pytest.raises(ValueError, match=r"a\.fits: dark has shape \(16, 16\): it must be.*\(16, 20\)"):
        read_observation(write_fits("a.fits", cube), mask, dark=np.zeros((16, 16)))


@pytest.mark.parametrize("crop", [6, 7, 12])
def test_crop_puts_the_target_in_the_middle_and_the_sky_stays(write_fits, mask, cube, sky, crop):
    path = write_fits("a.fits", cube, **sky)
    whole, field = read_observation(path, mask), read_observation(path, mask, crop=crop)
    assert field.grid.shape == (crop, crop)
    first = (9 - crop // 2, 12 - crop // 2)
    window = (slice(first[0], first[0] + crop), slice(first[1], first[1] + crop))
    assert torch.equal(field.frames, whole.frames[:, *window])
    before = wcs.WCS(dict(whole.header)).pixel_to_world_values(12, 9)
    after = wcs.WCS(dict(field.header)).pixel_to_world_values(crop // 2, crop // 2)
    np.testing.assert_allclose(after, before, rtol=1e-14)


def test_each_file_is_cropped_around_its_own_star(write_fits, mask, cube, sky):
    moved = np.roll(cube, (-2, 3), (1, 2))
    paths = [write_fits("a.fits", cube, **sky), write_fits("b.fits", moved[:2], **sky)]
    frames = read_observation(paths, mask, crop=6).frames
    assert frames.shape == (5, 6, 6)
    assert torch.equal(frames[:2], frames[3:])
    given = read_observation(paths, mask, crop=6, target=(8, 8)).frames
    assert torch.equal(given[4], torch.from_numpy(moved[1, 5:11, 5:11]).double())


def test_a_crop_that_does_not_fit_says_what_does(write_fits, mask, cube):
    path = write_fits("a.fits", cube)
    with pytest.raises(ValueError, match=r"a\.fits: crop is 15.*row 9, column 12.*leaves at most 14"):
        read_observation(path, mask, crop=15)
    read_observation(path, mask, crop=14)


def test_selection_keeps_the_best_frames(write_fits, mask, cube):
    cube[1] *= 3
    path = write_fits("a.fits", cube)
    assert torch.equal(
        read_observation(path, mask, keep=0.34, keep_by="flux").frames[0], torch.from_numpy(cube[1]).double()
    )
    two = read_observation(path, mask, keep=0.67, keep_by="flux")
    assert torch.equal(two.frames, torch.from_numpy(cube[1:]).double())  # in their order in time
    assert two.valid.shape == two.frames.shape


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": 0.0}, r"keep is 0.0"),
        ({"target": (900, 3)}, r"target is \(900, 3\).*give crop \[pixels\] too"),
        ({"keep": 1.5}, r"keep is 1.5"),
        ({"keep_by": "luck"}, r"keep_by is 'luck'"),
        ({"keep_by": "flux"}, r"keep_by is 'flux', but all frames are kept: give keep, the fraction of the best, too"),
        ({"crop": 1}, r"crop is 1"),
        ({"wavelength": -1.0}, r"wavelength is -1.0"),
        ({"gain": math.nan}, r"gain is nan"),
        ({"readout_noise": -0.1}, r"readout_noise is -0.1"),
    ],
)
def test_options_are_checked_before_any_file_is_opened(mask, options, message):
    with pytest.raises(ValueError, match=message):
        read_observation("nowhere.fits", mask, **options)


@pytest.mark.parametrize(
    ("cards", "size", "message"),
    [
        ({"FILTER": "F430M"}, 20, r"mix filters: .*a\.fits has F480M and .*b\.fits F430M"),
        ({"WAVELEN": 551e-9 * 1.001}, 20, r"mix wavelengths: .*5\.5e-07 m"),
        ({"PIXELSCL": 0.021}, 20, r"mix pixel scales: .*0\.02 arcsec and .*0\.021 arcsec"),
        ({}, 19, r"mix image shapes: .*\(16, 20\) and .*\(16, 19\)"),
    ],
)
def test_a_list_of_unlike_files_is_refused(write_fits, mask, cube, cards, size, message):
    first = write_fits("a.fits", cube, FILTER="F480M")
    second = write_fits("b.fits", cube[..., :size], **{"FILTER": "F480M"} | cards)
    with pytest.raises(ValueError, match=message):
        read_observation([first, second], mask)
    with pytest.raises(ValueError, match=r"paths is empty"):
        read_observation([], mask)


def test_files_that_are_turned_are_refused_when_a_corner_moves_by_half_a_pixel(write_fits, mask, cube, sky_cards):
    """A corner ten pixels away along x and y moves by ten times the angle along either."""
    first = write_fits("a.fits", cube, **sky_cards(0.3, 0.02 * ARCSEC))
    for name, angle in (("little.fits", 0.3 + 0.03), ("mirrored.fits", 0.3), ("much.fits", 0.3 + 0.06)):
        second = write_fits(name, cube, **sky_cards(angle, 0.02 * ARCSEC, mirrored=name == "mirrored.fits"))
        if name == "little.fits":
            assert len(read_observation([first, second], mask).frames) == 6
        else:
            with pytest.raises(ValueError, match=r"mix orientations: the corner of .* lies .* pixels from that of"):
                read_observation([first, second], mask)


def test_an_observation_that_was_read_survives_its_own_file(tmp_path, write_fits, mask, cube, sky):
    extensions = [("ERR", cube / 10), ("DQ", np.eye(16, 20, dtype=np.int16))]
    path = write_fits("a.fits", cube, extensions=extensions, sci=True, **sky, RDNOISE=None)
    observation = read_observation(path, mask)
    observation.save(tmp_path / "a.npz")
    back = Observation.load(tmp_path / "a.npz")
    assert back.readout_noise is None
    assert back.header == observation.header
    assert back.header["CRPIX1"] == 5.0
    assert torch.equal(back.valid, observation.valid)
    assert torch.equal(back.errors, observation.errors)
    assert torch.equal(back.frames, observation.frames)


@pytest.mark.filterwarnings("ignore:.*which is taken, but:UserWarning")  # where damage changes one of two scales
def test_no_damage_brings_anything_but_one_line(tmp_path, write_fits, mask, cube, sky):
    """Bytes of headers and data changed at random, or the end cut off: read, or refused with a ValueError."""
    extensions = [("ERR", cube / 10), ("DQ", np.eye(16, 20, dtype=np.int16))]
    cards = sky | {"BUNIT": "adu", "GAIN": 2.0, "OBJECT": "x"}
    good = write_fits("good.fits", cube, extensions=extensions, sci=True, **cards).read_bytes()
    rng = np.random.default_rng(0)
    refusals = []
    for _ in range(80):
        damaged = np.frombuffer(good, dtype=np.uint8).copy()
        places = rng.integers(0, 3 * 2880, rng.integers(1, 6))
        damaged[places] = rng.integers(32, 127, len(places))
        if rng.random() < 0.3:
            damaged = damaged[: rng.integers(len(damaged))]
        (tmp_path / "bad.fits").write_bytes(damaged.tobytes())
        try:
            read_observation(tmp_path / "bad.fits", mask, crop=6)
        except ValueError as error:
            refusals.append(str(error))
    assert all("bad.fits" in message and "\n" not in message for message in refusals)
    assert 20 < len(refusals) < 75


def test_niriss_exposures_of_ab_dor(niriss):
    paths = sorted(niriss.glob("ab-dor*.fits"))
    mask = SparseAperture.from_catalog("jwst_niriss_ami_7")
    with pytest.raises(ValueError, match=r"no GAIN or EGAIN, which its unit DN/s needs: give gain"):
        read_observation(paths, mask)
    observation = read_observation(paths, mask, gain=1.62, crop=40)
    assert observation.frames.shape == (9, 40, 40)
    assert observation.grid.wavelength == 4.817e-6
    # JWST user documentation: 0.0653 x 0.0658 arcsec
    assert observation.grid.pixel_scale / ARCSEC == pytest.approx(math.sqrt(0.0653 * 0.0658), rel=2e-3)
    # the star stands on the middle pixel of every exposure, wherever it was
    assert {divmod(int(frame.argmax()), 40) for frame in observation.frames} == {(20, 20)}
    with fits.open(paths[0]) as hdus:
        assert float(observation.frames[0].max()) == pytest.approx(
            1.62 * hdus["SCI"].header["XPOSURE"] * float(hdus["SCI"].data.max()), rel=1e-6
        )
        matrix = pixel_matrix(hdus["SCI"].header)
        pointing = [fits.getheader(path, "SCI") for path in paths]
    assert observation.header["CRPIX1"] == 21.0
    assert observation.valid is not None
    assert 0.98 < float(observation.valid.double().mean()) < 1
    # Against the telescope's own pointing, good to some milliarcseconds (0.05 pixels): where the sky position of the
    # reference pixel moved, the star moved the other way; whole pixels were taken off by the crop.
    drift = frame_drift(observation.frames.numpy(), observation.valid.numpy())
    stars = [divmod(int(fits.getdata(path, "SCI").argmax()), 80)[::-1] for path in paths]
    assert len(set(stars)) == 2
    sky = np.array([[header["CRVAL1"], header["CRVAL2"]] for header in pointing])
    tangent = np.radians(sky - sky[0]) * [math.cos(math.radians(sky[0, 1])), 1.0]
    expected = -(tangent @ np.linalg.inv(matrix).T) - (np.array(stars) - stars[0])
    np.testing.assert_allclose(drift, expected, atol=0.1)
    assert np.abs(expected).max() > 0.1
