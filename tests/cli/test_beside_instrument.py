"""An option beside the file of an instrument does what its value in the file does, in every command."""

import dataclasses
import json

import pytest

from torchmask.cli import design, plan, rank, restore, simulate, table
from torchmask.cli.criterion_options import Observed
from torchmask.cli.main import main
from torchmask.cli.program import parse
from torchmask.cli.run import Run
from torchmask.instrument.instrument import Instrument

CASES = {  # what stands in the file, and the option of design, rank and table, of simulate, and of plan
    "exposure": ({"exposure": 5e-3}, "--exposure-time 5e-3", "--turbulence.exposure-time 5e-3", "--exposure 5e-3"),
    "n_frames": ({"n_frames": 3, "observing_time": None}, *["--n-frames 3"] * 3),
    "pixel_scale": ({"camera.pixel_scale": 0.04}, *["--pixel-scale-arcsec 0.04"] * 2, "--camera.pixel-scale 0.04"),
    "n_pixels": ({"camera.n_pixels": 32}, *["--n-pixels 32"] * 2, "--camera.n-pixels 32"),
    "pixel_fill": ({"camera.pixel_fill": 0.8}, *["--pixel-fill 0.8"] * 2, "--camera.pixel-fill 0.8"),
    "readout_noise": ({"camera.readout_noise": 1.0}, *["--readout-noise 1"] * 2, "--camera.readout-noise 1"),
    "diameter": ({"telescope.diameter": 1.0}, "--mask-diameter 1", "", "--telescope.diameter 1"),
    "pupil": (
        {"telescope.diameter": 1.0, "telescope.vane_width": 0.1, "telescope.central_obstruction": 0.3},
        "",
        "--mask full --mask-diameter 1 --vane-width 0.1 --central-obstruction 0.3",
        "",
    ),
    "obstruction": (
        {"telescope.central_obstruction": 0.3},
        "--central-obstruction 0.3",
        "",
        "--telescope.central-obstruction 0.3",
    ),
    "vanes": ({"telescope.vane_width": 0.0, "telescope.vane_angles": ()}, "--spiders", "", ""),
    "throughput": ({"telescope.throughput": 0.4}, "", "", "--telescope.throughput 0.4"),
    "wavelength": ({"wavelength": 703e-9}, *["--wavelength 703e-9"] * 3),
    "n_wavelengths": ({"n_wavelengths": 3}, "--n-wavelengths 3", "--conditions.n-wavelengths 3", "--n-wavelengths 3"),
    "filter": (
        {"filter": "bessell-R", "width": None},
        "--filter bessell-R",
        "--conditions.filter bessell-R",
        "--filter bessell-R",
    ),
    "width": ({"width": 30e-9}, "", "--conditions.band-width 30e-9", "--width 30e-9"),
    "temperature": (
        {"source.temperature": 6e3},
        "--temperature 6e3",
        "--conditions.temperature 6e3",
        "--source.temperature 6e3",
    ),
    "rate": ({"source.photon_rate": 1e8, "source.magnitude": None}, "", "", "--source.photon-rate 1e8"),
    "exponent": ({"source.exponent": 1.7}, "--exponent 1.7", "", "--source.exponent 1.7"),
    "r0": ({"site.r0": 0.24}, "--r0 0.24", "--r0 0.24", "--site.r0 0.24"),
    "outer_scale": ({"site.outer_scale": 25.0}, *["--outer-scale 25"] * 2, "--site.outer-scale 25"),
    "wind": ({"site.wind": 8.0}, "--wind 8", "--turbulence.wind 8 0", "--site.wind 8"),
}
DESIGN = ["design", "--n-subapertures", "3", "--fill-factor", "0.06", "--n-frequencies", "32"]
COMMANDS = {
    "design": DESIGN,
    "rank": ["rank", "golay6", "--fill-factor", "0.1", "--n-frequencies", "32"],
    "table": ["table", "{out}", "--n-subapertures", "3", "--fill-factor", "0.06"],
    "simulate": ["simulate", "--mask", "{mask}"],
    "plan": ["plan"],
}


def words_of(command, name):
    """The option of a case as a command has it, none if it has no such option."""
    if (command, name) == ("table", "r0"):
        return ["--diameter-over-r0", "5"]
    place = {"simulate": 2, "plan": 3}.get(command, 1)
    return CASES[name][place].split()


def changed(known, values):
    """An instrument with other values in its file, named as PART.NAME."""
    parts = {}
    for name, value in values.items():
        part, _, number = name.rpartition(".")
        parts.setdefault(part, {})[number] = value
    own = parts.pop("", {})
    own |= {part: dataclasses.replace(getattr(known, part), **numbers) for part, numbers in parts.items()}
    return dataclasses.replace(known, **own)


class Noted(ValueError):
    """All that a command would compute from is on record."""


@pytest.fixture
def known(recorded):
    """An instrument from which more follows: frames from a time, pixels from the telescope, vanes on the pupil."""
    values = {"n_frames": None, "observing_time": 0.6, "camera.readout_time": 1e-3}
    return changed(recorded, values | {"telescope.vane_width": 0.03, "telescope.vane_angles": (0.0, 90.0)})


@pytest.fixture
def outcome(folder, monkeypatch):
    """Run a command up to its computation; returns what that is given, and the instrument that is written."""
    noted, kept = [], []

    def note(*values):
        noted.append(values)
        raise Noted

    monkeypatch.setattr(Run, "keep_instrument", lambda _, instrument: kept.append(instrument))
    monkeypatch.setattr(Observed, "criterion", lambda observed: observed)
    monkeypatch.setattr(design, "search", lambda _, observed, diameter, *rest: note(observed, diameter, str(rest[-1])))
    monkeypatch.setattr(rank, "rank_masks", lambda _, seen, *rest, rules, **__: note(seen(0.1), *rest, rules))
    monkeypatch.setattr(plan, "plan_observation", lambda instrument, **_: note(instrument))

    def fill(space, where, conditions, **_):
        noted.append((space, conditions))
        where.mkdir()

    def expose(scene, aperture, grid, turbulence, detector, *rest, conditions, **_):
        layers = str(vars(turbulence.layers))
        note(
            scene.tolist(),
            float(aperture.area),
            grid,
            layers,
            turbulence.outer_scale,
            str(detector),
            rest[0],
            conditions,
        )

    monkeypatch.setattr(table, "design_table", fill)
    monkeypatch.setattr(simulate, "simulate_observation", expose)

    def run(name, words, instrument):
        instrument.save(folder / f"{name}.json")
        out = folder / name
        words = [word.format(out=out, mask=folder / "mask.json") for word in words]
        words += [] if words[0] == "table" else ["--out", str(out)]
        main([*words, "--instrument", str(folder / f"{name}.json")])
        if words[0] == "table":
            kept.append(Instrument.load(out / "instrument.json"))
        return noted.pop(), kept.pop() if kept else None

    return run


@pytest.mark.filterwarnings("ignore:n_wavelengths")
@pytest.mark.parametrize(
    ("command", "name"), [(command, name) for command in COMMANDS for name in CASES if words_of(command, name)]
)
def test_an_option_does_what_its_value_in_the_file_does(command, name, known, outcome):
    words = words_of(command, name)
    bare = [*COMMANDS[command], *(["--mask", "full"] if "full" in words else [])]
    assert outcome("beside", [*COMMANDS[command], *words], known) == outcome(
        "inside", bare, changed(known, CASES[name][0])
    )


@pytest.mark.parametrize("fill_factor", [0.05, 0.3])
def test_a_tables_reference_changes_no_light(fill_factor, known, outcome):
    words = [*COMMANDS["table"], "--reference-fill-factor", str(fill_factor)]
    (space, conditions), written = outcome("other", words, known)
    (usual, as_usual), _ = outcome("usual", COMMANDS["table"], known)
    photons = [next(one.designs()).photons_per_frame for one in (space, usual)]
    assert photons[0] == pytest.approx(photons[1], rel=1e-12)
    assert conditions.sky / fill_factor == pytest.approx(as_usual.sky / 0.15, rel=1e-12)
    assert written == known


@pytest.mark.parametrize("command", ["design", "rank", "table", "simulate"])
def test_the_instrument_that_is_written_makes_the_same_run(command, known, outcome):
    """With the light, the spectrum and the frames that were given, beside other pixels and exposures."""
    light = ["--n-photons", "3e4", "--n-frames", "7"]
    words = {
        "simulate": ["--conditions.sky", "5", "--turbulence.exposure-time", "4e-3", "--scene.size", "0.5"],
        "table": ["--sky", "5", "--exposure-time", "4e-3", "--knee", "0.1", "--diameter-over-r0", "5"],
    }.get(command, ["--sky", "5", "--exposure-time", "4e-3", "--knee", "0.1", "--r0", "0.24"])
    words = [*COMMANDS[command], *light, *words, "--pixel-scale-arcsec", "0.04"]
    before, written = outcome("before", words, known)
    assert (written.frames, written.exposure, written.camera.pixel_scale) == (7, 4e-3, 0.04)
    after, again = outcome("after", COMMANDS[command], written)
    assert again == written
    assert flat(after) == pytest.approx(flat(before), rel=1e-9)


def flat(values):
    """All numbers of what was noted, in their order."""
    if dataclasses.is_dataclass(values):
        values = {item.name: getattr(values, item.name) for item in dataclasses.fields(values)}
    if isinstance(values, dict):
        values = [values[name] for name in sorted(values)]
    if isinstance(values, list | tuple):
        return [number for value in values for number in flat(value)]
    return [float(values)] if isinstance(values, int | float) else []


def test_the_exposure_of_a_simulation_brings_its_light(folder, capsys, known, golay):
    """As printed, and as written: half the time is half the photons of the same source."""
    known.save(folder / "timed.json")
    told = ["--instrument", str(folder / "timed.json"), "--mask", str(folder / "mask.json"), "--n-frames", "1"]
    assert main(["simulate", *told, "--turbulence.exposure-time", "1.5e-3", "--out", str(folder / "run")]) == 0
    photons = known.photons(float(golay.area)) / 2
    assert f"1 frames of 24 x 24 pixels of 0.05967 arcsec, {photons:.4g} photons in each" in capsys.readouterr().out
    assert Instrument.load(folder / "run/instrument.json").source == known.source


def test_a_target_keeps_its_angle_unless_its_size_is_given(known, outcome):
    half, field = ["--pixel-scale-arcsec", "0.04"], 24 * 0.04
    for words, size in ((half, 0.5), ([*half, "--scene.size", "0.5"], 0.5 * field)):
        _, written = outcome(f"size_{size}", [*COMMANDS["simulate"], *words], known)
        assert written.source.size == pytest.approx(size, rel=1e-12)


def test_a_rank_at_a_shorter_exposure_is_worse(folder, known):
    """From end to end, by its numbers."""
    tiny = ["rank", "golay6", "--fill-factor", "0.1", "--n-frequencies", "16", "--criterion", "asymptotic"]
    told = [*tiny, "--instrument", str(folder / "told.json"), "--out"]
    known = changed(known, {"source.magnitude": 9.0})
    errors = []
    for exposure, words in ((3e-3, []), (3e-3, ["--exposure-time", "1e-3"]), (1e-3, [])):
        timed = changed(known, {"exposure": exposure, "n_frames": 9, "observing_time": None})
        timed.save(folder / "told.json", replace=True)
        assert main([*told, str(folder / f"run{len(errors)}"), *words]) == 0
        rows = json.loads((folder / f"run{len(errors)}/ranking.json").read_text())["rows"]
        errors.append(rows[0]["relative_mse"])
    assert errors[0] < errors[1] == errors[2]


@pytest.mark.filterwarnings("ignore:n_wavelengths")
@pytest.mark.parametrize("name", ["n_wavelengths", "filter", "temperature"])
def test_a_restoration_is_told_the_band_that_is_given(name, folder, recorded):
    file, other = folder / "instrument.json", folder / "other.json"
    changed(recorded, CASES[name][0]).save(other)
    beside = parse(restore.Options, "restore", ["--instrument", str(file), *words_of("design", name)], prog="")
    inside = parse(restore.Options, "restore", ["--instrument", str(other)], prog="")
    assert beside.band(700e-9) == inside.band(700e-9) != restore.Options(instrument=file, n_wavelengths=2).band(700e-9)
    assert beside.told_width() == inside.told_width()


def test_wavelengths_stand_in_place_of_the_band_of_a_file(folder, recorded):
    changed(recorded, CASES["filter"][0] | {"n_wavelengths": 9}).save(folder / "filter.json")
    told = parse(
        design.Options, "design", ["--instrument", str(folder / "filter.json"), "--wavelengths", "7e-7"], prog=""
    )
    assert told.band(700e-9) == {"wavelengths": (7e-7,), "weights": None}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["--n-frames", "10", "--observing-time", "2"], "give --observing-time [s] or --n-frames, and not both"),
        (["--source.photon-rate", "1e6", "--source.magnitude", "3"], "give --source.magnitude or --source.photon-rate"),
        (["--filter", "bessell-R", "--width", "5e-9"], "the band is missing or given twice"),
    ],
)
def test_two_alternatives_that_are_both_given_are_refused(given, said, folder, capsys):
    assert main(["plan", "--instrument", str(folder / "instrument.json"), *given]) == 1
    assert said in capsys.readouterr().err
