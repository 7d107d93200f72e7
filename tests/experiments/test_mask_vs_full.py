"""The comparison of mask and full pupil: its physics, its statistics, and that nothing is computed twice."""

import dataclasses
import json
import math

import mask_vs_full as script
import mask_vs_full_report as report
import numpy as np
import pytest
import torch
from scipy import stats

from torchmask.cli.config import load_config
from torchmask.io import save_npz
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import zernike_basis

pytestmark = pytest.mark.usefixtures("coarse_figures")

CENTERS = [[0.4, 0.0], [-0.2, 0.3], [-0.2, -0.3]]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Holds the folder of a tiny run, first, and its sweep."""
    runs = tmp_path_factory.mktemp("runs")
    assert script.main(tiny(runs, "first")) == 0
    return runs


def tiny(runs, name):
    return ["--smoke", "--workers", "1", "--sweep", str(runs / "sweep"), "--out", str(runs / name)]


def task(**changes):
    values = {"centers": CENTERS, "subaperture_diameter": 0.2, "n_pixels": 64, "n_frames": 3, "iterations": 3}
    values |= {"n_photons": 1e6, "d_over_r0": 4.0, "outer_scale": 20.0, "readout_noise": 1.5, "seed": 3, "start": 0}
    return values | {"scene": {"path": None, "attitude": [25.0, -30.0, 15.0]}, "instrument": "mask"} | changes


def draw(instrument, seed, score, floor=0.1, d_over_r0=7.0, n_photons=1e6):
    own = {"instrument": instrument, "seed": seed, "scene": "satellite", "score": score, "floor": floor}
    return own | {"mean_frame": 0.8, "d_over_r0": d_over_r0, "n_photons": n_photons}


def draws(mask, full, **cell):
    pairs = zip(mask, full, strict=True)
    return [draw(w, k, s, **cell) for k, pair in enumerate(pairs) for w, s in zip(("mask", "full"), pair, strict=True)]


@pytest.mark.parametrize("which", ["mask", "full"])
def test_the_given_aberrations_make_the_point_spread_functions_of_the_frames(which):
    own = task(instrument=which)
    observation, coefficients = script.observe(own)
    aperture, grid = observation.aperture, observation.grid
    n_modes = script.TRUE_MODES[which]
    assert coefficients.shape == (3, aperture.n_subapertures, n_modes)
    samples = aperture.samples(grid, 4)
    basis = zernike_basis(samples, aperture, n_modes)

    def error(n):
        phase = torch.einsum("npj,tnj->tnp", basis[..., :n], coefficients[..., :n])
        psfs = psf_from_samples(samples, phase).roll((32, 32), dims=(-2, -1))[:, :64, :64]
        return float((psfs - observation.psfs).norm() / observation.psfs.norm())

    # What J modes leave of the variance (Noll 1976), 0.2944 J^-0.866 (d/r0)^(5/3), is the energy of the field that they
    # miss; an intensity errs by at most twice the root of it, and three draws scatter about that.
    left = 0.2944 * n_modes**-0.866 * (4 * aperture.outer_diameter) ** (5 / 3)
    assert error(n_modes) < 2 * math.sqrt(left)
    assert error(n_modes) < 0.5 * error(n_modes // 6) < 0.5 * error(1)


def test_fitted_modes_leave_nothing_that_they_explain():
    observation, _ = script.observe(task())
    aperture = observation.aperture
    samples = aperture.samples(observation.grid, 4)
    basis = zernike_basis(samples, aperture, 10)
    rest = observation.phases - torch.einsum("npj,tnj->tnp", basis, script.fit_modes(observation, 10))
    explained = torch.einsum("npj,np,tnp->tnj", basis, samples.weights, rest) / samples.weights.sum(-1)[..., None]
    assert float(explained.abs().max()) < 1e-9 * float(observation.phases.abs().max())


def test_the_full_pupil_reaches_as_far_and_gets_light_by_its_area():
    mask, full = (script.observe(task(instrument=which))[0] for which in ("mask", "full"))
    reach = max(math.dist(a, b) for a in CENTERS for b in CENTERS) + 0.2
    assert full.aperture.outer_diameter == pytest.approx(reach, rel=1e-12)
    assert full.n_photons / mask.n_photons == pytest.approx(reach**2 / (3 * 0.2**2), rel=1e-12)


def test_frames_turned_round_are_another_start_of_the_full_pupil():
    first, again, other = (script.measure(task(instrument="full", start=start)) for start in (0, 0, 1))
    assert first["score"] == again["score"]
    assert abs(first["chi_square"] / other["chi_square"] - 1) > 1e-6
    assert first["mean_frame"] == pytest.approx(other["mean_frame"], rel=1e-9)


def test_the_ratio_is_that_of_a_paired_t_test_of_logarithms():
    rng = np.random.default_rng(0)
    mask, full = np.exp(rng.normal(-2, 0.5, 6)), np.exp(rng.normal(-1.8, 0.5, 6))
    (cell,) = report.summarise(draws(mask, full))
    test = stats.ttest_rel(np.log(mask), np.log(full))
    low, high = test.confidence_interval(report.CONFIDENCE)
    assert cell["ratio"] == pytest.approx(stats.gmean(mask) / stats.gmean(full), rel=1e-12)
    assert (cell["ratio_low"], cell["ratio_high"]) == pytest.approx((math.exp(low), math.exp(high)), rel=1e-9)
    assert (cell["verdict"] is None) == (test.pvalue > 1 - report.CONFIDENCE)
    assert cell["mask_blindness"] == pytest.approx(stats.gmean(mask) / 0.1, rel=1e-12)


def test_who_wins_is_computed():
    rows = draws([0.10, 0.12, 0.08], [0.20, 0.25, 0.15], n_photons=1e7)
    rows += draws([0.30, 0.32, 0.28], [0.20, 0.20, 0.19], n_photons=1e5)
    rows += draws([0.1, 0.3, 0.2], [0.2, 0.1, 0.3], n_photons=1e6)
    rows += draws([0.1], [0.9], n_photons=1e4)
    cells = report.summarise(rows)
    assert [cell["verdict"] for cell in cells] == ["mask", "full", None, None]
    lines = report.findings(cells)
    for line, words in zip(lines, ("the mask wins", "the full pupil wins", "undecided.", "(one draw)"), strict=False):
        assert words in line
    assert "the mask wins 1, the full pupil 1, and 2 are undecided" in lines[-1]
    report.figure(cells)  # the unlimited interval of one draw is drawn too


def test_everything_is_in_the_folder(runs):
    folder = runs / "first"
    assert all((folder / f"mask_vs_full.{end}").is_file() for end in ("json", "md", "png"))
    assert load_config(folder / "config.yaml", script.Options, "mask_vs_full").photons == (1e5, 1e6)
    record = json.loads((folder / "mask_vs_full.json").read_text())
    assert len(record["rows"]) == 2 * 2 * 2  # photons, seeds, instruments
    for row in record["rows"]:
        assert len(row["scores_of_starts"]) == 1
        assert row["score"] in row["scores_of_starts"]
        assert 0 < row["floor"] < row["mean_frame"]
    text = (folder / "mask_vs_full.md").read_text()
    assert all(line in text for line in record["findings"])


def test_a_second_run_computes_nothing_and_a_wider_one_only_what_is_new(runs, monkeypatch):
    done = len(list(runs.glob("sweep/tasks/mask_vs_full-*.json")))
    calls = []

    def counted(task):
        calls.append(task)
        return {"score": 0.5, "mean_frame": 0.9, "chi_square": 1.0, "iterations": 1, "converged": True, "seconds": 0.0}

    monkeypatch.setattr(script, "measure", counted)
    assert script.main(tiny(runs, "again")) == 0
    assert calls == []
    first, second = (json.loads((runs / name / "mask_vs_full.json").read_text()) for name in ("first", "again"))
    assert first["rows"] == second["rows"]
    preset = script.with_presets
    wider = (1e5, 1e6, 1e7)
    monkeypatch.setattr(script, "with_presets", lambda options: dataclasses.replace(preset(options), photons=wider))
    assert script.main(tiny(runs, "wider")) == 0
    assert len(calls) == done // 2  # one more number of photons beside two
    assert {call["n_photons"] for call in calls} == {1e7}


def test_an_interrupted_run_keeps_what_is_done(monkeypatch, tmp_path, capsys):
    count = 0

    def stopping(task):
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt
        return {"score": 0.5, "mean_frame": 0.9, "chi_square": 1.0, "iterations": 1, "converged": True, "seconds": 0.0}

    monkeypatch.setattr(script, "measure", stopping)
    monkeypatch.setattr(script, "choose_mask", lambda options, callback: script.instrument(task()))
    assert script.main(tiny(tmp_path, "stopped")) == 130
    assert f"with --sweep {tmp_path / 'sweep'} the next run goes on from there" in capsys.readouterr().err
    assert len(list((tmp_path / "sweep" / "tasks").glob("*.json"))) == 3
    assert json.loads((tmp_path / "stopped" / "status.json").read_text())["status"] == "interrupted"
    assert not (tmp_path / "stopped" / "mask_vs_full.json").exists()


def test_a_scene_counts_by_its_content(tmp_path):
    path = tmp_path / "scene.npz"
    save_npz(path, {"image": np.eye(8)})
    options = script.Options(scenes=(path,), views=1)
    before = script.scenes(options)["scene.npz"]
    save_npz(path, {"image": np.ones((8, 8))}, replace=True)
    assert script.scenes(options)["scene.npz"]["sha256"] != before["sha256"]
    assert script.observe(task(scene=before))[0].n_photons == pytest.approx(1e6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--full", "--smoke"], "choose one"),
        (["--photons"], "photons is ()"),
        (["--photons", "0"], "--photons is 0.0"),
        (["--d-over-r0", "7", "0"], "--d-over-r0 is 0.0"),
        (["--outer-scale", "-1"], "--outer-scale is -1.0"),
        (["--readout-noise", "-1"], "--readout-noise is -1.0"),
        (["--n-pixels", "4"], "take an image at least"),
        (["--fill-factor", "3"], "--fill-factor is 3.0"),
        (["--seeds", "1", "1"], "none twice"),
        (["--views", "0"], "--views is 0"),
        (["--restarts", "0"], "--restarts is 0"),
        (["--restarts", "11"], "10 frames"),
        (["--scenes", "none.obj"], "none.obj"),
        (["--scenes", "a/x.obj", "b/x.obj"], "a name of its own"),
        (["--mask", "none.json"], "none.json"),
        (["--workers", "0"], "--workers is 0"),
    ],
)
def test_what_cannot_run_is_one_line_before_any_work(tmp_path, capsys, options, message):
    out = ["--sweep", str(tmp_path / "sweep"), "--out", str(tmp_path / "runs" / "bad")]
    assert script.main([*options, *out]) == 1
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_never_touched(runs, capsys):
    before = {path: path.stat().st_mtime_ns for path in (runs / "first").iterdir()}
    assert script.main(tiny(runs, "first")) == 1
    assert "first exists and is not overwritten" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in (runs / "first").iterdir()} == before


def test_the_whole_grid_is_the_one_asked_for():
    options = script.with_presets(script.Options(full=True))
    assert (min(options.photons), max(options.photons)) == (1e4, 1e8)
    assert (min(options.d_over_r0), max(options.d_over_r0)) == (3, 15)
    assert len(options.seeds) >= 5
