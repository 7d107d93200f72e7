"""The maps of success and of smearing and the number of holes: their tables, and tiny runs."""

import json

import number_of_holes
import numpy as np
import pytest
import smearing_map
import smearing_map_report
import success_map
import torch

from torchmask.optics.aperture import SparseAperture
from torchmask.planning.smearing import SmearingMap
from torchmask.planning.success import SuccessMap

THREE = SparseAperture([[0.0, 0.35], [0.3, -0.2], [-0.3, -0.2]], 0.25, 1.0)


def test_a_tiny_map_is_what_the_plan_can_read(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert success_map.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    result = json.loads((tmp_path / "run/success_map.json").read_text())
    measured = SuccessMap(**json.loads((tmp_path / "run/success.json").read_text()))
    assert measured.tried.sum() == len(result["rows"]) == 8
    for cell in result["cells"]:
        (row,) = (row for row in result["rows"] if all(row[key] == cell[key] for key in success_map.KEYS))
        outlook = measured.outlook(cell["d_over_r0"], cell["n_photons"], cell["n_frames"])
        assert outlook.cost == pytest.approx(row["score"] / row["known"])
        assert outlook.success == (row["score"] <= 1.3 * row["known"])
        assert cell["bound"] >= 1
    assert (tmp_path / "run/success_map.png").read_bytes().startswith(b"\x89PNG")
    assert sum(line.startswith("| ") for line in (tmp_path / "run/success_map.md").read_text().splitlines()) == 5


def test_the_map_of_smearing_is_what_the_plan_can_read(tmp_path, monkeypatch):
    """With scores in closed form: cost is blind over predicted, where both rise."""

    def grown(task, power):
        return (1 + task["exposure"] + 10 * task["width"]) ** power

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(smearing_map, "choose_masks", lambda n_draws, options, callback: [THREE])
    monkeypatch.setattr(smearing_map, "predict", lambda task: {"scores": [0.1 * grown(task, -0.1)] * 2})
    monkeypatch.setattr(smearing_map, "measure_known", lambda task: {"known": 0.1 * grown(task, 0.2)})
    monkeypatch.setattr(smearing_map, "measure", lambda task: {"score": 0.2 * grown(task, 0.5)})
    assert smearing_map.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    measured = SmearingMap(**json.loads((tmp_path / "run/smearing.json").read_text()))
    assert (measured.exposures, measured.widths, measured.n_photons) == ([0.0, 2.0], [0.02, 0.2], [1e5, 1e6])
    np.testing.assert_allclose(measured.exposure_cost, [[1, 3**0.6]] * 2, rtol=1e-9)
    np.testing.assert_allclose(measured.width_cost, [[1, (3 / 1.2) ** 0.6]] * 2, rtol=1e-9)
    assert (tmp_path / "run/smearing_map.png").read_bytes().startswith(b"\x89PNG")
    lines = (tmp_path / "run/smearing_map.md").read_text().splitlines()
    assert sum(line.startswith("| ") for line in lines) == 1 + 8


def test_a_point_of_smearing_is_restored_blind_and_by_its_true_psfs():
    task = {"draw": 1, "n_photons": 1e6, "exposure": 0.0, "width": 0.1, "d_over_r0": 2.0, "n_frames": 2}
    task |= {"n_pixels": 24, "iterations": 4} | success_map.of_mask(THREE)
    blind, known = smearing_map.measure(task)["score"], smearing_map.measure_known(task)["known"]
    assert 0 < known < blind < 1


def test_costs_of_smearing_do_not_fall_and_blindness_counts_for_all_photons():
    """Two fluxes of two draws; the second amount's known score shrinks, so its excess is that of the first and none."""
    known, blind = {0.0: 0.1, 1.0: 0.08, 2.0: 0.2}, {0.0: 0.1, 1.0: 0.1, 2.0: 0.3}
    rows = [
        {"axis": axis, "draw": draw, "n_photons": photons, "exposure": x, "width": x, "predicted": 0.5}
        | {"known": scale * known[x]}
        | ({"score": scale * blind[x]} if photons < 1e6 else {})
        for axis in ("exposure", "width")
        for draw, scale in ((0, 1.0), (1, 3.0))
        for photons in (1e5, 1e6)
        for x in known
    ]
    table = smearing_map_report.table_of(smearing_map_report.summarise(rows))
    np.testing.assert_allclose(table["exposure_cost"], [[1.0, 1.25, 2 * 1.5]] * 2, rtol=1e-6)
    assert table["width_cost"] == table["exposure_cost"]


def test_scenes_differ_and_hold_the_light():
    scenes = [success_map.scene_of(draw, (32, 32), 1e6) for draw in range(4)]
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


def test_a_tiny_choice_of_the_number_of_holes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert number_of_holes.main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    rows = json.loads((tmp_path / "run/number_of_holes.json").read_text())["rows"]
    assert [row["n_subapertures"] for row in rows] == [5, 8]
    assert all(row["blind"] >= row["known"] > 0 for row in rows)
    assert "| 5 | 1e6 |" in capsys.readouterr().out
