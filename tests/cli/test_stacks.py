"""Which files are which stack."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchmask.cli.band_options import BandOptions
from torchmask.cli.stacks import StackOptions, group_files, read_stack, require_fine_pixels
from torchmask.design.manufacture import save_json
from torchmask.grid import ARCSEC, Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.optics.pixel import SquarePixel

FILES = [Path("a/cube.fits"), Path("b/cube.fits"), Path("b/other.npz"), Path("c/cube.fits")]


def test_every_file_is_a_stack_under_a_name_of_its_own():
    assert group_files(FILES, join=False) == {
        "cube": FILES[:1],
        "cube-2": FILES[1:2],
        "other": FILES[2:3],
        "cube-3": FILES[3:],
    }


def test_a_name_with_a_number_that_is_taken_is_passed_over():
    files = [Path("cube-2.fits"), Path("a/cube.fits"), Path("b/cube.fits")]
    assert list(group_files(files, join=False)) == ["cube-2", "cube", "cube-3"]


def test_joined_files_are_one_stack_with_the_name_of_the_first():
    assert group_files(FILES, join=True) == {"cube": FILES}


def test_no_files_are_no_stack():
    assert group_files([], join=False) == group_files([], join=True) == {}


def test_a_cube_without_wavelength_has_that_of_the_mask_file(write_fits, fits_cube, tmp_path):
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.15)
    save_json(tmp_path / "mask.json", mask, 633e-9)
    save_json(tmp_path / "old.json", mask)
    bare = [write_fits("bare.fits", fits_cube, WAVELEN=None)]
    assert read_stack(bare, StackOptions(mask=tmp_path / "mask.json")).grid.wavelength == 633e-9
    with pytest.raises(ValueError, match=r"bare\.fits has no WAVELEN.*: give wavelength \[m\]"):
        read_stack(bare, StackOptions(mask=tmp_path / "old.json"))


def test_frames_of_a_stack_are_skipped_and_those_without_light_left_out(tmp_path):
    mask, generator = SparseAperture.from_catalog("golay6", 1.0, 0.15), torch.Generator().manual_seed(0)
    frames = torch.rand(6, 16, 16, dtype=torch.float64, generator=generator)
    frames[:, 6:10, 6:10] += 100
    frames[4] -= 200
    Observation(frames, mask, Grid.nyquist(1.0, 550e-9, 16), 1.0).save(tmp_path / "a.npz")
    with pytest.warns(UserWarning, match=r"frames \[4\] hold no light"):
        seen = read_stack([tmp_path / "a.npz"], StackOptions(skip=(1,)))
    assert torch.equal(seen.frames, frames[[0, 2, 3, 5]])
    assert seen.frame_numbers == (0, 2, 3, 5)
    seen.save(tmp_path / "part.npz")
    assert read_stack([tmp_path / "part.npz"], StackOptions(skip=(3,))).frame_numbers == (0, 2, 5)
    whole = read_stack([tmp_path / "a.npz"], StackOptions(skip=(4,), pixel_fill=0.9))
    assert (seen.pixel, whole.pixel) == (None, SquarePixel(0.9))
    whole.save(tmp_path / "square.npz")
    found = [read_stack([tmp_path / "square.npz"], StackOptions(pixel_fill=fill)).pixel for fill in (None, 0.0, 1.0)]
    assert found == [SquarePixel(0.9), None, SquarePixel(1.0)]
    with pytest.raises(ValueError, match="pixel_fill is 2"):
        read_stack([tmp_path / "none.npz"], StackOptions(pixel_fill=2.0))
    with pytest.raises(ValueError, match="skip names frame 6, but the stack has 6 frames, with numbers from 0 to 5"):
        read_stack([tmp_path / "a.npz"], StackOptions(skip=(6,)))


def test_frames_alone_are_completed_by_options(tmp_path):
    mask, path = SparseAperture.from_catalog("golay6", 1.0, 0.15), tmp_path / "mine.npz"
    save_json(tmp_path / "mask.json", mask, 633e-9)
    frames, valid = np.full((3, 16, 20), 7.0), np.arange(320).reshape(16, 20) > 5
    np.savez(path, frames=frames, valid=valid)
    given = {"mask": tmp_path / "mask.json", "pixel_scale_arcsec": 0.02}
    seen = read_stack([path], StackOptions(**given, wavelength=550e-9, readout_noise=2.0))
    assert np.array_equal(seen.frames, frames)
    assert seen.valid is not None
    assert np.array_equal(seen.valid, valid)
    assert torch.equal(seen.aperture.centers, mask.centers)
    assert (seen.grid, seen.readout_noise) == (Grid((16, 20), 0.02 * ARCSEC, 550e-9), 2.0)
    assert read_stack([path], StackOptions(**given)).grid.wavelength == 633e-9  # of the mask
    np.savez(tmp_path / "more.npz", frames=frames, wavelength=2e-6, pixel_scale=1e-7, readout_noise=3.0)
    told = read_stack([tmp_path / "more.npz"], StackOptions(mask=given["mask"]))
    assert (told.grid, told.readout_noise) == (Grid((16, 20), 1e-7, 2e-6), 3.0)


@pytest.mark.parametrize(
    ("arrays", "given", "message"),
    [
        ({"frames": np.ones((2, 8, 8))}, {}, r"mine\.npz has no 'centers' of a mask: give --mask"),
        ({"frames": np.ones((2, 8, 8))}, {"mask": "keck_nirc2_9"}, r"mine\.npz has no wavelength: give --wavelength"),
        ({"frames": np.ones((2, 8, 8)), "wavelength": 2e-6}, {"mask": "keck_nirc2_9"}, "give --pixel-scale-arcsec"),
        ({"frames": np.ones((8, 8)), "wavelength": 2e-6, "pixel_scale": 1e-7}, {"mask": "keck_nirc2_9"}, "n_frames, 8"),
        ({"frames": np.ones((2, 8, 8)), "wavelength": 550, "pixel_scale": 1e-7}, {"mask": "keck_nirc2_9"}, "550e-9"),
        ({"image": np.ones((8, 8))}, {"mask": "keck_nirc2_9"}, r"mine\.npz has no 'frames'; it contains 'image'"),
        ({"frames": np.ones((2, 8, 8)), "centers": np.ones((3, 2))}, {}, "has no 'subaperture_diameter'"),
    ],
)
def test_what_frames_alone_lack_is_named_with_its_option(tmp_path, arrays, given, message):
    np.savez(tmp_path / "mine.npz", **arrays)
    with pytest.raises(ValueError, match=message):
        read_stack([tmp_path / "mine.npz"], StackOptions(**{name: Path(value) for name, value in given.items()}))


def test_frames_along_the_last_axis_are_told(tmp_path):
    options = StackOptions(mask=Path("keck_nirc2_9"), wavelength=2e-6, pixel_scale_arcsec=0.01)
    np.savez(tmp_path / "mine.npz", frames=np.ones((16, 16, 5)))
    with pytest.warns(UserWarning, match=r"16 frames of 16 x 5 pixels: if the last axis counts frames, move it"):
        read_stack([tmp_path / "mine.npz"], options)
    for shape in ((5, 16, 16), (16, 16, 16), (5, 5, 5), (5, 16, 8)):
        np.savez(tmp_path / "mine.npz", frames=np.ones(shape))
        read_stack([tmp_path / "mine.npz"], options)  # warnings are errors


def test_what_is_no_stack_is_refused_by_what_it_is(write_fits, fits_cube, tmp_path):
    cube, stack, array = write_fits("a.fits", fits_cube), tmp_path / "b.npz", tmp_path / "c.npy"
    np.savez(stack, frames=fits_cube)
    np.save(array, fits_cube)
    for files, message in (
        ([tmp_path / "none.fits"], r"there is no file .*none\.fits \(needed: a stack of exposures"),
        ([array], r"c\.npy is a bare array: write it as `frames` \[electrons\] to an \.npz file"),
        ([tmp_path], r"is a folder: give the FITS files in it, such as .*\*\.fits"),
        ([cube, stack], r"--join is for FITS files, but .*b\.npz is a stack by itself"),
    ):
        with pytest.raises(ValueError, match=message):
            read_stack(files, StackOptions(**FULL))


def test_a_path_without_frames_is_refused_before_a_mask_is_asked_for(write_fits, fits_cube, tmp_path):
    save_json(tmp_path / "mask.json", SparseAperture.from_catalog("golay6", 1.0, 0.15))
    design, simulated = tmp_path / "design", tmp_path / "simulated"
    for run in (design, simulated):
        run.mkdir()
        (run / "config.yaml").touch()
    (design / "mask.fits").touch()
    (simulated / "stack.npz").touch()
    for path, message in (
        (tmp_path / "none.fits", r"there is no file .*none\.fits"),
        (tmp_path / "mask.json", r"mask\.json is not a stack of frames: give an \.npz or FITS file"),
        (simulated, r"simulated is a folder: give the stack in it, .*stack\.npz"),
        (design, r"design is a folder: it holds no stack of frames, so give an \.npz file"),
        (write_fits("a.fits", fits_cube), "--mask is missing"),
    ):
        with pytest.raises(ValueError, match=message):
            read_stack([path], StackOptions())


def test_a_pixel_scale_of_the_file_that_undersamples_is_blamed_on_the_file(write_fits, fits_cube):
    path = write_fits("a.fits", fits_cube, PIXELSCL=20.0)
    seen = read_stack([path], StackOptions(**FULL))
    with pytest.raises(ValueError, match=r"a\.fits: the pixel scale .* undersamples .*; correct it in the file"):
        require_fine_pixels(seen, StackOptions(**FULL), path)
    require_fine_pixels(seen, StackOptions(**FULL, pixel_scale_arcsec=20.0), path)  # refused in its words elsewhere


def test_a_cube_in_adu_needs_a_gain(write_fits, fits_cube):
    raw = [write_fits("raw.fits", fits_cube, BUNIT=None)]
    with pytest.raises(ValueError, match=r"give gain \[electrons per adu\]; if pixels are not in adu, give unit"):
        read_stack(raw, StackOptions(mask=Path("keck_nirc2_9")))
    assert len(read_stack(raw, StackOptions(mask=Path("keck_nirc2_9"), gain=2.0)).frames) == 3


FULL = {"mask": Path("full"), "mask_diameter": 1.0}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"exposure_time": -1.0}, "exposure_time is -1.0: it must be finite and positive, in s"),
        ({"gain": 0.0}, "gain is 0.0: it must be finite and positive, in electrons per adu"),
        ({"saturation": -1.0}, "saturation is -1.0: it must be finite and positive"),
        ({"readout_noise": -1.0}, "readout_noise is -1.0: it must be finite and at least 0"),
        ({"pixel_scale_arcsec": 0.0}, "--pixel-scale-arcsec is 0: it must be finite and positive, in arcsec"),
        ({"wavelength": 2.2}, r"--wavelength is 2\.2: .* 2\.2 micrometres are 2\.2e-6"),
    ],
)
def test_numbers_that_cannot_be_are_refused_in_the_unit_of_their_option(write_fits, fits_cube, given, message):
    with pytest.raises(ValueError, match=message):
        read_stack([write_fits("a.fits", fits_cube)], StackOptions(**FULL | given))


def test_an_unknown_filter_lists_the_known_ones(write_fits, fits_cube):
    path = write_fits("a.fits", fits_cube, WAVELEN=None, INSTRUME="NIRISS", FILTER="F999Z")
    with pytest.raises(ValueError, match=r"'F999Z' of INSTRUME 'NIRISS'; known: .*NIRISS F480M"):
        read_stack([path], StackOptions(**FULL))


@pytest.mark.parametrize(
    ("errors", "message"),
    [(np.ones((2, 16, 20)), r"ERR of shape \(2, 16, 20\)"), (-np.ones((3, 16, 20)), r"errors is not positive at 960")],
)
def test_errors_that_cannot_be_are_refused(write_fits, fits_cube, errors, message):
    with pytest.raises(ValueError, match=message):
        read_stack([write_fits("a.fits", fits_cube, extensions=[("ERR", errors)])], StackOptions(**FULL))


def test_a_filter_of_restore_is_its_band_at_the_observation():
    band = Band.from_filter("bessell-V", 3)
    found = BandOptions(filter="bessell-V", n_wavelengths=3).band(550e-9)
    assert found == {"wavelengths": band.wavelengths, "weights": band.shares}
    assert BandOptions(wavelengths=(5e-7,), weights=(1.0,)).band(550e-9) == {"wavelengths": (5e-7,), "weights": (1.0,)}
    assert BandOptions().band(550e-9) == {"wavelengths": None, "weights": None}
    with pytest.raises(ValueError, match="both given"):
        BandOptions(filter="bessell-V", wavelengths=(5e-7,)).band(550e-9)
    with pytest.raises(ValueError, match=r"not the wavelength 2\.2e-06 m"):
        BandOptions(filter="bessell-V").band(2.2e-6)
