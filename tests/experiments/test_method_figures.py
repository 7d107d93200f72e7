"""The experiments that show the method: tiny runs of each, and the parts of them that make statements."""

from __future__ import annotations

import json
import math

import asymptotic_limit
import mse_vs_n
import numpy as np
import optimal_masks
import pytest
import torch

from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.manufacture import load_mask
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.otf import analytic_otf
from torchmask.spectra import NoisePSD, PowerLawPSD

SCRIPTS = {"asymptotic_limit": asymptotic_limit, "optimal_masks": optimal_masks, "mse_vs_n": mse_vs_n}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """The folder that holds a tiny run of each script, and their common sweep."""
    runs = tmp_path_factory.mktemp("runs")
    for name, script in SCRIPTS.items():
        assert script.main(tiny(runs, name)) == 0
    return runs


def tiny(runs, name, sweep=None):
    """Arguments of a tiny run in this process."""
    return ["--smoke", "--workers", "1", "--sweep", str(sweep or runs / "sweep"), "--out", str(runs / name)]


def rows(finished, name):
    return json.loads((finished / name / f"{name}.json").read_text())["rows"]


@pytest.mark.parametrize("name", SCRIPTS)
def test_picture_numbers_and_table_are_written(finished, name):
    import matplotlib.image

    folder = finished / name
    picture = matplotlib.image.imread(folder / f"{name}.png")
    assert min(picture.shape[:2]) > 400
    assert len(np.unique((255 * picture).astype(np.uint8).view(np.uint32))) > 20  # colours, four bytes each
    stored = json.loads((folder / f"{name}.json").read_text())
    assert json.loads((folder / "config.json").read_text())["smoke"] is True
    table = [line for line in (folder / f"{name}.md").read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(stored["rows"]) + 2
    assert len({line.count("|") for line in table}) == 1


@pytest.mark.parametrize("name", SCRIPTS)
def test_nothing_is_overwritten(finished, name, capsys):
    before = {path: path.stat().st_mtime_ns for path in (finished / name).iterdir()}
    assert SCRIPTS[name].main(tiny(finished, name)) == 1
    assert f"{name} exists and is not overwritten: choose another, such as" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in (finished / name).iterdir()} == before


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_bad_setting_is_one_line(tmp_path, name, capsys):
    assert SCRIPTS[name].main([*tiny(tmp_path, "new/run"), "--workers", "0"]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"{name}: error: --workers is 0")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_finished_sweep_is_read_and_gives_the_same_numbers(finished, tmp_path):
    tasks = finished / "sweep" / "tasks"
    before = {path: path.stat().st_mtime_ns for path in tasks.iterdir()}
    assert asymptotic_limit.main(tiny(tmp_path, "again", finished / "sweep")) == 0
    assert {path: path.stat().st_mtime_ns for path in tasks.iterdir()} == before
    again = json.loads((tmp_path / "again" / "asymptotic_limit.json").read_text())["rows"]
    assert again == rows(finished, "asymptotic_limit")


def pistons(n_frames, n, seed):
    return asymptotic_limit.uniform_pistons(n_frames, n, torch.Generator().manual_seed(seed))


def test_overlaps_computed_once_give_the_closed_form_otf():
    grid = Grid.nyquist(1.0, 550e-9, (48, 40))
    mask = SparseAperture.from_catalog("golay9", 1.0, 0.12)
    angles = pistons(3, 9, 2)
    expected = analytic_otf(mask, grid, angles).abs() ** 2
    assert torch.allclose(asymptotic_limit.PistonOTFs(mask, grid).power(angles), expected, rtol=0, atol=1e-13)


def test_the_mean_over_pistons_is_the_transfer_of_the_criterion(golay6):
    """E|h|^2 = N^2 |h~|^2 + sum over baselines |h~|^2: with noise far above the signal MSE_a gives it back."""
    grid = Grid.nyquist(1.0, 550e-9, 32)
    nu = torch.hypot(*grid.frequencies(torch.float64))
    power = asymptotic_limit.PistonOTFs(golay6, grid).power(pistons(20_000, 6, 3))
    for band in ((nu > 0.1) & (nu < 0.3), nu > 0.3):
        noise = 1e8
        criterion = AsymptoticMSE(grid, band.double(), torch.full(grid.shape, noise).double(), 1)
        expected = float((1 - criterion.relative(golay6)) * noise)
        means = power[:, band].mean(-1)
        # 1 - S_n / (S_n + |h|^2) = |h|^2 / S_n less at most |h|^4 / S_n^2, |h| <= 1; the rest is rounding
        tolerance = 4 * float(means.std()) / math.sqrt(len(means)) + 1 / noise + 1e-15 * noise
        assert float(means.mean()) == pytest.approx(expected, abs=tolerance)
        assert tolerance < 0.02 * expected


def test_random_pistons_never_beat_the_limit_and_come_near_it(finished):
    found = [row for row in rows(finished, "asymptotic_limit") if row["model"] == "pistons"]
    assert {row["n_frames"] for row in found} == {1, 2, 4}
    for row in found:
        assert row["ratio"] == pytest.approx(row["wiener_mse"] / row["mse_a"], rel=1e-12)
        assert row["ratio"] > 1 - 4 * row["ratio_error"]
        assert row["n_draws"] == 4 * min(4 // row["n_frames"], 10)
    for name in ("Golay-6", "N = 4"):
        ratios = [row["ratio"] for row in found if row["mask"] == name]
        assert 1.001 < ratios[0] < 1.05
        assert abs(ratios[-1] - 1) < abs(ratios[0] - 1)


def test_the_limit_is_that_of_the_criterion(finished, golay6):
    grid = Grid.nyquist(1.0, 550e-9, 64)
    for row in rows(finished, "asymptotic_limit"):
        if row["mask"] == "Golay-6":
            criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), row["n_frames"])
            assert row["mse_a"] == pytest.approx(float(criterion.relative(golay6)), rel=1e-12)


def test_a_ratio_below_one_is_said_so():
    good = {"mask": "m", "model": "pistons", "n_frames": 1, "ratio": 1.03, "ratio_error": 0.001}
    screens = good | {"model": "von_karman", "sampling_error": -1e-3}
    assert "never below 1 within its error" in asymptotic_limit.findings(7.0, [good, screens])[0]
    bad = good | {"ratio": 0.99}
    assert "BELOW 1 BY MORE THAN ITS ERROR" in asymptotic_limit.findings(7.0, [good, bad, screens])[0]


def test_the_masks_of_the_gallery_are_those_of_its_numbers(finished):
    grid = Grid.nyquist(1.0, 550e-9, 64)
    criterion = AsymptoticMSE(grid, PowerLawPSD(1.5, 1e7), NoisePSD(1e7), 20)
    floor = criterion.relative_floor(1.0)
    found = rows(finished, "optimal_masks")
    assert [row["n_subapertures"] for row in found] == [3, 4, 5]
    for row in found:
        mask = load_mask(finished / "optimal_masks" / f"optimal_{row['n_subapertures']}.json")
        assert mask.fill_factor == pytest.approx(0.15, rel=1e-12)
        assert float(criterion.relative(mask)) == pytest.approx(row["relative_mse"], rel=1e-12)
        assert row["above_floor"] == pytest.approx(row["relative_mse"] - floor, rel=1e-9)
        assert row["scatter_of_seeds"] >= 0


def curve(values, scatter=0.0):
    """Rows of a made-up curve that starts at N = 3."""
    return [
        {"n_subapertures": n, "relative_mse": value, "scatter": scatter, "wiener_mse": value, "hole_over_r0": 1.0}
        | {"coherence_of_touching_holes": 0.1, "not_tried_in_turbulence": None}
        for n, value in enumerate(values, 3)
    ]


def test_a_curve_that_goes_up_is_said_so():
    options = mse_vs_n.Options()
    assert "The curve never goes up." in mse_vs_n.findings(options, curve([0.3, 0.2, 0.1]))
    up = curve([0.3, 0.2, 0.204, 0.1], scatter=0.01)
    assert mse_vs_n.rises(up) == [(4, 5, pytest.approx(0.02), 0.01)]
    assert any("goes up BEYOND the scatter of the searches: 4 to 5" in line for line in mse_vs_n.findings(options, up))
    up = curve([0.3, 0.2, 0.204, 0.1], scatter=0.03)
    assert any("goes up within the scatter" in line for line in mse_vs_n.findings(options, up))


def test_where_the_curve_flattens():
    falling = curve([0.1 + 0.5**k for k in range(12)])  # N = 3 to 14
    assert mse_vs_n.reached(falling, 0.5) == 4
    assert mse_vs_n.reached(falling, 0.51) == 5
    assert mse_vs_n.reached(falling, 0.0) == 3
    assert mse_vs_n.reached(falling, 1.0) == 14
    text = " ".join(mse_vs_n.findings(mse_vs_n.Options(), falling))
    assert "flattens between N = 6 and 9" in text
    assert "N = 11 is more than it takes: it has made 100 % of the drop" in text
    slower = curve([0.1 + 0.75**k for k in range(18)])  # N = 3 to 20
    assert "flattens between N = 10 and 15" in " ".join(mse_vs_n.findings(mse_vs_n.Options(), slower))
    assert "N = 11 is a reasonable choice: it has made 91 %" in " ".join(mse_vs_n.findings(mse_vs_n.Options(), slower))
    straight = curve([1 - 0.05 * k for k in range(18)])
    assert "N = 11 is too few" in " ".join(mse_vs_n.findings(mse_vs_n.Options(), straight))


def test_holes_too_large_for_the_turbulence_are_in_the_curve_but_not_measured(finished):
    found = {row["n_subapertures"]: row for row in rows(finished, "mse_vs_n")}
    assert found[3]["wiener_mse"] is None
    assert found[3]["not_tried_in_turbulence"] == "d/r0 is 1.57, above 1.5: fill_factor must be at most 0.1378"
    for n in (4, 5):
        assert found[n]["hole_over_r0"] == pytest.approx(7 * math.sqrt(0.15 / n), rel=1e-12)
        assert 0.95 < found[n]["wiener_mse"] / found[n]["relative_mse"] < 1.1
        coherence = math.exp(-6.0121 * found[n]["hole_over_r0"] ** (5 / 3) / 2)
        assert found[n]["coherence_of_touching_holes"] == pytest.approx(coherence, rel=1e-12)


def test_the_scripts_share_their_searches(tmp_path):
    search = ["--n-subapertures", "3", "--n-pixels", "64", "--budget", "20", "--workers", "1"]
    search += ["--sweep", str(tmp_path / "sweep")]
    assert optimal_masks.main([*search, "--out", str(tmp_path / "gallery")]) == 0
    searches = set((tmp_path / "sweep" / "tasks").iterdir())
    assert mse_vs_n.main([*search, "--d-over-r0", "3", "--n-draws", "2", "--out", str(tmp_path / "curve")]) == 0
    assert set((tmp_path / "sweep" / "tasks").glob("*search*")) == searches


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--frames"], "--frames is ()"),
        (["--frames", "5", "0"], "--frames is (5, 0)"),
        (["--d-over-r0", "0"], "--d-over-r0 is 0.0"),
        (["--outer-scale", "0"], "--outer-scale is 0.0"),
        (["--piston-stacks", "1"], "--piston-stacks is 1"),
        (["--n-pixels", "2"], "a sub-aperture"),
    ],
)
def test_what_could_not_be_drawn_is_told_before_the_search(tmp_path, capsys, options, message):
    out = ["--sweep", str(tmp_path / "sweep"), "--out", str(tmp_path / "run")]
    assert asymptotic_limit.main([*options, *out]) == 1
    assert capsys.readouterr().err.startswith(f"asymptotic_limit: error: {message}")
    assert not list(tmp_path.iterdir())
