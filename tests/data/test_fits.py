"""FITS files: what is an image, which of its pixels count, and what is refused."""

import numpy as np
import pytest

from torchmask.data.fits import read_fits

fits = pytest.importorskip("astropy.io.fits")


def test_an_image_is_a_cube_of_one_frame(write_fits, fits_cube):
    cube = read_fits(write_fits("a.fits", fits_cube, OBJECT="star"))
    image = read_fits(write_fits("b.fits", fits_cube[1]))
    assert np.array_equal(cube.values, fits_cube)
    assert np.array_equal(image.values, fits_cube[1:2])
    assert (cube.is_cube, image.is_cube) == (True, False)
    assert cube.values.dtype == np.float64
    assert cube.valid.all()
    assert cube.errors is None
    assert cube.header["OBJECT"] == "star"


def test_cards_of_the_image_win_over_those_of_the_primary_header(write_fits, fits_cube):
    path = write_fits("a.fits", fits_cube, sci=True, OBJECT="star", GAIN=2.0)
    with fits.open(path, mode="update") as hdus:
        hdus["SCI"].header["GAIN"] = 3.0
    header = read_fits(path).header
    assert (header["OBJECT"], header["GAIN"], header["EXTNAME"]) == ("star", 3.0, "SCI")


@pytest.mark.parametrize(("telescope", "lowest_bit_only"), [("JWST", True), ("VLT", False)])
def test_dq_err_and_nan_mark_pixels(write_fits, fits_cube, telescope, lowest_bit_only):
    quality = np.zeros((16, 20), dtype=np.int32)
    quality[2, 3], quality[4, 5] = 1, 4
    fits_cube[1, 6, 7] = np.nan
    errors = np.full(fits_cube.shape, 0.5, dtype=np.float32)
    errors[2, 8, 1] = np.nan
    extensions = [("ERR", errors), ("DQ", quality)]
    images = read_fits(write_fits("a.fits", fits_cube, extensions=extensions, sci=True, TELESCOP=telescope))
    expected = np.ones(fits_cube.shape, dtype=bool)
    expected[:, 2, 3] = expected[1, 6, 7] = expected[2, 8, 1] = False
    expected[:, 4, 5] = lowest_bit_only
    assert np.array_equal(images.valid, expected)
    np.testing.assert_array_equal(images.errors, errors)


def test_damaged_files_are_refused_in_one_line(tmp_path, write_fits, fits_cube):
    good = write_fits("good.fits", fits_cube).read_bytes()
    fits.HDUList([fits.PrimaryHDU(fits_cube)]).writeto(tmp_path / "checked.fits", checksum=True)
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
        with pytest.raises(ValueError, match=r"is not a FITS file, or is damaged") as caught:
            read_fits(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"there is no file .*absent\.fits"):
        read_fits(tmp_path / "absent.fits")
    np.save(tmp_path / "array.npy", fits_cube)
    with pytest.raises(ValueError, match=r"array\.npy is not a FITS file, .* valid FITS file\.$"):
        read_fits(tmp_path / "array.npy")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (np.zeros(5), r"array of shape \(5,\): it must be an image \(H, W\) or a cube"),
        (np.zeros((2, 2, 4, 4)), r"array of shape \(2, 2, 4, 4\)"),
        (None, r"holds no image"),
    ],
)
def test_arrays_of_another_kind_are_refused(write_fits, data, message):
    with pytest.raises(ValueError, match=message):
        read_fits(write_fits("a.fits", data))


def test_extensions_must_agree(write_fits, fits_cube):
    quality = ("DQ", np.zeros((16, 16), dtype=np.int16))
    with pytest.raises(ValueError, match=r"DQ of shape \(16, 16\)"):
        read_fits(write_fits("a.fits", fits_cube, extensions=[quality], sci=True))
    with pytest.raises(ValueError, match=r"2 SCI extensions"):
        read_fits(write_fits("b.fits", fits_cube, extensions=[("SCI", fits_cube)], sci=True))


@pytest.mark.parametrize(
    ("names", "told"),
    [
        (["", "", ""], "differ: if"),
        (["FRAME", "FRAME"], "differ: if"),
        (["FRAME0", "FRAME1", "FRAME2"], r"differ but in their digits \(FRAME0 to FRAME2\): if"),
        (["IM_9", "IM_10"], r"differ but in their digits \(IM_9 to IM_10\): if"),
    ],
)
def test_one_frame_for_each_extension_is_refused_with_their_number(write_fits, fits_cube, names, told):
    extensions = list(zip(names, fits_cube, strict=False))
    said = rf"holds {len(names)} images of one shape without names that {told}.* as one cube \(T, H, W\)"
    with pytest.raises(ValueError, match=said):
        read_fits(write_fits("a.fits", None, extensions=extensions))


def test_images_whose_names_do_not_say_that_they_go_with_the_first_are_left_out_with_a_warning(write_fits, fits_cube):
    first, second, third = fits_cube
    extensions = [("LEFT", first), ("RIGHT", second), ("VAR_POISSON", third), ("MASK", third), ("SMALL", third[:8])]
    with pytest.warns(UserWarning, match=r"a.fits holds 1 more images of the same shape \(RIGHT\) that are left out"):
        images = read_fits(write_fits("a.fits", None, extensions=extensions))
    assert np.array_equal(images.values, [first])
    read_fits(write_fits("b.fits", first, sci=True, extensions=[("RIGHT", second)]))  # SCI says which it is


def test_a_primary_image_with_another_like_it_is_refused_but_not_with_one_of_another_name_or_shape(
    write_fits, fits_cube
):
    first, second, _ = fits_cube
    with pytest.raises(ValueError, match="holds 2 images of one shape"):
        read_fits(write_fits("a.fits", first, extensions=[("", second)]))
    others = [("WEIGHT", second), ("", second[:8])]
    assert np.array_equal(read_fits(write_fits("b.fits", first, extensions=others)).values, [first])


@pytest.mark.parametrize("name", ["BADPIX", "BPM", "DQ"])
def test_extensions_of_bad_pixels_mark_them(write_fits, fits_cube, name):
    bad = np.zeros((16, 20), dtype=np.uint8)
    bad[2, 3] = 4
    valid = read_fits(write_fits("a.fits", fits_cube, extensions=[(name, bad)])).valid
    assert (~valid).nonzero()[1].tolist() == [2, 2, 2]
    assert (~valid).nonzero()[2].tolist() == [3, 3, 3]
    with pytest.raises(ValueError, match=rf"{name} of shape \(3, 3\)"):
        read_fits(write_fits("b.fits", fits_cube, extensions=[(name, np.zeros((3, 3), dtype=np.uint8))]))


@pytest.mark.parametrize(("dtype", "top"), [("uint16", 65535), ("int16", 32767), ("uint8", 255), ("int32", None)])
def test_where_a_converter_stops_a_pixel_is_not_valid(write_fits, dtype, top):
    counts = np.full((4, 6), 17, dtype=dtype)
    counts[1, 2] = np.iinfo(dtype).max
    counts[3, 3] = np.iinfo(dtype).max - 1
    images = read_fits(write_fits("a.fits", counts))
    assert images.values[0, 1, 2] == np.iinfo(dtype).max
    assert np.argwhere(~images.valid).tolist() == ([[0, 1, 2]] if top else [])
