"""torchmask design: the rules of a telescope, what the workshop gets, and what is said of holes, noise and units."""

import json
import math
import re

import pytest
import torch
from ezdxf import readfile

from torchmask.cli import design, rank, table
from torchmask.cli.design import Options, warn_of_wide_holes
from torchmask.cli.main import main
from torchmask.design.constraint_base import Infeasible
from torchmask.design.constraints import KeepOutDisc, RimMargin, check_mask
from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import load_mask, mask_wavelength
from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table
from torchmask.design.tolerance import machining_tolerance
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.numbers import require_wavelength
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.pixel import SquarePixel
from torchmask.spectra import NoisePSD, PowerLawPSD

pytestmark = pytest.mark.usefixtures("coarse_figures")

SMALL = ["design", "--n-subapertures", "4", "--fill-factor", "0.1", "--budget", "60", "--n-frequencies", "32"]
ZONES = ["--rim-margin", "0.03", "--keep-out", "0.2", "0.1", "0.15", "-0.2", "0.1", "0.1"]
SEEN = ["--r0", "0.2", "--wavelength", "550e-9"]
NOISE = ["--n-photons", "1e5", "--readout-noise", "5", "--n-pixels", "48"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "design"
    assert (
        main([*SMALL, *ZONES, *NOISE, "--r0", "0.5", "--wavelength", "550e-9", "--scale", "10", "--out", str(out)]) == 0
    )
    return out


def test_zones_and_margin_are_kept(folder):
    rules = [RimMargin(0.03), KeepOutDisc(0.15, (0.2, 0.1)), KeepOutDisc(0.1, (-0.2, 0.1))]
    check_mask(load_mask(folder / "mask.json"), 1e-9, rules)


def test_files_for_the_workshop_hold_the_same_mask_at_the_scale(folder):
    mask = load_mask(folder / "mask.json")
    for name in ("mask.dxf", "mask.fits"):
        torch.testing.assert_close(load_mask(folder / name).centers, mask.centers, rtol=0, atol=1e-12)
    (rim,) = readfile(folder / "mask.dxf").modelspace().query('CIRCLE[layer=="OUTLINE"]')
    assert rim.dxf.radius == pytest.approx(5.0, rel=1e-12)  # of a disc of 1 m at 10 mm a metre
    assert 'r="5.0"' in (folder / "mask.svg").read_text()


def test_metrics_are_of_the_detector_and_of_the_workshop(folder):
    metrics = json.loads((folder / "metrics.json").read_text())
    mask = load_mask(folder / "mask.json")
    noise = torch.tensor(1e5 + 48**2 * 25, dtype=torch.float64)
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 32), PowerLawPSD(1.5, 1e5), noise, 20)
    assert metrics["relative_mse"] == pytest.approx(float(criterion.relative(mask)), rel=1e-12)
    expected = machining_tolerance(criterion, mask, 0.01, quantile=0.95, generator=torch.Generator().manual_seed(0))
    assert metrics["machining"] == {
        "error_of": "both",
        "growth_of_mse": 0.01,
        "success_probability": 0.95,
        "rms_error_tolerated": expected.rms,
        "rms_error_tolerated_standard_error": expected.error,
    }
    assert {name: metrics["units"][name] for name in ("mse", "largest_gap", "fwhm", "rms_error_tolerated")} == {
        "mse": "electrons^2",
        "largest_gap": "m",
        "fwhm": "wavelength / mask_diameter",
        "rms_error_tolerated": "m",
    }
    named = {**metrics, **metrics["redundancy"], **metrics["machining"], **metrics["detector"]}
    assert set(metrics["units"]) <= {*named, "all others"}
    field = 48 * 550e-9 / 2 * 180 * 3600 / math.pi  # arcsec, of pixels of wavelength / (2 D)
    assert metrics["detector"] == {"n_pixels": 48, "field_arcsec": pytest.approx(field, rel=1e-12)}
    assert metrics["hole_over_r0"] == pytest.approx(math.sqrt(0.1 / 4) / 0.5, rel=1e-12)


@pytest.mark.parametrize("module", [design, rank, table])
def test_the_error_does_not_depend_on_the_frequencies_but_by_sampling(module, tmp_path, monkeypatch):
    """Counted on their grid, the noise of 5 electrons would be 64 times as large at 512 as at 64.

    The sampling error of a mean of the same smooth kind is that of the object's PSD; a ratio has it twice.
    """
    mask, values, means = SparseAperture.from_catalog("golay9", 1.0, 0.15), {}, {}
    for n_frequencies in (64, 128, 512):
        criterion = criterion_of(module, n_frequencies, tmp_path, monkeypatch)
        values[n_frequencies], means[n_frequencies] = float(criterion.relative(mask)), criterion.object_psd.mean()
    for coarse in (64, 128):
        error = abs(float(means[coarse] / means[512]) - 1)
        assert error < 0.01
        assert values[coarse] == pytest.approx(values[512], rel=2 * error)


def criterion_of(module, n_frequencies, folder, monkeypatch):
    """The criterion of a command for 1e5 photons and 5 electrons, on a grid."""
    noise = {"readout_noise": 5.0, "n_pixels": 128}
    if module is not table:
        options = module.Options(n_photons=1e5, **noise)
        return options.observation(n_frequencies, 0.15).criterion()
    used = []

    def note(criterion, *_, **__):
        used.append(criterion)
        raise Infeasible("only its criterion is asked for")

    monkeypatch.setattr("torchmask.design.table.search_mask", note)
    space = DesignSpace(
        n_subapertures=(9,), n_photons=(1e5,), n_frequencies=n_frequencies, diameter_over_r0=(), **noise
    )
    design_table(space, folder, n_workers=1)
    return used[-1]


@pytest.mark.parametrize(("r0", "enough"), [(0.05, 60), (0.1, 15)])
def test_wide_holes_are_warned_of_with_the_number_that_is_enough(r0, enough):
    options = Options(n_subapertures=6)  # 0.158 m in 1 m at 0.15
    with pytest.warns(UserWarning, match=rf"{math.sqrt(0.15 / 6) / r0:.2f} r0 wide.* {enough} holes") as said:
        warn_of_wide_holes(options, r0)
    assert len(said) == 1
    warn_of_wide_holes(Options(n_subapertures=enough), r0)  # as wide as r0: an error here would fail the test


@pytest.mark.parametrize("command", [SMALL, ["rank", "golay6"], ["simulate", "--mask", "keck_nirc2_9"]])
@pytest.mark.parametrize(
    ("r0", "nearest"), [("0", "0.001 m"), ("-1", "0.001 m"), ("1e-5", "0.001 m"), ("120", "20 m"), ("nan", "")]
)
def test_an_impossible_r0_is_refused_with_the_nearest_possible(command, r0, nearest, tmp_path, capsys):
    out = ["--wavelength", "2e-6", "--out", str(tmp_path / "new")]
    assert main([*command, "--r0", r0, *out]) == 1
    said = capsys.readouterr().err.strip()
    assert "--r0 is" in said
    assert "must be from 0.001 to 20 m" in said
    assert said.endswith(f"the nearest possible is {nearest}") == bool(nearest)
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("550", r"--wavelength is 550: .* in m, .*; 550 nm are 550e-9"),
        ("2.2", r"--wavelength is 2\.2: .*; 2\.2 micrometres are 2\.2e-6"),
        (
            "-550e-9",
            r"--wavelength is -5\.5e-07: it must be a wavelength of light in m, from 1e-0[78] to (0\.01|5e-05); ",
        ),
        ("0", "--wavelength is 0:"),
        ("nan", "--wavelength is nan:"),
    ],
)
@pytest.mark.parametrize("command", [SMALL, ["simulate", "--mask", "keck_nirc2_9"]])
def test_wavelengths_that_are_none_are_named(command, given, said, tmp_path, capsys):
    assert main([*command, "--wavelength", given, "--out", str(tmp_path / "new")]) == 1
    assert re.search(said, capsys.readouterr().err.strip())
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize("command", ["design", "rank", "table"])
def test_what_holds_at_a_wavelength_only_needs_one(command, tmp_path, capsys):
    """No default stands in for it: r0, pixels and bands of one wavelength are those of another at another."""
    out = [str(tmp_path / "new")] if command == "table" else ["--out", str(tmp_path / "new")]
    pixels = ["--pixel-scale-arcsec", "0.05"]
    given = [pixels, ["--criterion", "turbulent", "--wavelengths", "500e-9", "600e-9"]]
    for words in given if command == "table" else [*given, ["--r0", "0.1"]]:
        assert main([command, *out, *words]) == 1
        said = capsys.readouterr().err
        assert "wavelength is missing" in said, words
        assert words[-2 if words[0] != "--criterion" else 2] in said
        assert not (tmp_path / "new").exists()


def test_a_mask_for_no_wavelength_is_that_of_any_and_says_none(tmp_path, capsys):
    few = [*SMALL, "--budget", "20", "--no-refine"]
    assert main([*few, "--out", str(tmp_path / "none")]) == 0
    assert main([*few, "--wavelength", "2.2e-6", "--out", str(tmp_path / "one")]) == 0
    masks = [load_mask(tmp_path / name / "mask.json").centers for name in ("none", "one")]
    torch.testing.assert_close(*masks, rtol=0, atol=1e-9)
    assert [mask_wavelength(tmp_path / name / "mask.json") for name in ("none", "one")] == [None, 2.2e-6]
    capsys.readouterr()
    assert main(["simulate", "--mask", str(tmp_path / "none" / "mask.json")]) == 1
    assert "--wavelength is missing" in capsys.readouterr().err


def test_a_filter_tells_the_wavelength(tmp_path):
    options = Options(filter="bessell-V", criterion="turbulent", r0=0.1)
    assert options.observing_wavelength() == pytest.approx(550e-9, rel=0.02)
    assert Options(filter="bessell-V", wavelength=540e-9).observing_wavelength() == 540e-9
    assert options.observation(32, 0.1).grid.wavelength == options.observing_wavelength()


def test_few_wavelengths_of_a_filter_are_warned_of():
    with pytest.warns(UserWarning, match="n_wavelengths is 2 for a band .* 3 wavelengths do"):
        Options(filter="bessell-V", n_wavelengths=2, criterion="turbulent", r0=0.1).conditions(550e-9, 0.1)
    Options(filter="bessell-V", n_wavelengths=3, criterion="turbulent", r0=0.1).conditions(550e-9, 0.1)


@pytest.mark.parametrize("number", ["1", "2"])
def test_holes_are_counted_in_english(number, tmp_path, capsys):
    few = ["design", "--n-subapertures", number, "--fill-factor", "0.1", "--n-frequencies", "32", "--budget", "40"]
    assert main([*few, "--out", str(tmp_path / "run")]) == 0
    assert f"\n{number} hole{'s' * (number != '1')} of " in capsys.readouterr().out


@pytest.mark.parametrize("wavelength", [91e-9, 550e-9, 10.5e-6, 1.3e-3])
def test_wavelengths_of_light_pass(wavelength):
    require_wavelength("--wavelength", wavelength)


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (["--rim-margin", "-0.1"], "--rim-margin is -0.1"),
        (["--rim-margin", "0.45"], r"cannot fit into a disc of 0\.1 m"),
        (["--keep-out", "0", "0", "-1"], "--keep-out has a disc whose diameter is -1"),
        (["--scale", "0"], "--scale is 0"),
        (["--n-pixels", "0"], "--n-pixels is 0"),
        (["--keep-out", "300", "100", "200"], "--keep-out has a disc 300 100 200: it lies outside the mask, of 1 m"),
        (["--spiders", "5", "5", "8", "8", "0.1"], "--spiders has a bar 5 5 8 8 0.1: it lies outside the mask"),
        (["--mask-diameter", "8200"], "--mask-diameter is 8200.0: it must be from 0.001 to 1000 m .* 8.2 m are 8.2"),
        (["--wavelength", "550e-6"], "--wavelength is 0.00055: .* from 1e-07 to 5e-05"),
    ],
)
def test_what_cannot_be_is_refused_before_any_work(option, said, tmp_path, capsys):
    assert main([*SMALL, *option, "--out", str(tmp_path / "new")]) == 1
    assert re.search(said, capsys.readouterr().err)
    assert not (tmp_path / "new").exists()


def test_a_mask_is_searched_under_turbulence(tmp_path):
    out = tmp_path / "run"
    few = ["--no-refine", "--method", "cma", "--budget", "20", "--criterion", "turbulent"]
    seeing = ["--wavelength", "550e-9", "--r0", "0.2", "--outer-scale", "20", "--sky", "2", "--pixel-fill", "1"]
    assert main([*SMALL, *NOISE, *few, *seeing, "--out", str(out)]) == 0
    grid, noise = Grid.nyquist(1.0, 550e-9, 32), NoisePSD(1e5, 5.0, 48**2)
    seen = {"r0": 0.2, "outer_scale": 20.0, "pixel": SquarePixel(1.0), "sky": 2.0}
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), noise, 20, **seen)
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["machining"]["error_of"] == "both"
    assert metrics["relative_mse"] == pytest.approx(float(criterion.relative(load_mask(out / "mask.json"))), rel=1e-6)


def test_options_of_turbulence_are_those_of_the_criterion():
    given = {"criterion": "turbulent", "r0": 0.2, "exposure_time": 2e-3}
    exposure = Options(**given, wind=(10.0,), wavelengths=(530e-9, 570e-9)).turbulence(550e-9, 0.1)
    assert (exposure["exposure"], exposure["wind"]) == (2e-3, 10.0)
    assert exposure["outer_scale"] == math.inf
    assert (exposure["wavelengths"], exposure["weights"]) == ((530e-9, 570e-9), None)
    assert Options(**given, wind=(3.0, 4.0)).turbulence(550e-9, 0.1)["wind"] == (3.0, 4.0)
    assert Options(r0=0.2).turbulence(550e-9, 0.1) is None


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--criterion", "turbulent"], "needs --r0"),
        (["--sky", "3"], "--sky needs --criterion turbulent"),
        (["--outer-scale", "20", *SEEN], "--outer-scale needs --criterion turbulent"),
        (["--criterion", "turbulent", *SEEN, "--wind", "1", "2", "3"], "--wind has 3 numbers"),
        (["--criterion", "turbulent", *SEEN, "--exposure-time", "1e-3"], "without wind"),
    ],
)
def test_turbulence_that_cannot_be_is_refused(given, said, tmp_path, capsys):
    assert main([*SMALL, *given, "--out", str(tmp_path / "run")]) != 0
    assert said in capsys.readouterr().err
