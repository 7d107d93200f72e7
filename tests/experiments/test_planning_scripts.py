"""The maps of success, of smearing and of the bound, and the number of holes: their tables, and tiny runs."""

import json
import statistics

import bound_map
import map_draws
import number_of_holes
import numpy as np
import pytest
import smearing_map
import smearing_map_report
import success_map
import torch

import torchmask
from torchmask.optics.aperture import SparseAperture
from torchmask.planning.smearing import SmearingMap, phase_spread
from torchmask.planning.success import SuccessMap
from torchmask.planning.success import success_map as packaged_map

pytestmark = pytest.mark.usefixtures("coarse_figures")

THREE = SparseAperture([[0.0, 0.35], [0.3, -0.2], [-0.3, -0.2]], 0.25, 1.0)
ATLAS = SuccessMap((1, 9), (1e4, 1e7), (0.1, 2.0), *(number * np.ones((2, 2, 2)) for number in (2, 1, 1.5)))


def test_a_tiny_map_is_what_the_plan_can_read(tmp_path, monkeypatch):
    """Through three holes, with the true aberrations by fewer modes: all restorations and bounds, at half the time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(map_draws, "search_masks", lambda holes, *_: dict.fromkeys(holes, THREE))
    monkeypatch.setitem(success_map.TRUE_MODES, "mask", 10)
    assert success_map.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    result = json.loads((tmp_path / "run/success_map.json").read_text())
    measured = SuccessMap(**json.loads((tmp_path / "run/success_mask.json").read_text()))
    assert measured.tried.sum() == len(result["rows"]) == 8
    for cell in result["cells"]:
        (row,) = (row for row in result["rows"] if all(row[key] == cell[key] for key in success_map.KEYS))
        outlook = measured.outlook(cell["d_over_r0"], cell["n_photons"], cell["n_frames"])
        assert outlook.cost == pytest.approx(row["score"] / row["known"])
        assert outlook.success == (row["score"] <= 1.3 * row["known"])
        assert cell["bound"] >= 1
        assert outlook.restored == pytest.approx(row["known"] / row["predicted"])
    assert (tmp_path / "run/success_map.png").read_bytes().startswith(b"\x89PNG")
    assert sum(line.startswith("| ") for line in (tmp_path / "run/success_map.md").read_text().splitlines()) == 5


def test_the_map_of_masks_that_comes_with_the_library_is_that_of_the_defaults():
    options, held = success_map.Options(), packaged_map()
    assert tuple(held.n_frames) == tuple(sorted(options.frames))
    assert tuple(held.n_photons) == options.photons
    assert tuple(held.d_over_r0) == options.d_over_r0
    for n_frames, draws in zip(options.frames, options.draws, strict=True):
        assert (held.tried[list(held.n_frames).index(n_frames)] == draws).all()
    assert held.conditions.startswith(f"{held.tried.sum():g} restorations of {options.n_pixels} x")


def test_a_full_pupil_is_observed_without_a_search_and_without_a_bound():
    options = success_map.Options(pupil="full")
    (pupil,) = map_draws.choose_pupils("full", 1, options, None)
    task = map_draws.of_pupil(pupil) | {"draw": 1, "n_photons": 1e6, "d_over_r0": 2.0, "n_frames": 2, "n_pixels": 32}
    observation = success_map.observe(task)
    assert observation.aperture.is_full
    assert float(observation.aperture.subaperture_diameter) == 1.0
    # D/r0 = 2: the phase is that of r0 = D / 2 (1.03 (D/r0)^(5/3) rad^2 without piston, for an endless outer scale)
    variance = float(success_map.fit_modes(observation, 10)[..., 1:].square().sum(-1).mean())
    assert 0.2 < variance / (1.03 * 2 ** (5 / 3)) < 3
    assert success_map.bounds(options, pupil, None) == {}
    told = success_map.setting(options, [{"tried": 8}])
    assert "at each point: a full pupil, a satellite" in told
    assert "mask" not in told.removesuffix(f"torchmask {torchmask.__version__}.")


def test_predictions_are_for_the_turbulence_over_the_telescope(monkeypatch):
    def answer(function, tasks, folder, **settings):
        assert function is map_draws.predict
        return [{"scores": [task["d_over_r0"], 10 * task["d_over_r0"]]} for task in tasks]

    monkeypatch.setattr(success_map, "run_tasks", answer)
    options = success_map.Options(d_over_r0=(0.5,), photons=(1e4, 1e5), frames=(3,), draws=(1,))
    found = success_map.predictions(options, [THREE], None)  # holes of a quarter of the telescope: D/r0 = 2
    assert found == {(0, 3, 1e4, 0.5): 2.0, (0, 3, 1e5, 0.5): 20.0}


def test_the_map_of_smearing_is_what_the_plan_can_read(tmp_path, monkeypatch):
    """With scores in closed form: the ratio is restored over predicted and over what unknown aberrations cost."""

    def restored(task):
        return {"score": 0.2 * (1 + task["exposure"] + 10 * task["width"]) ** 0.5 * (task["n_photons"] / 1e5) ** -0.4}

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(smearing_map, "choose_pupils", lambda pupil, n_draws, options, callback: [THREE])
    monkeypatch.setattr(smearing_map, "success_map", lambda pupil: ATLAS)
    monkeypatch.setattr(smearing_map, "predict", lambda task: {"scores": [0.1 * task["oversampling"]] * 2})
    monkeypatch.setattr(smearing_map, "measure", restored)
    assert smearing_map.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    measured = SmearingMap(**json.loads((tmp_path / "run/smearing_mask.json").read_text()))
    assert (measured.exposures, measured.n_photons) == ([0.0, 2.0], [1e5, 1e6])
    assert measured.spreads == [phase_spread(width, 4.0) for width in (0.02, 0.2)]
    levels = np.array([[2 / 1.5], [2 * 0.1**0.4 / 1.5]])
    np.testing.assert_allclose(measured.exposure_ratio, levels * [1, 3**0.5], rtol=1e-9)
    np.testing.assert_allclose(measured.band_ratio, levels / 1.25 * np.sqrt([1.2, 3]), rtol=1e-9)
    assert (tmp_path / "run/smearing_map.png").read_bytes().startswith(b"\x89PNG")
    lines = (tmp_path / "run/smearing_map.md").read_text().splitlines()
    assert sum(line.startswith("| ") for line in lines) == 1 + 8


def test_a_point_of_smearing_is_restored_in_its_band():
    task = {"draw": 1, "n_photons": 1e6, "exposure": 0.0, "width": 0.1, "d_over_r0": 2.0, "n_frames": 2}
    task |= {"n_pixels": 24, "iterations": 4} | map_draws.of_pupil(THREE)
    assert 0 < smearing_map.measure(task)["score"] < 1


def test_ratios_of_smearing_are_means_of_draws_that_do_not_fall():
    """Two draws at each flux; the second amount scores lower than the first, so both count as their mean."""
    scores = {0.0: 0.1, 1.0: 0.08, 2.0: 0.2}
    rows = [
        {"axis": axis, "draw": draw, "n_photons": photons, "exposure": x, "width": x}
        | {"expected": 0.5, "score": scale * score}
        for axis in ("exposure", "width")
        for draw, scale in ((0, 1.0), (1, 4.0))
        for photons in (1e5, 1e6)
        for x, score in scores.items()
    ]
    cells = smearing_map_report.summarise(rows)
    table = smearing_map_report.table_of(cells, 4.0)
    first = 4 * 0.1 * 0.8**0.5  # 0.5 is expected, 4 is twice the mean of 1 and 4
    np.testing.assert_allclose(table["exposure_ratio"], [[first, first, 0.8]] * 2, rtol=1e-9)
    assert table["band_ratio"] == table["exposure_ratio"]
    assert [cell["growth"] for cell in cells[:3]] == pytest.approx([1.0, 0.8, 2.0])


def test_scenes_differ_and_hold_the_light():
    scenes = [map_draws.scene_of(draw, (32, 32), 1e6) for draw in range(4)]
    for i, scene in enumerate(scenes):
        assert float(scene.sum()) == pytest.approx(1e6, rel=1e-9)
        assert float(scene.min()) >= 0
        assert not any(torch.allclose(scene, other) for other in scenes[:i])


def test_the_best_number_of_holes_and_those_that_are_as_good():
    rows = [
        {"strength": 7.0, "n_photons": 1e6, "n_subapertures": n, "known": known, "blind": blind}
        | {"d_over_r0": 0.8, "cost": 1.1, "success": 0.9}
        for n, known, blind in ((6, 0.2, 0.5), (11, 0.104, 0.11), (12, 0.1, 0.1), (14, 0.102, 0.104))
    ]
    (cell,) = number_of_holes.summarise(rows)
    assert (cell["known"], cell["known_equal"]) == (12, [11, 12, 14])
    assert (cell["blind"], cell["blind_equal"]) == (12, [12, 14])
    assert cell["blind_11"] == pytest.approx(1.1)
    assert number_of_holes.ranges([3, 5, 6, 7, 9]) == "3, 5-7, 9"


def test_the_best_mask_of_any_search_counts_at_each_flux():
    line = [[-0.35, 0.0], [0.0, 0.0], [0.35, 0.0]]  # with its empty directions, worse than a triangle
    common = {"photons": [1e5, 1e7], "n_frames": 5, "n_pixels": 32, "exponent": 1.5, "strength": 5.0}
    common["subaperture_diameter"] = THREE.subaperture_diameter
    worse, better, both = (
        number_of_holes.predict(common | {"masks": masks})
        for masks in ([line], [THREE.centers.tolist()], [THREE.centers.tolist(), line])
    )
    assert both == better
    assert all(high > low > floor for high, low, floor in zip(worse["errors"], *better.values(), strict=True))


def test_a_tiny_choice_of_the_number_of_holes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert number_of_holes.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    rows = json.loads((tmp_path / "run/number_of_holes.json").read_text())["rows"]
    assert [row["n_subapertures"] for row in rows] == [5, 8]
    assert all(row["blind"] >= row["known"] > 0 for row in rows)
    assert "| 5 | 1e6 |" in capsys.readouterr().out


def test_bounds_are_averaged_over_draws_and_told_over_what_can_be_avoided():
    rows = [
        {"n_modes": 6, "n_frames": 2, "n_photons": photons, "known": known, "unknown": unknown, "floor": 0.05}
        | {"excess": unknown / known - 1}
        for photons, known, unknown in ((1e6, 0.1, 0.104), (1e6, 0.2, 0.202), (1e7, 0.15, 0.15003))
    ]
    dim, bright = bound_map.summarise(rows)
    assert (dim["draws"], bright["draws"]) == (2, 1)
    assert [dim[name] for name in ("least", "excess", "most")] == pytest.approx([0.01, 0.025, 0.04])
    assert dim["avoidable"] == pytest.approx(0.003 / 0.1)
    (line,) = bound_map.markdown(bound_map.Options(), [dim, bright]).splitlines()[-1:]
    assert line == "| 6 | 2 | 2 | 2.5 (3.0) | 0.020 (0.030) |"
    assert [bound_map.percent(share) for share in (0.0996, 0.123, 0.00999)] == ["10", "12", "1.0"]


def test_a_tiny_map_of_the_bound(tmp_path, monkeypatch, capsys):
    """More frames and fewer modes cost less; every flux sees the same aberrations."""
    monkeypatch.chdir(tmp_path)
    assert bound_map.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    result = json.loads((tmp_path / "run/bound_map.json").read_text())
    found = {tuple(cell[key] for key in bound_map.KEYS): cell for cell in result["cells"]}
    for photons in (1e5, 1e6):
        few, many = (found[3, n_frames, photons]["excess"] for n_frames in (1, 2))
        assert few > many > 0
        assert found[6, 2, photons]["excess"] > many
        assert found[6, 2, photons]["avoidable"] > found[6, 2, photons]["excess"]
    assert found[3, 1, 1e5]["known"] > found[3, 1, 1e6]["known"]
    draws = [
        row["excess"] for row in result["rows"] if (row["n_modes"], row["n_frames"], row["n_photons"]) == (3, 1, 1e6)
    ]
    assert len(set(draws)) == 2
    assert statistics.mean(draws) == pytest.approx(found[3, 1, 1e6]["excess"])
    assert (tmp_path / "run/bound_map.png").read_bytes().startswith(b"\x89PNG")
    assert "| 6 | 2 | 1 |" in capsys.readouterr().out


def test_each_number_of_frames_needs_its_number_of_draws(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert bound_map.main(["--frames", "1", "2", "--workers", "1", "--out", "run"]) == 1
    assert "draws is (8, 6, 4, 2, 2): one number is needed for each of frames, (1, 2)" in capsys.readouterr().err
