"""The map of success and the number of holes: their tables, and tiny runs."""

import json

import number_of_holes
import pytest
import success_map
import torch

from torchmask.planning.success import SuccessMap


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
