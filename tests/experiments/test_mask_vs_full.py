"""The comparison of mask and full pupil: its physics, its statistics, and that nothing is computed twice."""

import dataclasses
import importlib.util
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.io import save_npz
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.zernike import zernike_basis

PATH = Path(__file__).parents[2] / "experiments" / "mask_vs_full.py"
CENTERS = [[0.4, 0.0], [-0.2, 0.3], [-0.2, -0.3]]


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("mask_vs_full", PATH)
    module = importlib.util.module_from_spec(spec)
    sys.modules["mask_vs_full"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["mask_vs_full"]


@pytest.fixture(scope="module")
def finished(script, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    config = script.Config(smoke=True, name="first", runs=folder, sweep=folder / "sweep", workers=1)
    assert script.main(config) == 0
    return config


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
def test_the_given_aberrations_make_the_point_spread_functions_of_the_frames(script, which):
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


def test_recording_changes_no_screen_and_leaves_nothing_that_its_modes_explain(script):
    observation, _ = script.observe(task())
    aperture = observation.aperture
    samples = aperture.samples(observation.grid, 4)
    recorded = script.RecordedTurbulence(0.25, 20.0, aperture, 10)
    phase = recorded(samples, 3, torch.Generator().manual_seed(5))
    torch.testing.assert_close(phase, TurbulencePhase(0.25, 20.0)(samples, 3, torch.Generator().manual_seed(5)))
    basis = zernike_basis(samples, aperture, 10)
    rest = phase - torch.einsum("npj,tnj->tnp", basis, recorded.coefficients)
    explained = torch.einsum("npj,np,tnp->tnj", basis, samples.weights, rest) / samples.weights.sum(-1)[..., None]
    assert float(explained.abs().max()) < 1e-9 * float(phase.abs().max())


def test_the_full_pupil_reaches_as_far_and_gets_light_by_its_area(script):
    mask, full = (script.observe(task(instrument=which))[0] for which in ("mask", "full"))
    reach = max(math.dist(a, b) for a in CENTERS for b in CENTERS) + 0.2
    assert full.aperture.outer_diameter == pytest.approx(reach, rel=1e-12)
    assert full.n_photons / mask.n_photons == pytest.approx(reach**2 / (3 * 0.2**2), rel=1e-12)


def test_frames_turned_round_are_another_start_of_the_full_pupil(script):
    first, again, other = (script.measure(task(instrument="full", start=start)) for start in (0, 0, 1))
    assert first["score"] == again["score"]
    assert abs(first["chi_square"] / other["chi_square"] - 1) > 1e-6
    assert first["mean_frame"] == pytest.approx(other["mean_frame"], rel=1e-9)


def test_the_ratio_is_that_of_a_paired_t_test_of_logarithms(script):
    rng = np.random.default_rng(0)
    mask, full = np.exp(rng.normal(-2, 0.5, 6)), np.exp(rng.normal(-1.8, 0.5, 6))
    (cell,) = script.summarise(draws(mask, full))
    test = stats.ttest_rel(np.log(mask), np.log(full))
    low, high = test.confidence_interval(script.CONFIDENCE)
    assert cell["ratio"] == pytest.approx(stats.gmean(mask) / stats.gmean(full), rel=1e-12)
    assert (cell["ratio_low"], cell["ratio_high"]) == pytest.approx((math.exp(low), math.exp(high)), rel=1e-9)
    assert (cell["verdict"] is None) == (test.pvalue > 1 - script.CONFIDENCE)
    assert cell["mask_blindness"] == pytest.approx(stats.gmean(mask) / 0.1, rel=1e-12)


def test_who_wins_is_computed(script):
    rows = draws([0.10, 0.12, 0.08], [0.20, 0.25, 0.15], n_photons=1e7)
    rows += draws([0.30, 0.32, 0.28], [0.20, 0.20, 0.19], n_photons=1e5)
    rows += draws([0.1, 0.3, 0.2], [0.2, 0.1, 0.3], n_photons=1e6)
    rows += draws([0.1], [0.9], n_photons=1e4)
    cells = script.summarise(rows)
    assert [cell["verdict"] for cell in cells] == ["mask", "full", None, None]
    lines = script.findings(cells)
    for line, words in zip(lines, ("the mask wins", "the full pupil wins", "undecided.", "(one draw)"), strict=False):
        assert words in line
    assert "the mask wins 1, the full pupil 1, and 2 are undecided" in lines[-1]
    script.figure(cells)  # the unlimited interval of one draw is drawn too


def test_everything_is_in_the_folder(script, finished):
    folder = finished.runs / "first"
    assert sorted(path.name for path in folder.iterdir()) == [f"mask_vs_full.{end}" for end in ("json", "md", "png")]
    record = json.loads((folder / "mask_vs_full.json").read_text())
    assert len(record["rows"]) == 2 * 2 * 2  # photons, seeds, instruments
    for row in record["rows"]:
        n_starts = 1 if row["instrument"] == "mask" else finished.restarts
        assert len(row["scores_of_starts"]) == n_starts
        assert row["score"] in row["scores_of_starts"]
        assert 0 < row["floor"] < row["mean_frame"]
    text = (folder / "mask_vs_full.md").read_text()
    assert all(line in text for line in record["findings"])


def test_a_second_run_computes_nothing_and_a_wider_one_only_what_is_new(script, finished, monkeypatch):
    done = len(list(finished.sweep.glob("tasks/mask_vs_full-*.json")))
    calls = []

    def counted(task):
        calls.append(task)
        return {"score": 0.5, "mean_frame": 0.9, "chi_square": 1.0, "iterations": 1, "converged": True, "seconds": 0.0}

    monkeypatch.setattr(script, "measure", counted)
    again = {**vars(finished), "name": "again"}
    assert script.main(script.Config(**again)) == 0
    assert calls == []
    first, second = (json.loads((finished.runs / n / "mask_vs_full.json").read_text()) for n in ("first", "again"))
    assert first["rows"] == second["rows"]
    preset = script.with_presets
    wider = (1e5, 1e6, 1e7)
    monkeypatch.setattr(script, "with_presets", lambda config: dataclasses.replace(preset(config), photons=wider))
    assert script.main(script.Config(**{**again, "name": "wider"})) == 0
    assert len(calls) == done // 2  # one more number of photons beside two
    assert {call["n_photons"] for call in calls} == {1e7}


def test_an_interrupted_run_keeps_what_is_done(script, finished, monkeypatch, tmp_path, capsys):
    count = 0

    def stopping(task):
        nonlocal count
        count += 1
        if count == 4:
            raise KeyboardInterrupt
        return {"score": 0.5, "mean_frame": 0.9, "chi_square": 1.0, "iterations": 1, "converged": True, "seconds": 0.0}

    monkeypatch.setattr(script, "measure", stopping)
    monkeypatch.setattr(script, "choose_mask", lambda config, progress: script.instrument(task()))
    config = script.Config(smoke=True, name="stopped", runs=tmp_path, sweep=tmp_path / "sweep", workers=1)
    assert script.main(config) == 130
    assert "--sweep" in capsys.readouterr().err
    assert len(list((tmp_path / "sweep" / "tasks").glob("*.json"))) == 3
    assert not (tmp_path / "stopped").exists()


def test_a_scene_counts_by_its_content(script, tmp_path):
    path = tmp_path / "scene.npz"
    save_npz(path, {"image": np.eye(8)})
    config = script.Config(scenes=(path,), views=1)
    before = script.scenes(config)["scene.npz"]
    save_npz(path, {"image": np.ones((8, 8))}, replace=True)
    assert script.scenes(config)["scene.npz"]["sha256"] != before["sha256"]
    assert script.observe(task(scene=before))[0].n_photons == pytest.approx(1e6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"full": True, "smoke": True}, "choose one"),
        ({"photons": ()}, "photons"),
        ({"seeds": (1, 1)}, "none twice"),
        ({"views": 0}, "views"),
        ({"restarts": 0}, "restarts"),
        ({"restarts": 11}, "10 frames"),
        ({"scenes": (Path("none.obj"),)}, "none.obj"),
        ({"scenes": (Path("a/x.obj"), Path("b/x.obj"))}, "a name of its own"),
    ],
)
def test_what_cannot_run_is_one_line_before_any_work(script, tmp_path, capsys, changes, message):
    config = script.Config(runs=tmp_path, sweep=tmp_path / "sweep", name="bad", **changes)
    assert script.main(config) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_an_existing_folder_is_never_touched(script, finished, capsys):
    before = (finished.runs / "first" / "mask_vs_full.json").stat().st_mtime_ns
    assert script.main(finished) == 2
    assert "exists" in capsys.readouterr().err
    assert (finished.runs / "first" / "mask_vs_full.json").stat().st_mtime_ns == before


@pytest.mark.parametrize("inside", ["", "sweep"])
def test_restorations_are_not_kept_in_the_folder_of_the_run(script, tmp_path, capsys, inside):
    config = script.Config(smoke=True, name="run", runs=tmp_path, sweep=tmp_path / "run" / inside)
    assert script.main(config) == 2
    assert "elsewhere" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_whole_grid_is_the_one_asked_for(script):
    config = script.with_presets(script.Config(full=True))
    assert (min(config.photons), max(config.photons)) == (1e4, 1e8)
    assert (min(config.d_over_r0), max(config.d_over_r0)) == (3, 15)
    assert len(config.seeds) >= 5
