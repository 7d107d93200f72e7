"""The whole loop, tiny: that every part reaches the run folder, and that nothing is lost or overwritten."""

import dataclasses
import json
from pathlib import Path

import codesign
import numpy as np
import pytest
import torch
import yaml

from torchmask.cli.codesign import ImagingOptions, Options, RestorationOptions, design_mask, inversion, with_presets
from torchmask.cli.options import SearchOptions
from torchmask.io import load_npz
from torchmask.optics.aperture import FullAperture
from torchmask.record import Record
from torchmask.restoration.background import Background
from torchmask.restoration.schedule import Schedule
from torchmask.simulation.scene import SceneOptions
from torchmask.spectra import PowerLawPSD
from torchmask.tracking import RunLogger, read_metrics

pytestmark = pytest.mark.usefixtures("coarse_figures")

FIGURES = [
    "comparison.png",
    "design_history.png",
    "design_mask.png",
    "design_uv_coverage.png",
    *(f"observation_{name}_{what}.png" for name in ("full", "mask") for what in ("frames", "mtf", "psf")),
    "restoration_cost.png",
]


def tiny(folder: Path, *changes: str) -> int:
    return codesign.main(["codesign", "--smoke", "--imaging.n-photons", "1e6", "--out", str(folder), *changes])


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "first"
    assert tiny(folder) == 0
    return folder


def test_every_result_is_in_the_folder(finished):
    assert sorted(path.name for path in finished.glob("*.png")) == sorted(FIGURES)
    assert json.loads((finished / "status.json").read_text())["status"] == "finished"
    assert json.loads((finished / "config.json").read_text())["design"]["n_subapertures"] == 5
    stored = yaml.safe_load((finished / "config.yaml").read_text())
    assert (stored["imaging"]["n_photons"], stored["design"]["n_subapertures"]) == (1e6, 5)
    result = load_npz(finished / "result.npz")
    assert result["centers"].shape == (5, 2)
    for name in ("mask", "full"):
        assert result[f"{name}_frames"].shape == (3, 64, 64)
        assert result[f"{name}_object"].min() >= 0
    stages = {row["stage"] for row in read_metrics(finished)}
    assert {"design/cma", "design/refine", "restoration/mask", "restoration/full", "summary/mask"} <= stages


def test_tensorboard_finds_scalars_and_images(finished):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    tags = {}
    for name in ("", "mask", "full", "cma", "refine"):
        events = EventAccumulator(str(finished / name), size_guidance={"images": 0, "scalars": 0})
        tags[name] = events.Reload().Tags()
    for name in ("mask", "full"):  # the same tags: TensorBoard draws both in one card
        assert {"restoration/cost", "simulation/kept_light", "summary/score"} <= set(tags[name]["scalars"])
        assert {"restoration/object", "observation/first_frame"} <= set(tags[name]["images"])
    assert tags["cma"]["scalars"] == tags["refine"]["scalars"] == ["design/relative_mse"]
    assert tags[""]["scalars"] == ["summary/relative_mse"]
    figures = {"figures/design/mask", "figures/design/uv_coverage", "figures/comparison", "figures/restoration/cost"}
    assert figures | {"figures/observation/full/mtf"} <= set(tags[""]["images"])
    assert "restoration/cost/text_summary" in tags[""]["tensors"]


def test_the_full_pupil_gets_photons_by_its_area_and_reaches_as_far(finished):
    result = load_npz(finished / "result.npz")
    rows = {row["stage"] + "/" + key: value for row in read_metrics(finished) for key, value in row["scalars"].items()}
    separation = np.linalg.norm(result["centers"][:, None] - result["centers"][None], axis=-1).max()
    diameter = float(result["subaperture_diameter"])
    expected = (separation + diameter) ** 2 / (5 * diameter**2)
    ratio = rows["summary/full/photons_per_frame"] / rows["summary/mask/photons_per_frame"]
    assert ratio == pytest.approx(expected, rel=1e-12)


def test_same_seed_same_numbers_and_another_seed_others(finished, tmp_path, capsys):
    assert tiny(tmp_path / "again") == 0
    out = capsys.readouterr().out
    assert "score" in out
    assert f"tensorboard --logdir {tmp_path}\n" in out
    assert tiny(tmp_path / "other", "--seed", "1") == 0
    first, again, other = (load_npz(path / "result.npz") for path in (finished, tmp_path / "again", tmp_path / "other"))
    for name in first:
        np.testing.assert_array_equal(first[name], again[name])
    for name in ("centers", "mask_frames", "full_frames"):
        assert np.abs(first[name] - other[name]).max() > 0


def test_an_existing_folder_is_never_touched(finished, capsys):
    before = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    assert tiny(finished) == 1
    assert "first-2" in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == before


def test_a_key_of_the_config_that_is_unknown_is_refused(tmp_path, capsys):
    (tmp_path / "bad.yaml").write_text("design: {n_holes: 5}")
    assert tiny(tmp_path / "run", "--config", str(tmp_path / "bad.yaml")) == 1
    assert "unknown key design.n_holes; known keys are design.n_subapertures" in capsys.readouterr().err


def test_a_missing_scene_is_one_line_before_any_work(tmp_path, capsys):
    assert tiny(tmp_path / "no-scene", "--scene.path", str(tmp_path / "none.obj")) == 1
    error = capsys.readouterr().err
    assert "none.obj" in error
    assert "Traceback" not in error
    assert not (tmp_path / "no-scene").exists()


def test_an_interrupted_restoration_leaves_what_it_reached(tmp_path, monkeypatch, capsys):
    seen = []
    original = RunLogger.__call__

    def interrupting(self, record: Record):
        original(self, record)
        seen.append(record.stage)
        if seen.count("restoration/mask") == 12:
            raise KeyboardInterrupt

    monkeypatch.setattr(RunLogger, "__call__", interrupting)
    assert tiny(tmp_path / "stopped") == 130
    assert "stopped" in capsys.readouterr().err
    folder = tmp_path / "stopped"
    assert json.loads((folder / "status.json").read_text())["status"] == "interrupted"
    checkpoint = load_npz(folder / "checkpoints" / "restoration_mask.npz")
    assert checkpoint["object"].shape == (64, 64)
    assert np.isfinite(checkpoint["object"]).all()
    assert len([row for row in read_metrics(folder) if row["stage"] == "restoration/mask"]) == 12
    assert load_npz(folder / "checkpoints" / "design_refine.npz")["centers"].shape == (5, 2)


def test_the_paper_preset_is_the_published_method():
    config = with_presets(Options(preset="paper"))
    assert (config.design.method, config.design.refine) == ("cma", False)
    assert (config.restoration.n_modes, config.restoration.prior) == (3, False)
    method = inversion(config, FullAperture(1.0), config.restoration.n_modes)
    assert method.schedule == Schedule.plain()
    assert method.background is Background.NONE
    assert with_presets(Options()) == Options()


def test_the_inversion_is_told_the_turbulence_only_if_asked_for():
    options, mask = Options(), FullAperture(1.0)
    assert not inversion(options, mask, 6).known_r0
    told = inversion(dataclasses.replace(options, restoration=RestorationOptions(told_turbulence=True)), mask, 6)
    assert (told.recipe.r0, told.recipe.outer_scale) == (1 / 7, 20.0)


def test_the_mask_is_designed_for_the_noise_and_the_scene_that_are_simulated(monkeypatch):
    seen = []
    monkeypatch.setattr("torchmask.cli.codesign.search", lambda options, criterion, *rest: seen.append(criterion))
    imaging = ImagingOptions(n_pixels=40, n_photons=1e5, readout_noise=3.0)
    options = Options(imaging=imaging, scene=SceneOptions(size=0.5))
    design_mask(options, lambda record: None)
    given = dataclasses.replace(options, design=SearchOptions(knee=1 / 7, n_frequencies=64))
    design_mask(given, lambda record: None)
    for criterion, knee in zip(seen, (1 / 20, 1 / 7), strict=True):
        expected = PowerLawPSD(1.5, 1e5, knee)(criterion.grid)
        torch.testing.assert_close(criterion.object_psd, expected)
        assert float(criterion.noise_psd[0, 0]) == pytest.approx(1e5 + 40**2 * 3.0**2)


def test_configurations_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        Options().seed = 3
