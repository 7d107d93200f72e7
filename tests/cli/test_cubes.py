"""FITS files of another shape than is needed are named, with the shape that they have."""

import numpy as np

from torchmask.cli.main import main

FULL = ["--mask", "full", "--mask-diameter", "1"]


def error_of(argv, capsys):
    assert main(argv) == 1
    return capsys.readouterr().err


def test_a_bad_pixel_map_that_leaves_nothing_or_is_a_cube_is_named(write_fits, fits_cube, capsys):
    cube = write_fits("a.fits", fits_cube)
    every = write_fits("every.fits", np.ones(fits_cube.shape[1:]))
    said = error_of(["restore", str(cube), *FULL, "--bad-pixels", str(every)], capsys)
    assert f"{cube}: --bad-pixels marks every pixel as bad: give a map that is 0 on good pixels" in said
    said = error_of(["restore", str(cube), *FULL, "--bad-pixels", str(cube)], capsys)
    assert f"--bad-pixels {cube} is a cube of 3 images of 16 x 20 pixels: give one image" in said


def test_axes_in_another_order_are_told_where_frames_are_too_narrow(write_fits, capsys):
    frames = np.random.default_rng(0).uniform(90, 110, (5, 48, 48))
    frames[:, 20:28, 20:28] += 1000
    golay = ["--mask", "golay6", "--mask-diameter", "1", "--fill-factor", "0.15"]
    swapped = write_fits("swapped.fits", np.moveaxis(frames, 0, -1).copy(), PIXELSCL=0.05)
    told = "the file was read as 48 frames of 48 x 5 pixels: if another axis counts frames, make it the third one"
    for command in ("restore", "calibrate"):
        said = error_of([command, str(swapped), *golay], capsys)
        assert "take an image at least" in said
        assert told in said
        assert "(NAXIS3)" in said
    narrow = write_fits("narrow.fits", frames[:, 20:28, 20:28].copy(), PIXELSCL=0.05)
    assert "NAXIS3" not in error_of(["restore", str(narrow), *golay], capsys)
