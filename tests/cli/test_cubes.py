"""FITS files of another shape than is needed are named, with the shape that they have."""

from pathlib import Path

import numpy as np
import pytest

from torchmask.cli.main import main
from torchmask.cli.stacks import StackOptions, read_stack

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
    told = f"{swapped} was read as 48 frames of 48 x 5 pixels, which are too narrow for this mask: take a wider image"
    for command in ("restore", "calibrate"):
        said = error_of([command, str(swapped), *golay], capsys)
        assert told in said
        assert "if another axis counts frames, make it the third one of the file (NAXIS3)" in said
    narrow = write_fits("narrow.fits", frames[:, 20:28, 20:28].copy(), PIXELSCL=0.05)
    assert "NAXIS3" not in error_of(["restore", str(narrow), *golay], capsys)


def test_many_frames_that_padding_makes_wide_enough_are_read(write_fits):
    frames = np.random.default_rng(0).uniform(90, 110, (30, 22, 22))
    frames[:, 8:14, 8:14] += 1000
    options = StackOptions(mask=Path("golay6"), mask_diameter=1.0, fill_factor=0.15)
    seen = read_stack([write_fits("long.fits", frames, PIXELSCL=0.05)], options)
    assert len(seen.frames) == 30
    with pytest.raises(ValueError, match="at least 2 are needed"):  # as they are
        seen.aperture.samples(seen.grid)
