import csv
import json
import math

import pytest
import rank_masks
import torch

from torchmask.design.constraints import InsideDisc, NoOverlap
from torchmask.design.manufacture import load_mask
from torchmask.optics import catalog
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.shapes import Disc, Hexagon


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "ranking"
    assert rank_masks.main(["--smoke", "--out", str(folder)]) == 0
    return folder


@pytest.mark.parametrize("name", catalog.names())
def test_the_largest_fill_factor_is_where_holes_touch(name):
    entry = catalog.entry(name)
    largest = rank_masks.largest_fill_factor(entry)
    for factor, feasible in ((1 - 1e-9, True), (1 + 1e-6, False)):
        fill = largest * factor * (math.pi / 4) / entry.shape.area(1.0)
        mask = SparseAperture.from_catalog(name, 1.0, fill)
        assert bool((NoOverlap().margins(mask) >= 0).all()) == feasible
        assert bool((InsideDisc().margins(mask) >= -1e-12).all())


def test_all_ranked_masks_collect_the_same_light():
    known, crowded = rank_masks.lay_out(rank_masks.Options())
    assert set(known) | set(crowded) == set(catalog.names())
    assert not set(known) & set(crowded)
    for name, mask in known.items():
        assert mask.area == pytest.approx(0.15 * math.pi / 4, rel=1e-12), name
    assert {type(mask.shape) for mask in known.values()} == {Disc, Hexagon}


def test_the_table_is_in_order_and_the_same_in_all_files(finished):
    rows = json.loads((finished / "ranking.json").read_text())["rows"]
    values = [row["relative_mse"] for row in rows]
    assert values == sorted(values)
    assert [row["rank"] for row in rows] == list(range(1, len(rows) + 1))
    with open(finished / "ranking.csv") as file:
        assert [float(row["relative_mse"]) for row in csv.DictReader(file)] == values
    table = (finished / "ranking.md").read_text()
    assert sum(line.startswith("| ") for line in table.splitlines()) == len(rows) + 1
    assert (finished / "ranking.png").read_bytes().startswith(b"\x89PNG")


def test_rows_hold_what_the_library_says_of_the_masks(finished, golay6):
    criterion = rank_masks.make_criterion(rank_masks.Options(n_frequencies=64))
    rows = {row["mask"]: row for row in json.loads((finished / "ranking.json").read_text())["rows"]}
    own = load_mask(finished / "torchmask_6.json")
    for name, mask in (("golay6", golay6), ("torchmask_6", own)):
        with torch.no_grad():
            assert rows[name]["relative_mse"] == pytest.approx(float(criterion.relative(mask)), rel=1e-12)
    ratio = rows["golay6"]["relative_mse"] / rows["torchmask_6"]["relative_mse"]
    assert rows["golay6"]["excess_percent"] == pytest.approx(100 * (ratio - 1), rel=1e-9)
    assert rows["golay9"]["excess_percent"] is None  # no mask of our own with nine holes in this run


def test_a_finished_run_is_not_overwritten(finished, capsys):
    before = (finished / "ranking.json").read_bytes()
    assert rank_masks.main(["--smoke", "--out", str(finished)]) == 1
    assert "exists and is not overwritten" in capsys.readouterr().err
    assert (finished / "ranking.json").read_bytes() == before


def test_impossible_requests_are_refused(tmp_path, capsys):
    assert rank_masks.main(["--smoke", "--fill-factor", "-0.15", "--out", str(tmp_path / "new" / "run")]) == 1
    assert "rank_masks: error: fill_factor is -0.15" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
