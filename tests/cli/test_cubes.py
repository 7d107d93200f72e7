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
