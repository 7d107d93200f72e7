"""The experiments on field, exposure, band and modes: their closed forms, what they conclude, and tiny runs."""

import json
import math
from types import SimpleNamespace

import anisoplanatism
import band
import exposure
import observing
import pytest
import rival_modes
import trade

from torchmask.atmosphere.layers import Layers
from torchmask.cli.band_options import BandOptions
from torchmask.design.criterion import AsymptoticMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.band import Band
from torchmask.planning.smearing import phase_spread, smearing_map
from torchmask.planning.success import success_map
from torchmask.spectra import NoisePSD, PowerLawPSD

pytestmark = pytest.mark.usefixtures("coarse_figures")

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


def test_the_best_amount_between_those_tried():
    def of(best, amounts):
        return [{"x": x, "score": 0.2 + 0.1 * math.log(x / best) ** 2} for x in amounts]

    assert trade.between(of(1.4, (4.0, 0.5, 1.0, 2.0)), "x", "score") == pytest.approx(1.4, rel=1e-9)
    assert trade.between(of(3.0, (0.5, 1.0, 2.0)), "x", "score") == 2.0  # none beyond is known


def test_a_predicted_score_is_that_of_the_criterion_for_the_same_light(monkeypatch):
    centers, told = [[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]], []

    def note(grid, signal, noise, n_frames, *turbulence):
        told.append(turbulence)
        return AsymptoticMSE(grid, signal, noise, n_frames)

    monkeypatch.setattr(trade, "TurbulentMSE", note)  # its tables would take seconds
    task = {"centers": centers, "subaperture_diameter": 0.2, "n_pixels": 16, "d_over_r0": 3.0, "outer_scale": 20.0}
    task |= {"readout_noise": 1.5, "n_frames": 4, "n_photons": 1e5, "exposure": 0.5, "band": 0.1, "n_simulated": 4}
    task["instrument"] = "mask"
    psds = PowerLawPSD(1.5, 1e5, 1 / 8), NoisePSD(1e5, 1.5, 16**2)
    criterion = AsymptoticMSE(Grid.nyquist(1.0, 550e-9, 32), *psds, 4)
    floor = criterion.relative_floor(1.0)
    seen = (float(criterion.relative(SparseAperture(centers, 0.2, 1.0))) - floor) / (1 - floor)
    predicted = trade.predict(task)
    assert predicted["predicted"] == pytest.approx(math.sqrt(seen), rel=1e-6)
    assert predicted["instants"] == predicted["predicted"]  # by pistons alone
    (r0, outer_scale, exposure, wind, wavelengths, shares), instants = told
    assert instants == (r0, outer_scale, 0.0, 0.0, (550e-9,), (1.0,))
    assert (r0, outer_scale, wind) == (1 / 3, 20.0, observing.WIND)
    assert exposure == pytest.approx(0.5 * 0.314 * r0 / wind, rel=1e-3)  # tau0 = 0.314 r0 / wind
    assert (wavelengths, shares) == (Band.top_hat(550e-9, 55e-9, 4).wavelengths, Band.top_hat(550e-9, 55e-9, 4).shares)


def test_the_light_of_a_band_has_more_wavelengths_than_are_told(monkeypatch):
    seen = []

    def simulate(*_, conditions, **__):
        seen.append(conditions.band)
        return SimpleNamespace(frames=None)

    def told(*_, wavelengths, weights, **__):
        seen.append(Band.of(wavelengths, weights))
        raise KeyboardInterrupt  # seen enough

    monkeypatch.setattr(observing, "simulate_observation", simulate)
    monkeypatch.setattr(observing, "MyopicDeconvolution", told)
    task = {"centers": [[-0.4, 0.0], [0.4, 0.0]], "subaperture_diameter": 0.2, "n_pixels": 16, "d_over_r0": 3.0}
    task |= {"outer_scale": 20.0, "readout_noise": 1.5, "n_frames": 1, "n_photons": 1e5, "instrument": "mask"}
    task |= {"band": 0.1, "n_simulated": 7, "n_told": 2, "iterations": 1, "seed": 0}
    with pytest.raises(KeyboardInterrupt):
        observing.measure(task)
    assert seen == [Band.top_hat(550e-9, 55e-9, 7), Band.top_hat(550e-9, 55e-9, 2)]
    assert band.N_SIMULATED > band.N_TOLD == BandOptions.n_wavelengths


def test_a_blind_prediction_is_what_a_plan_makes_of_instants():
    """The square of a score is an error; beyond what was tried (2e3 photons) its edge counts, without a warning."""
    task = {"instrument": "mask", "centers": [[-0.4, 0.0], [0.4, 0.0]], "subaperture_diameter": 0.2}
    task |= {"d_over_r0": 4.0, "n_photons": 2e3, "n_frames": 8, "exposure": 2.0, "band": 0.1}
    found = success_map().outlook(0.8, 1e4, 8)
    outlook = smearing_map().outlook(found, n_photons=1e4, exposure=2.0, spread=phase_spread(0.1, 4.0))
    assert trade.blind(task, 0.3) == pytest.approx(0.3 * found.cost * outlook.restored, rel=1e-12)


def test_a_blind_prediction_for_a_full_pupil_is_that_of_its_own_light_and_diameter():
    centers = [[-0.4, 0.0], [0.4, 0.0]]  # the full pupil is as wide as they reach, 1, and has 12.5 times their light
    task = {"instrument": "full", "centers": centers, "subaperture_diameter": 0.2, "d_over_r0": 4.0, "n_frames": 8}
    found = success_map("full").outlook(4.0, 12.5e5, 8)
    outlook = smearing_map("full").outlook(found, n_photons=12.5e5, exposure=0.0, spread=phase_spread(0.1, 4.0))
    expected = 0.3 * max(1.0, found.cost) * outlook.restored
    assert trade.blind(task | {"n_photons": 1e5, "band": 0.1}, 0.3) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_tiny_run_writes_numbers_table_picture_and_log(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # takes seconds, and has a test of its own
    monkeypatch.setattr(trade, "predict", lambda task: {"predicted": 0.5, "instants": 0.5})
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
        ("anisoplanatism", ["--fields", "0", "1"], "--fields is (0.0, 1.0): all values must be positive"),
        ("anisoplanatism", ["--shares", "0.5", "1.5"], "--shares is (0.5, 1.5)"),
        (
            "exposure",
            ["--exposures", "1", "1"],
            "--exposures is (1.0, 1.0): it must hold at least one value, and none tw",
        ),
        ("exposure", ["--instruments", "slit"], "--instruments is ('slit',): known ones are mask, full"),
        ("band", ["--widths", "1.5"], "--widths is (1.5,): a filter must be narrower"),
        ("band", ["--n-photons", "0"], "--n-photons is 0.0: it must be positive"),
    ],
)
def test_a_bad_setting_is_one_line(name, options, message, tmp_path, capsys):
    assert SCRIPTS[name].main([*options, "--out", str(tmp_path / "new" / "run")]) == 1
    err = capsys.readouterr().err
    assert err.startswith(f"{name}: error: {message}")
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
