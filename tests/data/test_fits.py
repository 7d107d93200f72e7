"""FITS in and out: headers, units, calibration, cropping, selection, what is refused, and the real observations."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.data.calibration import calibrate, crop_corner, find_target, frame_drift, frame_sharpness
from torchmask.data.keywords import shift_cards
from torchmask.data.observe import read_observation
from torchmask.data.restored import save_restored
from torchmask.grid import ARCSEC, Grid
from torchmask.observation import Observation, pixel_matrix
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.psf import PSF
from torchmask.restoration.result import RestorationResult

fits = pytest.importorskip("astropy.io.fits")
wcs = pytest.importorskip("astropy.wcs")

SCALE = 0.02  # arcsec
HEADER = {"PIXELSCL": SCALE, "WAVELEN": 550e-9, "BUNIT": "electron", "RDNOISE": 3.0}
SKY = {
    "WCSAXES": 2,
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CUNIT1": "deg",
    "CUNIT2": "deg",
    "CRPIX1": 5.0,
    "CRPIX2": 9.0,
    "CRVAL1": 82.0,
    "CRVAL2": -65.0,
    "CD1_1": -SCALE / 3600 * math.cos(0.3),
    "CD1_2": SCALE / 3600 * math.sin(0.3),
    "CD2_1": SCALE / 3600 * math.sin(0.3),
    "CD2_2": SCALE / 3600 * math.cos(0.3),
}


@pytest.fixture
def mask():
    return SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.2, 1.0)


@pytest.fixture
def cube():
    """(3, 16, 20): no two pixels alike, a star on row 9, column 12."""
    frames = np.arange(3 * 16 * 20, dtype=np.float32).reshape(3, 16, 20) + 100
    frames[:, 9, 12] += 1e5
    return frames


def write(path, data, header=None, extensions=(), name=None, **more):
    cards = fits.Header()
    for key, value in ((HEADER if header is None else header) | more).items():
        if value is not None:
            cards[key] = value
    hdus = [fits.PrimaryHDU(data, header=cards)]
    if name is not None:
        hdus = [fits.PrimaryHDU(header=cards), fits.ImageHDU(data, name=name)]
    hdus += [fits.ImageHDU(values, name=extension) for extension, values in extensions]
    fits.HDUList(hdus).writeto(path)
    return path


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


# --- the header


def test_a_cube_arrives_as_it_is(tmp_path, mask, cube):
    observation = read_observation(write(tmp_path / "a.fits", cube), mask)
    assert torch.equal(observation.frames, torch.from_numpy(cube).double())
    assert observation.grid == Grid((16, 20), SCALE * ARCSEC, 550e-9)
    assert observation.readout_noise == 3.0
    assert observation.valid is not None
    assert observation.valid.all()
    assert observation.errors is None
    assert observation.aperture is mask


def test_options_stand_for_missing_cards_and_win_over_present_ones(tmp_path, mask, cube):
    options = {"wavelength": 2e-6, "pixel_scale": 1e-7, "readout_noise": 0.5, "gain": 2.0, "unit": "adu"}
    for name, header in (("bare.fits", {}), ("full.fits", HEADER | {"GAIN": 7.0})):
        observation = read_observation(write(tmp_path / name, cube, header), mask, **options)
        assert observation.grid == Grid((16, 20), 1e-7, 2e-6)
        assert observation.readout_noise == 0.5
        assert torch.equal(observation.frames, 2 * torch.from_numpy(cube).double())


@pytest.mark.parametrize(
    "cards",
    [
        {"CDELT1": -SCALE / 3600, "CDELT2": SCALE / 3600, "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"},
        {"CDELT1": SCALE, "CDELT2": SCALE, "CUNIT1": "arcsec", "CUNIT2": "arcsec"},
        {"CDELT1": SCALE * ARCSEC, "CDELT2": SCALE * ARCSEC, "CUNIT1": "rad", "CUNIT2": "rad"},
        {"PIXSCALE": SCALE},
        SKY,
    ],
)
def test_every_way_to_state_the_pixel_scale(tmp_path, mask, cube, cards):
    header = {name: value for name, value in HEADER.items() if name != "PIXELSCL"} | cards
    observation = read_observation(write(tmp_path / "a.fits", cube, header), mask)
    assert observation.grid.pixel_scale == pytest.approx(SCALE * math.pi / 180 / 3600, rel=1e-12)


@pytest.mark.parametrize(
    "cards", [{}, {"CDELT1": 1.0, "CDELT2": 1.0}, {"CDELT1": 1.0, "CDELT2": 1.0, "CUNIT1": "mm", "CUNIT2": "mm"}]
)
def test_a_scale_that_is_no_angle_is_no_pixel_scale(tmp_path, mask, cube, cards):
    header = {name: value for name, value in HEADER.items() if name != "PIXELSCL"} | cards
    with pytest.raises(ValueError, match=r"a\.fits has no PIXELSCL, CDELT or CD matrix.*give pixel_scale \[rad\]"):
        read_observation(write(tmp_path / "a.fits", cube, header), mask)


def test_the_filter_tells_the_wavelength(tmp_path, mask, cube):
    header = HEADER | {"WAVELEN": None, "INSTRUME": "NIRISS", "FILTER": "F380M"}
    assert read_observation(write(tmp_path / "a.fits", cube, header), mask).grid.wavelength == 3.828e-6
    with pytest.raises(ValueError, match=r"no WAVELEN.*give wavelength \[m\] \(FILTER is 'V'.*NIRISS F480M"):
        read_observation(write(tmp_path / "b.fits", cube, header | {"FILTER": "V"}), mask)


@pytest.mark.parametrize(
    ("unit", "factor"),
    [
        ("electron", 1),
        ("ELECTRONS", 1),
        ("e-", 1),
        ("photon", 1),
        ("adu", 1.6),
        ("ADU", 1.6),
        ("DN", 1.6),
        ("counts", 1.6),
        ("DN/s", 16),
        ("ELECTRONS/S", 10),
        ("e-/s", 10),
        ("electron / ms", 1e4),
        ("count/sec", 16),
        ("MJy/sr", 64),
        ("kJy/sr", 6.4e-2),
        ("", 1.6),
    ],
)
def test_units_become_electrons(tmp_path, mask, cube, unit, factor):
    # GAIN 1.6 electrons per adu, 10 s, 0.25 MJy/sr per DN/s
    path = write(tmp_path / "a.fits", cube, BUNIT=unit, GAIN=1.6, XPOSURE=10.0, PHOTMJSR=0.25)
    frames = read_observation(path, mask).frames
    torch.testing.assert_close(frames, factor * torch.from_numpy(cube).double(), rtol=1e-12, atol=0)


def test_pixels_without_a_unit_are_taken_for_electrons_and_it_is_said(tmp_path, mask, cube):
    path = write(tmp_path / "a.fits", cube, BUNIT=None)
    with pytest.warns(UserWarning, match="no BUNIT and no GAIN in the header: pixels are taken for electrons"):
        frames = read_observation(path, mask).frames
    np.testing.assert_array_equal(frames.numpy(), cube)
    assert torch.equal(read_observation(path, mask, unit="electron").frames, frames)


@pytest.mark.parametrize(
    ("cards", "message"),
    [
        ({"BUNIT": "adu"}, r"no GAIN or EGAIN, which its unit adu needs: give gain"),
        ({"BUNIT": "electron/s"}, r"no XPOSURE or EXPTIME, which its unit electron/s needs: give exposure_time \[s\]"),
        ({"BUNIT": "MJy/sr"}, r"no PHOTMJSR.*give unit"),
        ({"BUNIT": "parsec"}, r"BUNIT is 'parsec'; known are electron.*give unit"),
        ({"BUNIT": "gobbledygook"}, r"BUNIT is 'gobbledygook'.*give unit"),
        ({"GAIN": -1.0}, r"GAIN is -1.0"),
        ({"GAIN": "high"}, r"GAIN is 'high'"),
        ({"WAVELEN": 550.0}, r"WAVELEN is 550, which is no wavelength in metres"),
        ({"PIXELSCL": None, **SKY, "CD1_1": -2 * SCALE / 3600}, r"are not square"),
    ],
)
def test_cards_that_are_missing_or_wrong_are_named(tmp_path, mask, cube, cards, message):
    with pytest.raises(ValueError, match=message) as caught:
        read_observation(write(tmp_path / "a.fits", cube, HEADER | cards), mask)
    assert "a.fits" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_time_of_one_integration_counts_for_a_cube_of_jwst(tmp_path, mask, cube):
    cards = {"BUNIT": "electron/s", "XPOSURE": 30.0, "EFFINTTM": 10.0}
    one = read_observation(write(tmp_path / "a.fits", cube[0], HEADER | cards), mask).frames
    three = read_observation(write(tmp_path / "b.fits", cube, HEADER | cards), mask).frames
    torch.testing.assert_close(one[0], 3 * three[0])


# --- pixels


def test_dq_err_and_nan_mark_pixels(tmp_path, mask, cube):
    quality = np.zeros((16, 20), dtype=np.int32)
    quality[2, 3], quality[4, 5] = 1, 4
    cube[1, 6, 7] = np.nan
    errors = np.full(cube.shape, 0.5, dtype=np.float32)
    errors[2, 8, 1] = np.nan
    extensions = [("ERR", errors), ("DQ", quality)]
    expected = np.ones(cube.shape, dtype=bool)
    expected[:, 2, 3] = expected[1, 6, 7] = expected[2, 8, 1] = False
    for telescope, lowest_bit_only in (("JWST", True), ("VLT", False)):
        path = write(
            tmp_path / f"{telescope}.fits", cube, None, extensions, "SCI", TELESCOP=telescope, BUNIT="adu", GAIN=2.0
        )
        observation = read_observation(path, mask)
        expected[:, 4, 5] = lowest_bit_only
        assert np.array_equal(observation.valid, expected)
        assert torch.isfinite(observation.frames).all()
        assert observation.errors is not None
        assert observation.errors[0, 0, 0] == 1.0  # half an adu


def test_calibration_undoes_dark_and_flat(tmp_path, mask):
    rng = np.random.default_rng(0)
    truth = rng.uniform(100, 200, (3, 16, 20))
    dark, flat = rng.uniform(10, 20, (16, 20)), rng.uniform(0.5, 1.5, (16, 20))
    bad = np.zeros((16, 20))
    bad[3, 4] = 1
    flat[5, 6], dark[7, 8] = 0.0, np.nan
    good = (bad == 0) & (flat > 0) & np.isfinite(dark)
    flat *= 1 / np.median(flat[good])
    raw = truth * flat + dark
    raw[:, 3, 4] = 1e9
    # flats are known but for their scale
    write(tmp_path / "flat.fits", 37 * flat, {})
    observation = read_observation(
        write(tmp_path / "a.fits", raw), mask, dark=dark, flat=tmp_path / "flat.fits", bad_pixels=torch.from_numpy(bad)
    )
    assert np.array_equal(observation.valid, np.broadcast_to(good, raw.shape))
    np.testing.assert_allclose(observation.frames.numpy()[:, good], truth[:, good], rtol=1e-12)
    _, _, sensitivity = calibrate(raw, np.ones_like(raw, dtype=bool), flat=37 * flat, bad_pixels=~good)
    np.testing.assert_allclose(sensitivity[good], flat[good], rtol=1e-12)


def test_a_dark_of_another_shape_is_refused(tmp_path, mask, cube):
    with pytest.raises(ValueError, match=r"a\.fits: dark has shape \(16, 16\): it must be.*\(16, 20\)"):
        read_observation(write(tmp_path / "a.fits", cube), mask, dark=np.zeros((16, 16)))


# --- cropping


@pytest.mark.parametrize("crop", [6, 7, 12])
def test_crop_puts_the_target_in_the_middle_and_the_sky_stays(tmp_path, mask, cube, crop):
    header = HEADER | SKY
    whole = read_observation(write(tmp_path / "a.fits", cube, header), mask)
    field = read_observation(tmp_path / "a.fits", mask, crop=crop)
    assert field.grid.shape == (crop, crop)
    first = (9 - crop // 2, 12 - crop // 2)
    window = (slice(first[0], first[0] + crop), slice(first[1], first[1] + crop))
    assert torch.equal(field.frames, whole.frames[:, *window])
    before = wcs.WCS(dict(whole.header)).pixel_to_world_values(12, 9)
    after = wcs.WCS(dict(field.header)).pixel_to_world_values(crop // 2, crop // 2)
    np.testing.assert_allclose(after, before, rtol=1e-14)


def test_each_file_is_cropped_around_its_own_star(tmp_path, mask, cube):
    moved = np.roll(cube, (-2, 3), (1, 2))
    paths = [write(tmp_path / "a.fits", cube, HEADER | SKY), write(tmp_path / "b.fits", moved[:2], HEADER | SKY)]
    frames = read_observation(paths, mask, crop=6).frames
    assert frames.shape == (5, 6, 6)
    assert torch.equal(frames[:2], frames[3:])
    given = read_observation(paths, mask, crop=6, target=(8, 8)).frames
    assert torch.equal(given[4], torch.from_numpy(moved[1, 5:11, 5:11]).double())


def test_a_crop_that_does_not_fit_says_what_does(tmp_path, mask, cube):
    path = write(tmp_path / "a.fits", cube)
    with pytest.raises(ValueError, match=r"a\.fits: crop is 15.*row 9, column 12.*leaves at most 14"):
        read_observation(path, mask, crop=15)
    read_observation(path, mask, crop=14)


@settings(derandomize=True, deadline=None)
@given(st.integers(3, 30), st.integers(3, 30), st.data())
def test_the_largest_crop_is_the_largest(rows, columns, data):
    target = (data.draw(st.integers(0, rows - 1)), data.draw(st.integers(0, columns - 1)))

    def fits_in(size):
        try:
            crop_corner((rows, columns), target, size)
        except ValueError as error:
            return int(str(error).split()[-1])
        return None

    largest = fits_in(1000)
    assert largest is not None
    assert largest < 1 or fits_in(largest) is None
    assert fits_in(largest + 1) == largest


def test_hot_pixels_are_no_target():
    y, x = np.mgrid[:32, :32]
    frames = (1e3 * np.exp(-((y - 20) ** 2 + (x - 11) ** 2) / 8))[None]
    frames[0, 5, 5] = 1e6
    valid = np.ones(frames.shape, dtype=bool)
    valid[0, 5, 5] = valid[0, 20, 11] = False
    valid[0, :, :4] = False
    frames[0, :, :4] = 1e6
    assert find_target(frames, valid, 1.0) == (20, 11)


# --- selection and drift


@pytest.mark.parametrize("keep_by", ["flux", "sharpness"])
def test_selection_keeps_the_best_in_their_order(tmp_path, mask, keep_by):
    y, x = np.mgrid[:24, :24]
    width = np.array([3.0, 1.5, 2.0, 1.0, 2.5])
    flux = np.array([1.0, 5.0, 2.0, 4.0, 3.0]) * 1e4
    r2 = (y - 12) ** 2 + (x - 12) ** 2
    frames = flux[:, None, None] * np.exp(-r2 / (2 * width[:, None, None] ** 2))
    frames *= (flux / frames.sum((1, 2)))[:, None, None]
    path = write(tmp_path / "a.fits", frames)
    kept = read_observation(path, mask, keep=0.4, keep_by=keep_by).frames
    assert torch.equal(kept, torch.from_numpy(frames[[1, 3]]))
    best = read_observation(path, mask, keep=0.01, keep_by=keep_by).frames
    assert torch.equal(best, torch.from_numpy(frames[[1 if keep_by == "flux" else 3]]))
    # S1 of a Gaussian is 1 / (4 pi width^2)
    sharpness = frame_sharpness(frames, np.ones(frames.shape, dtype=bool))
    np.testing.assert_allclose(sharpness[:4], 1 / (4 * math.pi * width[:4] ** 2), rtol=1e-3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"keep": 0.0}, r"keep is 0.0"),
        ({"target": (900, 3)}, r"target is \(900, 3\).*give crop \[pixels\] too"),
        ({"keep": 1.5}, r"keep is 1.5"),
        ({"keep_by": "luck"}, r"keep_by is 'luck'"),
        ({"crop": 1}, r"crop is 1"),
        ({"wavelength": -1.0}, r"wavelength is -1.0"),
        ({"gain": math.nan}, r"gain is nan"),
        ({"readout_noise": -0.1}, r"readout_noise is -0.1"),
    ],
)
def test_options_are_checked_before_any_file_is_opened(mask, options, message):
    with pytest.raises(ValueError, match=message):
        read_observation("nowhere.fits", mask, **options)


def test_drift_is_the_movement_of_the_image(mask):
    # A tilt of 2 pi s x pixel_scale / wavelength moves the image by s pixels exactly; the search's step is 0.01.
    grid = Grid.nyquist(1.0, 550e-9, 48)
    psf = PSF(mask, grid)
    samples = psf.samples()
    position = samples.offsets + mask.centers[:, None, :]
    shifts = torch.tensor([[0.0, 0.0], [1.25, -2.5], [-0.37, 0.81]], dtype=torch.float64)
    tilt = 2 * math.pi * grid.pixel_scale / grid.wavelength * torch.einsum("npc,tc->tnp", position, shifts)
    frames = psf(tilt).roll((24, 24), (-2, -1)).numpy()
    np.testing.assert_allclose(frame_drift(frames), shifts, atol=0.015)
    valid = np.ones(frames.shape, dtype=bool)
    valid[:, 10, 10] = valid[:, 30, 31] = False
    spoilt = np.where(valid, frames, 1.0)  # dead pixels do not move, whatever their value
    np.testing.assert_allclose(frame_drift(spoilt, valid), shifts, atol=0.02)
    assert np.abs(frame_drift(spoilt)).max() < 0.02


# --- files that are refused


def test_damaged_files_are_refused_in_one_line(tmp_path, mask, cube):
    good = write(tmp_path / "good.fits", cube).read_bytes()
    fits.HDUList([fits.PrimaryHDU(cube)]).writeto(tmp_path / "checked.fits", checksum=True)
    flipped = bytearray((tmp_path / "checked.fits").read_bytes())
    flipped[4000] ^= 0xFF
    files = {
        "truncated.fits": good[:4000],
        "headless.fits": good[2880:],
        "half a header.fits": good[:1000],
        "empty.fits": b"",
        "text.fits": b"not a FITS file\n" * 300,
        "flipped.fits": bytes(flipped),
    }
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=r"is no FITS file, or is damaged") as caught:
            read_observation(tmp_path / name, mask)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"there is no file .*absent\.fits"):
        read_observation(tmp_path / "absent.fits", mask)
    with pytest.raises(ValueError, match=r"paths is empty"):
        read_observation([], mask)


def test_no_damage_brings_anything_but_one_line(tmp_path, mask, cube):
    """Bytes of headers and data changed at random, or the end cut off: read, or refused with a ValueError."""
    extensions = [("ERR", cube / 10), ("DQ", np.eye(16, 20, dtype=np.int16))]
    header = HEADER | SKY | {"BUNIT": "adu", "GAIN": 2.0, "OBJECT": "x"}
    good = write(tmp_path / "good.fits", cube, header, extensions, "SCI").read_bytes()
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


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros(5), r"array of shape \(5,\): it must be an image \(H, W\) or a cube"),
        (np.zeros((2, 2, 4, 4)), r"array of shape \(2, 2, 4, 4\)"),
        (None, r"holds no image"),
    ],
)
def test_arrays_of_another_kind_are_refused(tmp_path, mask, data, message):
    with pytest.raises(ValueError, match=message):
        read_observation(write(tmp_path / "a.fits", data), mask)


def test_extensions_must_agree(tmp_path, mask, cube):
    path = write(tmp_path / "a.fits", cube, None, [("DQ", np.zeros((16, 16), dtype=np.int16))], "SCI")
    with pytest.raises(ValueError, match=r"DQ of shape \(16, 16\)"):
        read_observation(path, mask)
    path = write(tmp_path / "b.fits", cube, None, [("SCI", cube)], "SCI")
    with pytest.raises(ValueError, match=r"2 SCI extensions"):
        read_observation(path, mask)
    dead = write(tmp_path / "c.fits", cube, None, [("DQ", np.ones((16, 20), dtype=np.int16))], "SCI")
    with pytest.raises(ValueError, match=r"no valid pixel"):
        read_observation(dead, mask)


@pytest.mark.parametrize(
    ("cards", "size", "message"),
    [
        ({"FILTER": "F430M"}, 20, r"mix filters: .*a\.fits has F480M and .*b\.fits F430M"),
        ({"WAVELEN": 551e-9 * 1.001}, 20, r"mix wavelengths: .*5\.5e-07 m"),
        ({"PIXELSCL": 0.021}, 20, r"mix pixel scales: .*0\.02 arcsec and .*0\.021 arcsec"),
        ({}, 19, r"mix image shapes: .*\(16, 20\) and .*\(16, 19\)"),
        ({"CD1_1": -SKY["CD1_1"], "CD1_2": -SKY["CD1_2"]}, 20, r"mix orientations"),
    ],
)
def test_a_list_of_unlike_files_is_refused(tmp_path, mask, cube, cards, size, message):
    header = HEADER | SKY | {"FILTER": "F480M"}
    paths = [
        write(tmp_path / "a.fits", cube, header),
        write(tmp_path / "b.fits", cube[..., :size], header | cards),
    ]
    with pytest.raises(ValueError, match=message):
        read_observation(paths, mask)


# --- files that are written


def test_observation_survives_its_own_file(tmp_path, mask, cube):
    extensions = [("ERR", cube / 10), ("DQ", np.eye(16, 20, dtype=np.int16))]
    header = {name: value for name, value in (HEADER | SKY).items() if name != "RDNOISE"}
    observation = read_observation(write(tmp_path / "a.fits", cube, header, extensions, "SCI"), mask)
    observation.save(tmp_path / "a.npz")
    back = Observation.load(tmp_path / "a.npz")
    assert back.readout_noise is None
    assert back.header == observation.header
    assert back.header["CRPIX1"] == 5.0
    assert torch.equal(back.valid, observation.valid)
    assert torch.equal(back.errors, observation.errors)
    assert torch.equal(back.frames, observation.frames)


def test_restored_image_lies_where_the_frames_did_on_the_sky(tmp_path, mask, cube):
    header = HEADER | SKY | {"TARGNAME": "AB Dor"}
    observation = read_observation(write(tmp_path / "a.fits", cube, header), mask, crop=8)
    result = result_for(observation)
    save_restored(tmp_path / "r.fits", result, observation, ["crop 8 pixels", "α " + "long " * 40])
    with fits.open(tmp_path / "r.fits", checksum=True) as hdus:
        assert np.array_equal(hdus[0].data, result.object)
        cards = hdus[0].header
    sky = wcs.WCS(cards).pixel_to_world_values(4, 4)
    np.testing.assert_allclose(sky, wcs.WCS(fits.getheader(tmp_path / "a.fits"), naxis=2).pixel_to_world_values(12, 9))
    assert cards["BUNIT"] == "electron"
    assert cards["TARGNAME"] == "AB Dor"
    assert cards["CHISQ"] == pytest.approx(1.1)
    assert cards["CHISQMAX"] == pytest.approx(1.3)
    assert cards["NFRAMES"] == 3
    assert "R0" not in cards
    assert "crop 8 pixels" in str(cards["HISTORY"])
    # it is itself an image that can be read
    again = read_observation(tmp_path / "r.fits", mask)
    assert torch.equal(again.frames[0], result.object)
    assert again.grid.pixel_scale == pytest.approx(observation.grid.pixel_scale, rel=1e-12)


def test_standard_deviations_are_an_extension(tmp_path, mask, cube):
    observation = read_observation(write(tmp_path / "a.fits", cube, HEADER | SKY), mask, crop=8)
    result = dataclasses.replace(result_for(observation), object_std=torch.rand(8, 8, dtype=torch.float64))
    save_restored(tmp_path / "r.fits", result, observation)
    with fits.open(tmp_path / "r.fits", checksum=True) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "ERR"]
        assert np.array_equal(hdus["ERR"].data, result.object_std)
        assert hdus["ERR"].header["BUNIT"] == "electron"
        assert hdus["ERR"].header["CRVAL1"] == hdus[0].header["CRVAL1"]
    again = read_observation(tmp_path / "r.fits", mask)
    assert torch.equal(again.errors[0], result.object_std)


def test_nothing_is_overwritten_or_left_half_done(tmp_path, mask, cube):
    observation = read_observation(write(tmp_path / "a.fits", cube), mask, crop=8)
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


def test_shifted_cards_leave_the_originals_alone():
    cards = dict(SKY)
    assert shift_cards(cards, 3, 4)["CRPIX1"] == 2.0
    assert cards == SKY


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"valid": torch.ones(3, 16, 20)}, r"valid is torch.float32 of shape \(3, 16, 20\): it must be bool"),
        ({"valid": torch.ones(2, 16, 20, dtype=torch.bool)}, r"valid is torch.bool of shape \(2, 16, 20\)"),
        ({"errors": torch.ones(16, 20)}, r"errors has shape \(16, 20\): it must be \(3, 16, 20\)"),
        ({"readout_noise": -1.0}, r"readout_noise is -1.0"),
    ],
)
def test_an_observation_of_parts_that_disagree_is_refused(mask, cube, fields, message):
    with pytest.raises(ValueError, match=message):
        Observation(
            **{"frames": torch.from_numpy(cube), "aperture": mask, "readout_noise": None} | fields,
            grid=Grid((16, 20), 1e-7, 550e-9),
        )


# --- the real observations


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
    tangent = (sky - sky[0]) * [math.cos(math.radians(sky[0, 1])), 1.0]
    expected = -(tangent @ np.linalg.inv(matrix).T) - (np.array(stars) - stars[0])
    np.testing.assert_allclose(drift, expected, atol=0.1)
    assert np.abs(expected).max() > 0.1
