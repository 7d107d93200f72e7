"""The figure of a telescope's effects: what each row adds and tells, what is drawn, and a tiny run."""

import json
import math

import effects
import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.geometry import MaskGeometry
from torchmask.optics.pixel import SquarePixel
from torchmask.restoration.background import Background

ROWS = effects.effects(effects.Options(n_photons=4096.0, n_pixels=64), tau0=0.01)


def test_each_row_adds_one_effect_and_tells_it_to_its_last_restoration():
    sky, pixels, turned, exposed, verdicts = ROWS
    assert sky.conditions.sky == pytest.approx(0.5)  # of one electron in a mean pixel
    assert [each.told.get("background") for each in sky.restorations] == [Background.NONE, None]
    assert pixels.pixel == SquarePixel(1.0)
    assert [each.told.get("pixel") for each in pixels.restorations] == [None, SquarePixel(1.0)]
    assert turned.geometry.rotation == pytest.approx(math.radians(1.2))
    assert [each.geometry for each in turned.restorations] == [MaskGeometry(), turned.geometry]
    assert exposed.conditions.exposure_time == 0.01
    assert [each.told.get("exposure_tau0", 0.0) for each in exposed.restorations] == [0.0, 1.0]
    assert (verdicts.conditions, verdicts.geometry) == (effects.IDEAL, effects.AS_DRAWN)
    assert [each.geometry.mirrored for each in verdicts.restorations] == [False, False, True]


def test_every_image_has_its_score_and_every_row_a_scale():
    scene = torch.rand(32, 32, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    told = {"object": scene, "score": 0.1234, "explained": True}
    rows = [
        {"title": "sky", "frame": scene, "restorations": [{"title": "not told", **told}, {"title": "told", **told}]},
        {
            "title": "verdicts",
            "frame": scene,
            "restorations": [{**told, "title": t, "explained": False} for t in "abc"],
        },
    ]
    figure = effects.figure(scene, Grid.nyquist(1.0, 550e-9, 32), rows)
    first, second = ([ax for ax in part.axes if ax.images] for part in figure.subfigs)
    assert [ax.get_title(loc="left") for ax in first] == [
        "one exposure\n",
        "not told\nscore 0.123, explained",
        "told\nscore 0.123, explained",
    ]
    assert [ax.get_title(loc="left") for ax in second] == [f"{t}\nscore 0.123, not explained" for t in "abc"]
    for part in figure.subfigs:
        assert [ax.get_ylabel() for ax in part.axes if not ax.images] == ["electrons, square-root stretch"]


def test_a_tiny_run_writes_numbers_table_picture_and_log(tmp_path, monkeypatch):
    monkeypatch.setattr(effects, "effects", lambda *_: ROWS[1:2])
    assert effects.main(["--smoke", "--out", str(tmp_path / "run")]) == 0
    (row,) = json.loads((tmp_path / "run/effects.json").read_text())["rows"]
    assert all(0 < each["score"] < 10 and each["limit"] > 1 for each in row["restorations"])
    table = [line for line in (tmp_path / "run/effects.md").read_text().splitlines() if line.startswith("|")]
    assert len(table) == 2 + 2
    assert (tmp_path / "run/effects.png").read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "run").glob("events.out.tfevents.*"))
