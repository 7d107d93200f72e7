"""The experiments on field, exposure, band and modes: their closed forms, what they conclude, and tiny runs."""

import json

import anisoplanatism
import band
import exposure
import observing
import pytest
import rival_modes

from torchmask.atmosphere.layers import Layers

SCRIPTS = {"anisoplanatism": anisoplanatism, "exposure": exposure, "band": band, "rival_modes": rival_modes}


@pytest.mark.parametrize(("ratio", "kept"), [(0.5, 0.940), (1.0, 0.832), (2.0, 0.620), (4.0, 0.378)])
def test_what_an_exposure_keeps(ratio, kept):
    assert exposure.kept_contrast(ratio) == pytest.approx(kept, abs=5e-4)


@pytest.mark.parametrize(("width", "kept"), [(0.05, 0.965), (0.1, 0.875), (0.2, 0.659), (0.4, 0.397)])
def test_what_a_band_keeps(width, kept):
    assert band.kept_contrast(width, 7.0) == pytest.approx(kept, abs=5e-4)


def test_the_height_makes_the_scene_as_many_theta0_wide_as_asked():
    options = anisoplanatism.Options(fields=(0.5, 3.0), shares=(0.2, 0.5, 1.0), share_field=2.0)
    across = observing.SIZE * options.n_pixels * observing.WAVELENGTH / (2 * observing.DIAMETER)
    found = anisoplanatism.settings_of(options)
    # one for each field, one for each share, and the same shares at the pupil
    assert len(found) == 2 + 3 + 3
    for setting in found:
        layers = Layers.from_fractions(1 / options.d_over_r0, observing.WAVELENGTH, *setting["layers"])
        assert across / layers.theta0(observing.WAVELENGTH) == pytest.approx(setting["field"], rel=1e-9)


def cell(field, ratio, error):
    return {"field": field, "ratio": ratio, "ratio_low": ratio - error, "ratio_high": ratio + error}


def test_where_one_psf_stops_being_enough_is_what_the_bars_tell():
    cells = [cell(0.5, 1.0, 0.05), cell(1.0, 1.12, 0.05), cell(2.0, 1.5, 0.1)]
    assert anisoplanatism.limit(cells) == "is enough up to 0.5 theta0, and no longer from 2 theta0 on"
    assert anisoplanatism.limit(cells[:2]) == "is enough up to 0.5 theta0, and nowhere shown to fail"
    assert anisoplanatism.limit(cells[2:]).startswith("is not shown to be enough")


def test_the_optimum_names_what_is_not_told_from_it():
    cells = [{"x": x, "score": s, "low": s - 0.02, "high": s + 0.02} for x, s in ((1, 0.3), (2, 0.2), (4, 0.23))]
    assert observing.optimum(cells, "x") == "2 (not told from 4)"


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_tiny_run_writes_numbers_table_picture_and_log(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert SCRIPTS[name].main(["--smoke", "--workers", "1", "--out", "run"]) == 0
    result = json.loads((tmp_path / f"run/{name}.json").read_text())
    assert all(0 < row["score"] < 10 for row in result["rows"])
    table = [line for line in (tmp_path / f"run/{name}.md").read_text().splitlines() if line.startswith("|")]
    assert len(table) == len(result["cells"]) + 2
    assert len({line.count("|") for line in table}) == 1
    assert (tmp_path / f"run/{name}.png").read_bytes().startswith(b"\x89PNG")
    assert list((tmp_path / "run").glob("events.out.tfevents.*"))
    if name == "anisoplanatism":
        still = [c for c in result["cells"] if c["field"] == 0]
        assert all(c["ratio"] == pytest.approx(1) for c in still)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("anisoplanatism", ["--fields", "0", "1"], "fields is (0.0, 1.0): all values must be positive"),
        ("anisoplanatism", ["--shares", "0.5", "1.5"], "shares is (0.5, 1.5)"),
        (
            "exposure",
            ["--exposures", "1", "1"],
            "exposures is (1.0, 1.0): it must hold at least one value, and none tw",
        ),
        ("exposure", ["--instruments", "slit"], "instruments is ('slit',): known ones are mask, full"),
        ("band", ["--widths", "1.5"], "widths is (1.5,): a filter must be narrower"),
        ("band", ["--n-photons", "0"], "n_photons is 0.0: it must be positive"),
    ],
)
def test_a_bad_setting_is_one_line(name, options, message, tmp_path, capsys):
    assert SCRIPTS[name].main([*options, "--out", str(tmp_path / "new" / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"{name}: error: {message}")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
