"""design, simulate, restore, codesign, small: what they write, that configs reproduce it, that nothing is lost."""

import dataclasses
import json
import math
import re
from typing import get_args, get_type_hints

import numpy as np
import pytest
import torch
from astropy.io import fits

from torchmask.cli.config import load_config
from torchmask.cli.main import main
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.cli.report import draw_zones
from torchmask.cli.restore import SKIES, Options
from torchmask.cli.view import view_path
from torchmask.design.constraints import KeepOutDisc, KeepOutSegment, MinimumGap, check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import load_mask
from torchmask.grid import Grid
from torchmask.io import load_npz
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture
from torchmask.optics.shapes import TelescopePupil
from torchmask.restoration.background import Background
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.result import RestorationResult
from torchmask.spectra import NoisePSD, PowerLawPSD
from torchmask.tracking import RunLogger, read_metrics
from torchmask.viz.figures import mask_figure

pytestmark = pytest.mark.usefixtures("coarse_figures")

DESIGN = ["design", "--n-subapertures", "4", "--fill-factor", "0.1", "--budget", "60", "--n-frequencies", "32"]
RULES = ["--min-gap", "0.05", "--central-obstruction", "0.3", "--spiders", "0", "0", "0", "0.5", "0.02"]
ARCSEC = np.pi / 180 / 3600


def run(*argv):
    """A command that does its work; a restoration of few iterations need not explain the frames."""
    status = main([str(argument) for argument in argv])
    assert status in ((0, NOT_EXPLAINED) if argv[0] == "restore" else (0,))


def contents(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A mask, a stack taken through it, and the image restored from that."""
    folder = tmp_path_factory.mktemp("runs")
    run(*DESIGN, *RULES, "--wavelength", "1e-6", "--seed", "3", "--out", folder / "design")
    mask = ["--mask", folder / "design" / "mask.json"]
    imaging = ["--wavelength", "1e-6", "--n-pixels", "32", "--n-frames", "3", "--r0", "0.3", "--seed", "5"]
    run("simulate", *mask, *imaging, "--out", folder / "simulate")
    run("restore", folder / "simulate" / "stack.npz", "--max-iterations", "12", "--out", folder / "restore")
    return folder


@pytest.fixture(scope="module")
def cube(runs):
    """The same stack as a telescope would hand it over: a FITS cube with sky coordinates, and no more."""
    frames = load_npz(runs / "simulate" / "stack.npz")["frames"]
    image = fits.PrimaryHDU(frames)
    cards = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 82.1875, "CRVAL2": -65.4487, "CRPIX1": 16.0}
    image.header.update(cards | {"CRPIX2": 16.0, "BUNIT": "electron", "OBJECT": "satellite"})
    image.writeto(runs / "cube.fits")
    return runs / "cube.fits"


def test_design_writes_a_mask_that_obeys_and_its_error(runs):
    folder = runs / "design"
    mask = load_mask(folder / "mask.json")
    check_mask(mask, 1e-9, [MinimumGap(0.05), KeepOutDisc(0.3), KeepOutSegment((0, 0), (0, 0.5), 0.02)])
    assert (mask.n_subapertures, mask.mask_diameter, mask.fill_factor) == (4, 1.0, pytest.approx(0.1, rel=1e-12))
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 1e-6, 32), PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["relative_mse"] == pytest.approx(float(criterion.relative(mask)), rel=1e-12)
    floor = criterion.relative_floor(1.0)
    assert metrics["relative_mse_above_floor"] == pytest.approx(metrics["relative_mse"] - floor, rel=1e-12)
    assert metrics["redundancy"]["n_baselines"] == 6
    assert {"mask.svg", "design_mask.png", "design_uv_coverage.png", "design_history.png"} <= {
        path.name for path in folder.iterdir()
    }
    assert {row["stage"] for row in read_metrics(folder)} == {"design/hybrid", "design/refine", "summary"}
    assert json.loads((folder / "status.json").read_text())["status"] == "finished"


def test_zones_that_holes_keep_clear_of_are_drawn_where_they_are(runs):
    """Points in pupil metres, inside and just outside the obstruction and the spider; the figure is in millimetres."""
    figure = mask_figure(load_mask(runs / "design/mask.json"))
    before = len(figure.axes[0].patches)
    draw_zones(figure, [KeepOutDisc(0.3), KeepOutSegment((0, 0), (0, 0.5), 0.02), MinimumGap(0.05)], 1000.0)
    disc, bar = figure.axes[0].patches[before:]
    for patch, x, y, inside in (
        *((disc, 149, 0, True), (disc, 0, -149, True), (disc, 151, 0, False)),
        *((bar, 9, 400, True), (bar, -9, 10, True), (bar, 11, 400, False), (bar, 0, 501, False), (bar, 0, -1, False)),
    ):
        assert patch.get_path().transformed(patch.get_patch_transform()).contains_point((x, y)) == inside, (x, y)


def test_the_config_reproduces_every_result(runs, tmp_path):
    for command in ("design", "simulate", "restore"):
        run(command, "--config", runs / command / "config.yaml", "--out", tmp_path / command)
        assert (tmp_path / command / "config.yaml").read_text() == (runs / command / "config.yaml").read_text()
    assert (tmp_path / "design/mask.json").read_text() == (runs / "design/mask.json").read_text()
    for name in ("simulate/stack.npz", "restore/restored.npz"):
        first, again = load_npz(runs / name), load_npz(tmp_path / name)
        for key in first.keys() - {"seconds"}:
            np.testing.assert_array_equal(first[key], again[key])


def test_an_option_beside_the_config_changes_that_alone(runs, tmp_path):
    run("simulate", "--config", runs / "simulate" / "config.yaml", "--seed", "6", "--out", tmp_path / "other")
    first, other = Observation.load(runs / "simulate/stack.npz"), Observation.load(tmp_path / "other/stack.npz")
    assert (first.grid, first.r0, first.n_photons) == (other.grid, other.r0, other.n_photons)
    assert bool((first.frames != other.frames).any())


def test_simulate_takes_its_units_as_they_are_called(runs, tmp_path):
    observation = Observation.load(runs / "simulate/stack.npz")
    assert torch.equal(observation.aperture.centers, load_mask(runs / "design/mask.json").centers)
    assert observation.grid == Grid.nyquist(1.0, 1e-6, 32)
    assert (observation.r0, observation.outer_scale, observation.readout_noise) == (0.3, 20.0, 1.5)
    telescope = ["--mask", "full", "--mask-diameter", "2.0", "--central-obstruction", "0.5"]
    telescope += ["--vane-width", "0.02", "--vane-angles", "45", "225"]
    sky = ["--pixel-scale-arcsec", "0.02", "--n-pixels", "16", "--n-frames", "1", "--r0", "inf"]
    run("simulate", *telescope, "--wavelength", "550e-9", *sky, "--out", tmp_path / "full")
    observation = Observation.load(tmp_path / "full/stack.npz")
    assert isinstance(observation.aperture, FullAperture)
    assert observation.aperture.shape == TelescopePupil(0.25, 0.01, (math.radians(45), math.radians(225)))
    assert (observation.aperture.mask_diameter, observation.aperture.central_obstruction) == (2.0, 0.25)
    assert observation.grid.pixel_scale == pytest.approx(0.02 * ARCSEC, rel=1e-12)
    assert observation.r0 is None


def test_restore_is_the_library_call_and_says_how_well_it_fits(runs):
    folder = runs / "restore"
    observation = Observation.load(runs / "simulate/stack.npz")
    method = MyopicDeconvolution(observation.aperture, observation.grid, readout_noise=1.5, max_iterations=12)
    expected = method.restore(observation.frames)
    found = RestorationResult.load(folder / "restored.npz")
    torch.testing.assert_close(found.object, expected.object, rtol=0, atol=0)
    with fits.open(folder / "restored.fits") as content:
        np.testing.assert_array_equal(content[0].data, expected.object.numpy())
        history = "".join(content[0].header["HISTORY"])
    assert "stack.npz" in history
    assert "max_iterations = 12" in history
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["chi_square"] == pytest.approx(float(expected.chi_square.mean()), rel=1e-12)
    assert metrics["score"] < metrics["mean_frame_score"] < 1
    assert {"restored.png", "comparison.png", "cost.png"} <= {path.name for path in folder.iterdir()}


def test_a_fits_cube_restores_to_the_same_image_with_its_sky(runs, cube, tmp_path):
    """A cube that says nothing of mask, wavelength and scale: the options stand for its header."""
    scale = Grid.nyquist(1.0, 1e-6, 32).pixel_scale / ARCSEC
    given = ["--mask", runs / "design/mask.json", "--wavelength", "1e-6", "--pixel-scale-arcsec", repr(scale)]
    known = ["--readout-noise", "1.5", "--max-iterations", "12"]
    run("restore", cube, *given, *known, "--out", tmp_path / "restore")
    found = RestorationResult.load(tmp_path / "restore/restored.npz").object
    expected = RestorationResult.load(runs / "restore/restored.npz").object
    # The pixel scale goes through arcseconds and back: twelve iterations do not blow up its rounding.
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6 * float(expected.max()))
    header = fits.getheader(tmp_path / "restore/restored.fits")
    assert (header["CTYPE1"], header["CRVAL1"], header["CRPIX1"], header["OBJECT"]) == (
        "RA---TAN",
        82.1875,
        16.0,
        "satellite",
    )
    assert str(cube) in "".join(header["HISTORY"])
    assert "score" not in json.loads((tmp_path / "restore/metrics.json").read_text())


def test_a_restored_image_is_viewed_with_the_directions_of_the_file_beside_it(runs, tmp_path, sky_cards):
    (unknown,) = view_path(runs / "restore/restored.npz").figures.values()
    assert not unknown.axes[0].texts
    (tmp_path / "restored.npz").write_bytes((runs / "restore/restored.npz").read_bytes())
    fits.PrimaryHDU(np.ones((32, 32)), fits.Header(sky_cards(0.3, 1e-7))).writeto(tmp_path / "restored.fits")
    (shown,) = view_path(tmp_path / "restored.npz").figures.values()
    assert {"E", "N"} <= {text.get_text() for text in shown.axes[0].texts}


def test_errors_of_a_cube_and_the_sky_are_those_of_the_library_call(runs, cube, tmp_path, capsys):
    observation = Observation.load(runs / "simulate/stack.npz")
    errors = (observation.frames.clamp(min=0) + 4.0).sqrt()
    with fits.open(cube) as content:
        content[0].header["PIXELSCL"] = observation.grid.pixel_scale / ARCSEC
        content[0].header["WAVELEN"] = 1e-6
        content.append(fits.ImageHDU(errors.numpy().copy(), name="ERR"))
        content.writeto(tmp_path / "cube.fits")
        content["ERR"].data[1, 2, 3] = 0
        content.writeto(tmp_path / "wrong.fits")
    known = ["--mask", runs / "design/mask.json", "--r0", "0.3", "--outer-scale", "20", "--max-iterations", "4"]
    sky, method = ["--sky", "2.5"], {"r0": 0.3, "outer_scale": 20.0, "max_iterations": 4}
    for given, weights, options in (([], errors, {}), (["--no-errors", *sky], None, {"background": 2.5})):
        run("restore", tmp_path / "cube.fits", *known, *given, "--out", tmp_path / f"run{len(given)}")
        found = RestorationResult.load(tmp_path / f"run{len(given)}/restored.npz")
        expected = MyopicDeconvolution(observation.aperture, observation.grid, **method, **options).restore(
            observation.frames, errors=weights
        )
        torch.testing.assert_close(found.object, expected.object, rtol=1e-6, atol=1e-6 * float(expected.object.max()))
    assert fits.getheader(tmp_path / "run3/restored.fits")["SKY"] == 2.5
    wrong = ["restore", tmp_path / "wrong.fits", *known]
    refused(wrong, tmp_path, capsys, r"wrong.fits: errors is not positive at 1 valid .* \(1, 2, 3\).* --no-errors")
    refused([*wrong, "--no-errors", "--sky", "-1"], tmp_path, capsys, "--sky is -1: it must be finite and at least 0")
    refused([*wrong, "--no-errors", "--wind", "9"], tmp_path, capsys, "for how long needs --exposure-time too")


def test_every_assumption_about_the_sky_has_its_word():
    words = get_args(get_args(get_type_hints(Options)["sky"])[1])
    assert set(words) == set(SKIES)
    assert set(SKIES.values()) == set(Background)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([], "--mask is missing"),
        (["--mask", "golay6"], "golay6 has no size of its own"),
        (["--mask", "keck_nirc2_9"], "give --wavelength"),
        (["--mask", "MASK"], "give --pixel-scale-arcsec"),
        (["--mask", "MASK", "--wavelength", "1e-6"], "give --pixel-scale-arcsec"),
        (
            ["--mask", "MASK", "--wavelength", "1e-6", "--pixel-scale-arcsec", "9"],
            r"--pixel-scale-arcsec 9 arcsec undersamples .* at most 0\.1\d+ arcsec",
        ),
        (["--mask", "MASK", "--wavelength", "550"], r"--wavelength is 550: .* 550 nm are 550e-9"),
        (["--mask", "MASK", "--pixel-scale-arcsec", "-0.1"], "--pixel-scale-arcsec is -0.1: .* in arcsec"),
        (
            ["--mask", "full", "--mask-diameter", "2", "--central-obstruction", "3"],
            "--central-obstruction is 3 m.* 2 m",
        ),
        (["--mask", "MASK", "--wavelength", "-1e-6", "--pixel-scale-arcsec", "0.1"], "--wavelength is -1e-06"),
        (["--mask", "MASK", "--mask-diameter", "2"], "--mask-diameter"),
        (["--mask", "MASK", "--central-obstruction", "0.1"], "--central-obstruction is for a full pupil"),
        (["--mask", "MASK", "--vane-angles", "0"], "--vane-angles is for a full pupil"),
        (
            ["--mask", "full", "--mask-diameter", "2", "--vane-width", "0.1"],
            r"--vane-width is 0.1 m and --vane-angles are \[\] degrees",
        ),
    ],
)
def test_what_a_cube_lacks_is_named(runs, cube, tmp_path, capsys, given, message):
    given = [runs / "design/mask.json" if word == "MASK" else word for word in given]
    refused(["restore", cube, *given], tmp_path, capsys, message)


def refused(argv, folder, capsys, message):
    """One line beside those of the progress, status 1, and no result folder."""
    assert main([*map(str, argv), "--out", str(folder / "new" / "run")]) == 1
    out, err = capsys.readouterr()
    assert len([line for line in err.splitlines() if not line.startswith("design/room ")]) == 1, err
    assert "Traceback" not in out + err
    assert re.search(message, err), err
    assert not (folder / "new").exists()


def test_bad_stacks_are_refused(runs, cube, tmp_path, capsys):
    stack = (runs / "simulate/stack.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(stack[: len(stack) // 2])
    (tmp_path / "cut.fits").write_bytes(cube.read_bytes()[:5000])
    fits.PrimaryHDU(np.ones((2, 2, 8, 8))).writeto(tmp_path / "four.fits")
    np.savez(tmp_path / "frames.npz", frames=np.ones((2, 8, 8)))
    full = ["--mask", "full", "--mask-diameter", "1", "--wavelength", "1e-6", "--pixel-scale-arcsec", "0.02"]
    refused(["restore"], tmp_path, capsys, "no stack to restore")
    refused(["restore", tmp_path / "none.npz"], tmp_path, capsys, "there is no file")
    refused(["restore", tmp_path / "none.fits", *full], tmp_path, capsys, "there is no file")
    refused(["restore", tmp_path / "cut.npz"], tmp_path, capsys, "cut.npz")
    refused(["restore", tmp_path / "cut.fits", *full], tmp_path, capsys, "cut.fits")
    refused(["restore", tmp_path / "four.fits", *full], tmp_path, capsys, r"shape \(2, 2, 8, 8\)")
    refused(["restore", tmp_path / "frames.npz"], tmp_path, capsys, "has no 'centers'")
    refused(["restore", runs / "simulate/stack.npz", "--crop", "8"], tmp_path, capsys, "--crop is for FITS")
    refused(["restore", *[runs / "simulate/stack.npz"] * 2, "--join"], tmp_path, capsys, "--join is for FITS")
    two = [tmp_path / "none.npz", tmp_path / "cut.npz", "--workers", "1"]
    refused(["restore", *two], tmp_path, capsys, r"2 of 2 stacks failed: none: there is no file.*; cut: .*cut\.npz")
    refused(["restore", *two, "--workers", "0"], tmp_path, capsys, "2 of 2 stacks failed")


def test_files_of_several_kinds_are_not_mixed(tmp_path, capsys):
    full = ["--mask", "full", "--mask-diameter", "1", "--wavelength", "1e-6"]
    for name, cards in (("a", {"FILTER": "K"}), ("b", {"FILTER": "H"}), ("c", {"FILTER": "K", "PIXELSCL": 0.03})):
        header = fits.Header({"PIXELSCL": 0.02, "BUNIT": "electron"} | cards)
        fits.PrimaryHDU(np.ones((16, 16)), header).writeto(tmp_path / f"{name}.fits")
    for other, message in (("b", "mix filters"), ("c", "mix pixel scales")):
        files = [tmp_path / "a.fits", tmp_path / f"{other}.fits"]
        refused(["restore", *files, "--join", *full], tmp_path, capsys, message)


@pytest.mark.filterwarnings("default:frames .* have less than half the light")
def test_a_cloud_is_told_by_all_that_a_restoration_leaves(runs, tmp_path, capsys):
    stack = Observation.load(runs / "simulate/stack.npz")
    dim = torch.tensor([1.0, 0.2, 1.0])[:, None, None]
    cloudy = dataclasses.replace(stack, frames=dim * stack.frames).take([0, 0, 1, 2])
    dataclasses.replace(cloudy, frame_numbers=()).save(tmp_path / "cloudy.npz")
    run("restore", tmp_path / "cloudy.npz", "--skip", "0", "--max-iterations", "2", "--out", tmp_path / "run")
    streams = capsys.readouterr()
    for told in (streams.out, streams.err):
        assert "frames [2] have less than half the light of the others, as through a cloud: " in told
    for name in ("metrics.json", "status.json"):
        assert json.loads((tmp_path / "run" / name).read_text())["clouded_frames"] == [2]
    header = fits.getheader(tmp_path / "run/restored.fits")
    assert (header["NCLOUD"], header["CLOUDED"]) == (1, "2")
    assert RestorationResult.load(tmp_path / "run/restored.npz").frame_numbers == (1, 2, 3)
    assert json.loads((runs / "restore/metrics.json").read_text())["clouded_frames"] == []
    clear = fits.getheader(runs / "restore/restored.fits")
    assert clear["NCLOUD"] == 0
    assert "CLOUDED" not in clear


def test_a_band_that_the_pixels_undersample_is_refused_before_any_work(runs, tmp_path, capsys):
    stack = runs / "simulate/stack.npz"
    given = ["restore", stack, "--wavelengths", "8e-7", "1e-6", "1.2e-6"]
    refused(given, tmp_path, capsys, r"undersamples an aperture .* at 8e-07 m")
    refused(
        ["simulate", "--mask", runs / "design/mask.json", "--wavelength", "8e-7", "--pixel-scale-arcsec", "0.1"],
        tmp_path,
        capsys,
        r"0\.1 arcsec undersamples",
    )


def test_impossible_requests_are_refused_and_leave_nothing(tmp_path, capsys):
    refused([*DESIGN, "--fill-factor", "0.9"], tmp_path, capsys, "cannot be packed|no mask|--fill-factor")
    refused([*DESIGN, "--central-obstruction", "0.99"], tmp_path, capsys, "no mask of 4 holes")
    refused([*DESIGN, "--min-gap", "-1"], tmp_path, capsys, "gap is -1.0")
    refused([*DESIGN, "--budget", "0"], tmp_path, capsys, "--budget is 0")
    refused(["simulate", "--mask", "none.json"], tmp_path, capsys, "there is no mask file none.json")
    dark = ["--wavelength", "2e-6", "--n-photons", "0"]
    refused(["simulate", "--mask", "keck_nirc2_9", *dark], tmp_path, capsys, "--n-photons is 0")
    (tmp_path / "bad.yaml").write_text("n_holes: 4")
    refused(
        ["design", "--config", tmp_path / "bad.yaml"], tmp_path, capsys, "unknown key n_holes; known keys are n_sub"
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["--imaging.d-over-r0", "0"], "--imaging.d-over-r0 is 0.0: it must be positive"),
        (["--imaging.outer-scale", "-1", "--imaging.diameter", "8"], r"scale is -1\.0: .* units of the diameter"),
        (["--imaging.diameter", "0"], "--imaging.diameter is 0.0"),
        (["--imaging.readout-noise", "-1"], "--imaging.readout-noise is -1.0"),
        (["--imaging.n-frames", "0"], "--imaging.n-frames is 0"),
        (["--imaging.n-pixels", "24"], "spans 1.75 pupil samples"),
        (["--restoration.n-modes", "-3"], "is -3: it must be"),
        (["--restoration.n-modes", "0"], "--restoration.n-modes is 0: it must be"),
        (["--restoration.n-modes", "1"], "--restoration.n-modes is 1: the piston of a single opening does not show"),
        (["--imaging.n-frames", "100000000"], "--imaging.n-frames is 100000000: that takes at least"),
        (["--restoration.max-iterations", "0"], "--restoration.max-iterations is 0"),
        (["--design.n-subapertures", "0"], "--design.n-subapertures is 0"),
        (["--design.fill-factor", "2"], "--design.fill-factor is 2.0"),
    ],
)
def test_codesign_refuses_before_it_searches(tmp_path, capsys, monkeypatch, given, message):
    def never(*_, **__):
        raise AssertionError("the search began")

    monkeypatch.setattr("torchmask.design.search.evolve", never)  # of the default method, cma
    assert main(["codesign", *given, "--out", str(tmp_path / "runs" / "first")]) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert re.search(message, err), err
    assert not (tmp_path / "runs").exists()


def test_nothing_is_overwritten(runs, capsys):
    before = contents(runs)
    for command in ("design", "simulate", "restore"):
        argv = [command, "--config", str(runs / command / "config.yaml"), "--out", str(runs / command)]
        assert main(argv) == 1
        assert f"{command}-2" in capsys.readouterr().err
    assert contents(runs) == before


def test_without_out_a_run_gets_a_folder_of_its_own(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    run(*DESIGN)
    (folder,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"design-\d{8}-\d{6}", folder.name)
    assert f"written to runs/{folder.name}" in capsys.readouterr().out


def interrupt_at(monkeypatch, stage, step):
    original = RunLogger.__call__

    def interrupting(self, record):
        original(self, record)
        if (record.stage, record.step) >= (stage, step):
            raise KeyboardInterrupt

    monkeypatch.setattr(RunLogger, "__call__", interrupting)


def told(capsys):
    return capsys.readouterr().out.strip().splitlines()[-1]


def test_a_restoration_ends_in_a_verdict(runs, tmp_path, capsys):
    """Few iterations explain nothing, and all is written all the same."""
    stack = runs / "simulate/stack.npz"
    for name, arguments, expected in (("few", ["--max-iterations", "12"], 3), ("many", ["--max-iterations", "600"], 0)):
        folder = tmp_path / name
        assert main(["restore", str(stack), *arguments, "--out", str(folder)]) == expected
        verdict = json.loads((folder / "status.json").read_text())["verdict"]
        assert verdict["explained"] == (expected == 0)
        assert told(capsys) == verdict["text"]
        assert verdict["text"].startswith("explained" if expected == 0 else "not explained")
        assert json.loads((folder / "metrics.json").read_text())["verdict"] == verdict
        assert str(RestorationResult.load(folder / "restored.npz").verdict) == verdict["text"]
        with fits.open(folder / "restored.fits") as hdus:
            header = hdus[0].header
            assert (header["EXPLAIND"], header["VERDICT"]) == (verdict["explained"], verdict["text"].split(":")[0])
            assert header["CHISQRED"] == pytest.approx(verdict["chi_square"])
            assert (header["CHISQRED"] <= header["CHISQLIM"]) == verdict["explained"]


def test_an_interrupted_search_leaves_its_best_mask(tmp_path, monkeypatch, capsys):
    interrupt_at(monkeypatch, "design/hybrid", 30)
    assert main([*DESIGN, *RULES, "--out", str(tmp_path / "run")]) == 130
    assert f"the results so far are in {tmp_path / 'run'}" in capsys.readouterr().err
    check_mask(load_mask(tmp_path / "run/mask.json"), 1e-9, [MinimumGap(0.05), KeepOutDisc(0.3)])
    assert json.loads((tmp_path / "run/status.json").read_text())["status"] == "interrupted"


def test_an_interrupted_restoration_leaves_the_image_it_reached(runs, tmp_path, monkeypatch, capsys):
    interrupt_at(monkeypatch, "restoration", 11)
    assert main(["restore", str(runs / "simulate/stack.npz"), "--out", str(tmp_path / "run")]) == 130
    told = capsys.readouterr().err
    assert told.endswith("torchmask restore: interrupted\n")
    assert "--resume" not in told  # there is nothing to go on from yet
    state = load_npz(tmp_path / "run/checkpoints/restoration.npz")
    assert state["object"].shape == (32, 32)
    monkeypatch.undo()
    run("view", tmp_path / "run", "--out", tmp_path / "state.png")
    assert "interrupted" in capsys.readouterr().out
    assert (tmp_path / "state.png").is_file()


def test_an_interrupted_restoration_goes_on_to_the_same_result(runs, tmp_path, monkeypatch, capsys):
    stack = [runs / "simulate/stack.npz", "--max-iterations", "205", "--tv-weight", "0.5"]
    run("restore", *stack, "--out", tmp_path / "whole")
    interrupt_at(monkeypatch, "restoration", 150)
    capsys.readouterr()
    assert main(["restore", *map(str, stack), "--out", str(tmp_path / "cut")]) == 130
    assert f"continue with: torchmask restore --resume {tmp_path / 'cut'}\n" in capsys.readouterr().err
    assert (tmp_path / "cut/resume.npz").is_file()
    assert not (tmp_path / "cut/restored.npz").exists()
    monkeypatch.undo()
    before = contents(tmp_path / "cut")
    run("restore", "--resume", tmp_path / "cut", "--out", tmp_path / "rest")
    assert contents(tmp_path / "cut") == before
    whole, rest = (load_npz(tmp_path / name / "restored.npz") for name in ("whole", "rest"))
    for key in whole.keys() - {"seconds"}:
        np.testing.assert_array_equal(whole[key], rest[key])
    interrupt_at(monkeypatch, "restoration", 110)  # before the resumed run has written a state of its own
    assert main(["restore", "--resume", str(tmp_path / "cut"), "--out", str(tmp_path / "again")]) == 130
    assert f"continue with: torchmask restore --resume {tmp_path / 'again'}\n" in capsys.readouterr().err
    assert load_npz(tmp_path / "again/resume.npz")["costs"].tolist() == whole["cost"][:100].tolist()
    monkeypatch.undo()
    steps = [row["step"] for row in read_metrics(tmp_path / "rest") if row["stage"] == "restoration"]
    assert steps == list(range(101, len(whole["cost"]) + 1))
    assert (tmp_path / "rest/config.yaml").read_text() == (tmp_path / "whole/config.yaml").read_text()
    # What cannot be gone on from: other settings, a run without a checkpoint, no run at all.
    capsys.readouterr()
    differing = r"cut/resume\.npz is of other frames or settings.*\(here --tv-weight is 2\.0, there 0\.5\)"
    refused(["restore", "--resume", tmp_path / "cut", "--tv-weight", "2"], tmp_path, capsys, differing)
    refused(["restore", "--resume", runs / "simulate"], tmp_path, capsys, "it is for simulate, not for restore")
    (tmp_path / "rest/resume.npz").unlink()
    refused(["restore", "--resume", tmp_path / "rest"], tmp_path, capsys, "no .*resume.npz to resume from")
    refused(["restore", "--resume", tmp_path / "none"], tmp_path, capsys, "there is no folder .*none: --resume goes on")


def test_a_resumed_restoration_is_one(runs, tmp_path, capsys):
    stacks = [runs / "simulate/stack.npz", tmp_path / "other.npz"]
    refused(["restore", *stacks, "--resume", runs / "restore"], tmp_path, capsys, "--resume continues one stack")


@pytest.fixture(scope="module")
def several(runs):
    """Two stacks of one name in two folders, and a damaged one between them, restored together."""
    first = runs / "simulate/stack.npz"
    (runs / "other").mkdir()
    second, damaged = runs / "other/stack.npz", runs / "damaged.npz"
    stack = Observation.load(first)
    dataclasses.replace(stack, frames=stack.frames.flip(0)).save(second)
    damaged.write_bytes(first.read_bytes()[:2000])
    argv = ["restore", first, damaged, second, "--max-iterations", "12", "--out", runs / "several"]
    assert main([str(word) for word in argv]) == 1
    return runs / "several"


def test_several_stacks_are_restored_each_as_by_itself_and_one_failure_harms_no_other(runs, several):
    alone = RestorationResult.load(runs / "restore/restored.npz")
    assert torch.equal(RestorationResult.load(several / "stack/restored.npz").object, alone.object)
    other = Observation.load(runs / "other/stack.npz")
    method = MyopicDeconvolution(other.aperture, other.grid, readout_noise=1.5, max_iterations=12)
    found = RestorationResult.load(several / "stack-2/restored.npz")
    assert torch.equal(found.object, method.restore(other.frames).object)
    with fits.open(several / "stack-2/restored.fits") as content:
        history = "".join(content[0].header["HISTORY"])
    assert str(runs / "other/stack.npz") in history
    assert "damaged" not in history
    table = json.loads((several / "metrics.json").read_text())
    assert set(table) == {"stack", "stack-2", "damaged"}
    assert table["stack-2"]["chi_square"] == pytest.approx(float(found.chi_square.mean()), rel=1e-12)
    assert "damaged.npz" in table["damaged"]["error"]
    assert {"stack_restored.png", "stack-2_restored.png"} <= {path.name for path in several.iterdir()}


def test_a_run_of_several_stacks_can_be_viewed(several, tmp_path, capsys):
    run("view", several, "--out", tmp_path / "first.png")
    out = capsys.readouterr().out
    assert f"2 stacks: {several / 'stack/restored.npz'}, {several / 'stack-2/restored.npz'}" in out
    assert "restored 32 x 32 pixels from 3 frames" in out
    assert (tmp_path / "first.png").is_file()


def test_what_failed_of_several_is_one_line_and_the_log_knows(several, capsys):
    status = json.loads((several / "status.json").read_text())
    assert status["status"] == "failed"
    assert "1 of 3 stacks failed: damaged: " in status["error"]
    again = ["--config", str(several / "config.yaml"), "--max-iterations", "2", "--workers", "1"]
    assert main(["restore", *again, "--out", f"{several}-again"]) == 1
    *summary, where, error = capsys.readouterr().err.splitlines()
    assert error.startswith("torchmask restore: error: 1 of 3 stacks failed: damaged: ")
    assert where == f"the results so far are in {several}-again"
    assert any(line.startswith("stack-2: restored 32 x 32 pixels") for line in summary)


def test_joined_fits_files_are_one_stack_and_others_one_each(runs, cube, tmp_path):
    frames = fits.getdata(cube)
    parts = [tmp_path / "first.fits", tmp_path / "second.fits"]
    for path, part in zip(parts, (frames[:1], frames[1:]), strict=True):
        fits.PrimaryHDU(part, fits.getheader(cube)).writeto(path)
    scale = Grid.nyquist(1.0, 1e-6, 32).pixel_scale / ARCSEC
    given = ["--mask", runs / "design/mask.json", "--wavelength", "1e-6", "--pixel-scale-arcsec", repr(scale)]
    given += ["--r0", "0.3", "--readout-noise", "1.5", "--max-iterations", "3", "--workers", "1"]
    run("restore", cube, *given, "--out", tmp_path / "cube")
    run("restore", *parts, "--join", *given, "--out", tmp_path / "joined")
    run("restore", *parts, *given, "--out", tmp_path / "each")
    whole, joined = (RestorationResult.load(tmp_path / name / "restored.npz") for name in ("cube", "joined"))
    assert torch.equal(whole.object, joined.object)
    counts = [len(RestorationResult.load(tmp_path / f"each/{path.stem}/restored.npz").model) for path in parts]
    assert counts == [1, 2]


def test_an_interruption_keeps_the_stacks_that_are_done(runs, tmp_path, monkeypatch, capsys):
    interrupt_at(monkeypatch, "stacks", 2)
    stack = str(runs / "simulate/stack.npz")
    argv = ["restore", stack, stack, stack, "--max-iterations", "2", "--workers", "1", "--out", str(tmp_path / "run")]
    assert main(argv) == 130
    assert f"the results so far are in {tmp_path / 'run'}" in capsys.readouterr().err
    assert sorted(path.parent.name for path in (tmp_path / "run").glob("*/restored.npz")) == ["stack"]


def test_a_config_of_version_0_1_still_says_the_same(runs, cube, tmp_path):
    """There, files were one stack; the key was stack."""
    stack = runs / "simulate/stack.npz"
    (tmp_path / "one.yaml").write_text(f"command: restore\nstack: [{stack}]\nmax_iterations: 12\n")
    run("restore", "--config", tmp_path / "one.yaml", "--out", tmp_path / "one")
    expected = RestorationResult.load(runs / "restore/restored.npz")
    assert torch.equal(RestorationResult.load(tmp_path / "one/restored.npz").object, expected.object)
    (tmp_path / "two.yaml").write_text(f"command: restore\nstack: [{cube}, {cube}]\n")
    options = load_config(tmp_path / "two.yaml", Options, "restore")
    assert (options.stacks, options.join) == ((cube, cube), True)


@pytest.mark.filterwarnings("default::UserWarning")
def test_a_warning_is_one_line_too(runs, tmp_path, capsys):
    wrong = ["--readout-noise", "5000", "--max-iterations", "2"]
    run("restore", runs / "simulate/stack.npz", *wrong, "--out", tmp_path / "run")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("torchmask restore: warning: ")
