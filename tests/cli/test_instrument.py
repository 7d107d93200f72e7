"""One file of what is known of an observation, for several commands: what is given beside it wins."""

import dataclasses
import json
import math
import shutil
from pathlib import Path

import pytest
import torch
import yaml

from torchmask.cli import design, plan, rank, restore
from torchmask.cli.main import main
from torchmask.cli.options import MaskOptions, load_aperture
from torchmask.cli.program import NOT_EXPLAINED, parse
from torchmask.cli.stacks import StackOptions, read_stack
from torchmask.design.manufacture import load_mask, mask_wavelength
from torchmask.design.observed import instrument_criterion
from torchmask.grid import ARCSEC, Grid
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Telescope
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pixel import SquarePixel

pytestmark = pytest.mark.usefixtures("coarse_figures")


def test_frames_are_simulated_as_the_instrument_takes_them(folder, capsys, recorded, golay):
    told = ["--mask", folder / "mask.json", "--instrument", folder / "instrument.json", "--out", folder / "run"]
    assert main(["simulate", *map(str, told), "--scene.size", "0.4", "--r0", "0.2"]) == 0
    stack = Observation.load(folder / "run/stack.npz")
    assert stack.grid.shape == (24, 24)
    assert len(stack.frames) == 2
    assert (stack.grid.wavelength, stack.readout_noise, stack.outer_scale) == (700e-9, 2.5, 30.0)
    assert stack.grid.pixel_scale == pytest.approx(recorded.pixel_scale, rel=1e-12)
    assert stack.background == pytest.approx(recorded.sky(float(golay.area)), rel=1e-12)
    assert (stack.pixel, stack.exposure_time) == (SquarePixel(0.9), 3e-3)
    assert stack.r0 == pytest.approx(0.2)  # given beside it
    assert f"{recorded.photons(float(golay.area)):.4g} photons in each" in capsys.readouterr().out
    config = yaml.safe_load((folder / "run/config.yaml").read_text())
    assert config["turbulence"]["exposure_time"] == 3e-3
    assert config["turbulence"]["wind"] == [5.0, 0.0]
    assert config["conditions"]["n_wavelengths"] == 2
    again = ["simulate", "--config", str(folder / "run/config.yaml"), "--out", str(folder / "again")]
    assert main(again) == 0
    assert Observation.load(folder / "again/stack.npz").frames.equal(stack.frames)


def stack_of(folder, **changes):
    """Frames as the instrument takes them, in a file, but for some changes."""
    recorded, golay = Instrument.load(folder / "instrument.json"), load_mask(folder / "mask.json")
    generator = torch.Generator().manual_seed(0)
    frames = 50 + 5 * torch.rand(2, 32, 32, dtype=torch.float64, generator=generator)
    frames[:, 12:20, 12:20] += 1000
    seen = Observation(frames, golay, recorded.grid(32), 2.5, pixel=recorded.camera.pixel, header={"XPOSURE": 3e-3})
    dataclasses.replace(seen, **changes).save(folder / "stack.npz")
    return [folder / "stack.npz"]


def test_an_instrument_fills_in_what_a_stack_lacks_and_what_is_given_wins(folder, recorded):
    told = {"instrument": folder / "instrument.json"}
    bare = read_stack(stack_of(folder, readout_noise=None, pixel=None), StackOptions(**told))
    assert (bare.readout_noise, bare.pixel) == (2.5, SquarePixel(0.9))
    (folder / "stack.npz").unlink()
    other = {"readout_noise": 4.0, "pixel": SquarePixel(0.5), "grid": Grid(32, recorded.pixel_scale, 550e-9)}
    files = stack_of(folder, **other)
    with pytest.raises(
        ValueError, match=r"wavelength \(5.5e-07 against 7e-07 m\) and --readout-noise \(4 against 2.5 "
    ) as told_all:
        read_stack(files, StackOptions(**told))
    assert "and --pixel-fill (0.5 against 0.9 of the area): give these options" in str(told_all.value)
    given = StackOptions(**told, wavelength=550e-9, readout_noise=4.0, pixel_fill=0.5, exposure_time=0.01)
    seen = read_stack(files, given)
    assert (seen.readout_noise, seen.pixel, seen.grid.wavelength) == (4.0, SquarePixel(0.5), 550e-9)
    assert seen.exposure_time == 0.01
    with pytest.raises(ValueError, match="--exposure-time is -1"):
        read_stack(files, StackOptions(exposure_time=-1.0))


def test_headers_without_grid_are_completed(folder, write_fits, fits_cube, recorded):
    files = [write_fits("bare.fits", fits_cube, WAVELEN=None, PIXELSCL=None)]
    camera = dataclasses.replace(recorded.camera, pixel_scale=0.03)
    dataclasses.replace(recorded, camera=camera).save(folder / "scaled.json")
    seen = read_stack(
        files, StackOptions(mask=folder / "mask.json", instrument=folder / "scaled.json", readout_noise=1.0)
    )
    assert (seen.grid.wavelength, seen.pixel) == (700e-9, SquarePixel(0.9))
    assert seen.grid.pixel_scale == pytest.approx(0.03 * ARCSEC, rel=1e-12)


def test_a_restoration_is_told_band_pixels_noise_and_motion_of_an_instrument(folder, recorded):
    told = dataclasses.replace(restore.Options.of_instrument(recorded), instrument=folder / "instrument.json")
    seen = read_stack(stack_of(folder), told)
    method = restore.deconvolution(seen, told)
    tau0 = recorded.seeing.tau0
    assert method.recipe.band == recorded.band
    assert (method.recipe.pixel, method.readout_noise, method.known_r0) == (SquarePixel(0.9), 2.5, False)
    assert method.recipe.exposure_tau0 == pytest.approx(3e-3 / tau0, rel=1e-12)
    faster = dataclasses.replace(told, wind=10.0, r0=0.15)
    assert restore.motion(seen, faster) == pytest.approx(3e-3 * 10.0 / (0.314 * 0.15), rel=1e-3)
    assert restore.motion(dataclasses.replace(seen, aperture=FullAperture(1.2)), told) == 0
    assert restore.motion(seen, dataclasses.replace(told, prior=False)) == 0
    assert restore.motion(seen, restore.Options(r0=0.1)) == 0
    slow = dataclasses.replace(seen, header={"XPOSURE": 0.02})
    with pytest.raises(ValueError, match=r"disagree on --exposure-time \(0.02 against 0.003 s\): give it"):
        restore.motion(slow, told)
    assert restore.motion(slow, dataclasses.replace(told, exposure_time=0.02)) == pytest.approx(0.02 / tau0, rel=1e-12)
    for options, message in (
        (restore.Options(wind=5.0), r"needs --r0 too \[m\]"),
        (restore.Options(wind=5.0, r0=0.1), r"needs --exposure-time too \[s\]"),
    ):
        with pytest.raises(ValueError, match=message):
            restore.motion(dataclasses.replace(seen, header={}), options)
    with pytest.raises(ValueError, match="--wind is for masks"):
        restore.motion(dataclasses.replace(seen, aperture=FullAperture(1.2)), restore.Options(wind=5.0, r0=0.1))


def test_a_restoration_is_not_told_the_turbulence_of_a_simulated_stack(folder, golay):
    seen = read_stack(stack_of(folder, r0=0.2, outer_scale=7.0), StackOptions())
    method = restore.deconvolution(seen, restore.Options())
    assert not method.known_r0
    assert method.recipe.outer_scale == 20 * golay.mask_diameter
    told = restore.deconvolution(seen, restore.Options(r0=0.2, outer_scale=7.0))
    assert (told.known_r0, told.recipe.r0, told.recipe.outer_scale) == (True, 0.2, 7.0)


@pytest.mark.parametrize(
    "command",
    [
        "design",
        "rank golay6",
        "restore {folder}/stack.npz --star {folder}/no.npz",
        "simulate --mask {folder}/mask.json",
        "table {folder}/table",
    ],
)
def test_another_wavelength_than_that_of_r0_and_light_is_refused(command, folder, capsys):
    words = [*command.format(folder=folder).split(), "--instrument", f"{folder}/instrument.json"]
    assert main([*words, "--wavelength", "900e-9"]) == 1
    told = capsys.readouterr().err
    assert "--wavelength is 9e-07 m, but r0 and light of --instrument" in told
    assert "are those at 7e-07 m: change the wavelength there" in told


def test_a_mask_wider_than_the_telescope_is_refused(recorded):
    wide = MaskOptions(mask=Path("jwst_niriss_ami_7"))
    with pytest.raises(ValueError, match=r"for a pupil of 6.559 m, but the telescope has 1.2 m: .* --mask-diameter"):
        load_aperture(wide, recorded.telescope)
    assert load_aperture(dataclasses.replace(wide, mask_diameter=1.2), recorded.telescope).mask_diameter == 1.2
    assert load_aperture(wide, Telescope(diameter=6.5)).mask_diameter == 6.559  # as telescopes are rounded


def test_a_full_pupil_is_that_of_the_telescope(folder, capsys, recorded):
    telescope = dataclasses.replace(recorded.telescope, vane_width=0.05, vane_angles=(0.0, 90.0))
    vaned = dataclasses.replace(recorded, telescope=telescope)
    vaned.save(folder / "vaned.json")
    told = ["simulate", "--instrument", folder / "vaned.json", "--mask", "full", "--scene.size", "0.4"]
    assert main([*map(str, told), "--out", str(folder / "run")]) == 0
    pupil, expected = Observation.load(folder / "run/stack.npz").aperture, telescope.pupil()
    assert isinstance(pupil, FullAperture)
    for name in ("mask_diameter", "central_obstruction", "vane_width", "vane_angles"):
        assert getattr(pupil, name) == getattr(expected, name), name
    assert f"{vaned.photons(float(expected.area)):.4g} photons in each" in capsys.readouterr().out


def test_what_is_given_of_a_full_pupil_wins(recorded):
    telescope = dataclasses.replace(recorded.telescope, vane_width=0.05, vane_angles=(0.0, 90.0))
    own = MaskOptions(mask=Path("full"), mask_diameter=1.0, central_obstruction=0.1, vane_angles=(30.0, 210.0))
    expected = FullAperture(1.0, 0.1, 0.05, [math.radians(30), math.radians(210)])
    assert load_aperture(own, telescope).area == expected.area
    with pytest.raises(ValueError, match=r"--central-obstruction is 0.2 m: .* less than --mask-diameter, 0.1 m"):
        load_aperture(MaskOptions(mask=Path("full"), mask_diameter=0.1), telescope)


def test_patterns_without_a_size_are_as_wide_as_the_telescope(recorded):
    laid = load_aperture(MaskOptions(mask=Path("golay6"), fill_factor=0.1), recorded.telescope)
    assert laid.mask_diameter == 1.2
    built = load_aperture(MaskOptions(mask=Path("niriss"), allow_overlap=True), Telescope(diameter=8.0))
    assert built.mask_diameter == SparseAperture.from_catalog("niriss").mask_diameter


def test_a_mask_is_designed_for_the_instrument(folder, recorded):
    options = [
        "--n-subapertures",
        "4",
        "--fill-factor",
        "0.1",
        "--budget",
        "60",
        "--n-frequencies",
        "32",
        "--n-frames",
        "9",
    ]
    told = ["--instrument", str(folder / "instrument.json"), "--out", str(folder / "run")]
    assert main(["design", *options, *told, "--criterion", "asymptotic"]) == 0
    mask = load_mask(folder / "run/mask.json")
    assert mask.mask_diameter == 1.2
    assert mask_wavelength(folder / "run/mask.json") == 700e-9
    assert float(mask.centers.norm(dim=-1).min()) >= (0.2 + mask.subaperture_diameter) / 2 - 1e-9
    config = yaml.safe_load((folder / "run/config.yaml").read_text())
    assert (config["n_frames"], config["readout_noise"], config["r0"], config["exponent"]) == (9, 2.5, 0.3, 2.0)
    metrics = json.loads((folder / "run/metrics.json").read_text())
    photons = recorded.photons(math.pi / 4 * 0.1 * 1.2**2)
    # of any criterion the error is at most 1, and its scale is the object's power, photons^2 times the mean spectrum
    psd = recorded.object_psd(1.0)(recorded.grid(32)).mean() / recorded.photons(1.0) ** 2
    assert metrics["mse"] / metrics["relative_mse"] == pytest.approx(photons**2 * float(psd), rel=0.02)


@pytest.mark.parametrize("module", [design, rank])
@pytest.mark.parametrize("pixel_scale", [None, 0.03])  # arcsec
def test_the_criterion_of_an_instrument_is_the_same_in_every_command(module, pixel_scale, tmp_path, recorded):
    instrument = dataclasses.replace(recorded, camera=dataclasses.replace(recorded.camera, pixel_scale=pixel_scale))
    instrument.save(tmp_path / "instrument.json")
    options = dataclasses.replace(module.Options.of_instrument(instrument), instrument=tmp_path / "instrument.json")
    area = math.pi / 4 * 0.1 * 1.2**2
    known, half = instrument_criterion(instrument, area, 32), instrument_criterion(instrument, area / 2, 32)
    observed = options.observation(32, fill_factor=0.1)
    criterion = observed.criterion()
    assert type(criterion) is type(known)
    for name in ("seeing", "pixel", "n_frames"):
        assert getattr(criterion, name) == getattr(known, name), name
    assert (criterion.grid.shape, criterion.grid.wavelength) == (known.grid.shape, known.grid.wavelength)
    assert criterion.grid.pixel_scale == pytest.approx(known.grid.pixel_scale, rel=1e-14)
    assert criterion.band.wavelengths == known.band.wavelengths
    assert criterion.band.shares == pytest.approx(known.band.shares, rel=1e-14)
    for name in ("object_psd", "noise_psd"):
        torch.testing.assert_close(getattr(criterion, name), getattr(known, name), rtol=1e-12, atol=0)
        found = getattr(observed.through(area / 2).criterion(), name)
        torch.testing.assert_close(found, getattr(half, name), rtol=1e-12, atol=0)


def test_what_is_given_beside_an_instrument_wins(folder, recorded):
    options = dataclasses.replace(design.Options.of_instrument(recorded), instrument=folder / "instrument.json")
    assert dataclasses.replace(options, sky=9.0).turbulence(700e-9, 0.1)["sky"] == 9.0
    assert dataclasses.replace(options, criterion="asymptotic").turbulence(700e-9, 0.1) is None
    assert dataclasses.replace(options, n_photons=3e4).observation(32, 0.1).noise_psd.n_photons == 3e4


def test_a_filter_stays_a_filter_with_the_light_of_the_source(folder, recorded):
    filtered = dataclasses.replace(recorded, filter="bessell-R", wavelength=None, width=None, n_wavelengths=5)
    filtered.save(folder / "filtered.json")
    options = dataclasses.replace(design.Options.of_instrument(filtered), instrument=folder / "filtered.json")
    found = options.turbulence(filtered.mean_wavelength, 0.1)
    assert options.used_instrument() == filtered
    assert (found["wavelengths"], found["weights"]) == (filtered.band.wavelengths, filtered.band.shares)


def test_a_first_plan_tells_all_that_is_missing_at_once(capsys):
    words = ["--exposure", "2e-3", "--telescope.diameter", "1", "--site.r0", "0.15", "--site.wind", "10"]
    assert main(["plan", *words, "--camera.n-pixels", "0"]) == 1
    assert capsys.readouterr().err == (
        "torchmask plan: error: "
        "(1) --camera.n-pixels is 0: it must be a whole number of at least 2; "
        "(2) source: give --source.magnitude or --source.photon-rate [1 / (s m^2)], and not both; "
        "(3) the band is missing or given twice: give --filter, or --wavelength and --width [m]; "
        "give --observing-time [s] or --n-frames, and not both\n"
    )


def test_a_plan_is_made_of_the_whole_file(folder, recorded):
    parsed = parse(plan.Options, "plan", ["--instrument", str(folder / "instrument.json"), "--site.wind", "7"], prog="")
    expected = dataclasses.replace(recorded, site=dataclasses.replace(recorded.site, wind=7.0))
    assert plan.instrument_of(parsed) == expected


@pytest.mark.parametrize("given", [["--mask-diameter", "0"], ["--fill-factor", "0.2"], ["--mirrored"]])
def test_a_plan_of_searched_masks_refuses_options_of_one_that_exists(given, folder, capsys):
    assert main(["plan", "--instrument", str(folder / "instrument.json"), *given]) == 1
    assert f"{given[0]} is for a mask that exists: give --mask, or leave it out" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["plan", "design", "rank", "simulate"])
def test_files_that_are_no_instrument_are_refused(command, folder, capsys):
    assert main([command, "--instrument", str(folder / "mask.json")]) == 1
    assert "cannot be read as an instrument" in capsys.readouterr().err
    told = ["--instrument", str(folder / "instrument.json"), "--config", str(folder / "config.yaml")]
    (folder / "config.yaml").write_text(f"command: {command}\n")
    assert main([command, *told]) == 1
    assert "give one" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore::UserWarning")  # of frames that are random numbers
@pytest.mark.parametrize("n_stacks", [1, 2])
def test_a_restoration_keeps_the_instrument_that_it_was_told(n_stacks, folder, recorded):
    files = [str(*stack_of(folder))] * n_stacks
    if n_stacks == 2:
        shutil.copyfile(files[0], folder / "other.npz")
        files[1] = str(folder / "other.npz")
    told = ["--instrument", str(folder / "instrument.json"), "--out", str(folder / "run"), "--max-iterations", "2"]
    told += ["--workers", "1"]
    assert main(["restore", *files, *told]) == NOT_EXPLAINED
    assert Instrument.load(folder / "run/instrument.json") == recorded
