"""torchmask table: rows, what is there already, the telescope's rules, and the instrument's exposures."""

import dataclasses
import json

import pytest
import torch
import yaml

from torchmask.cli import table
from torchmask.cli.main import main
from torchmask.design.conditions import ExposureConditions
from torchmask.design.constraints import KeepOutDisc, MinimumGap, check_mask
from torchmask.design.space import DesignSpace
from torchmask.design.table import DesignTable, design_table
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import ARCSEC
from torchmask.instrument.instrument import Instrument
from torchmask.instrument.parts import Camera, Site, Source, Telescope
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

TINY = [
    "--n-subapertures",
    "3",
    "5",
    "--n-frequencies",
    "32",
    "--n-frames",
    "2",
    "--n-draws",
    "2",
    "--budget",
    "64",
    "--workers",
    "1",
]


def test_rows_are_written_and_not_computed_twice(tmp_path, capsys):
    argv = ["table", str(tmp_path / "table"), *TINY, "--min-gap", "0.02", "--central-obstruction", "0.2"]
    assert main(argv) == 0
    assert "d/r0 is 1.57, above 1.5" in capsys.readouterr().out  # three holes at D/r0 = 7
    found = json.loads((tmp_path / "table" / "table.json").read_text())["rows"]
    assert "| N   | d [m]  | photons/frame |" in (tmp_path / "table" / "table.md").read_text()
    assert [row["infeasible"] is None for row in found] == [False, True]
    assert found[1]["wiener_mse"] > 0
    mask = SparseAperture(torch.tensor(found[1]["centers"]).double(), found[1]["subaperture_diameter"], 1.0)
    check_mask(mask, 1e-9, [MinimumGap(0.02), KeepOutDisc(0.2)])
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "table" / "tasks").iterdir()}
    assert main(argv) == 0
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "table" / "tasks").iterdir()} == before
    other = ["table", str(tmp_path / "other"), *argv[2:]]
    assert main([*other, "--diameter-over-r0", "30"]) == 1
    assert "no combination can be built" in capsys.readouterr().err
    assert main([*argv, "--n-subapertures"]) == 1
    assert "--n-subapertures is (): it must hold at least one value" in capsys.readouterr().err
    assert main([*argv, "--exponent", "-3"]) == 1
    assert capsys.readouterr().err == "torchmask table: error: --exponent is -3.0: it must be finite and not negative\n"


def test_rows_on_record_are_never_dropped(tmp_path, capsys):
    folder, searched = tmp_path / "table", [*TINY, "--diameter-over-r0"]
    argv = ["table", str(folder), *searched, "3"]
    assert main(argv) == 0
    names = ["table.md", "table.csv", "table.json", "config.yaml"]
    before = {name: (folder / name).read_bytes() for name in names}
    for given, said in (
        (["--n-subapertures", "5"], "nothing is overwritten: give --n-subapertures 3 5 beside what is new"),
        (["--diameter-over-r0", "4"], "give --diameter-over-r0 3.0 beside what is new, or another folder"),
        (["--readout-noise", "1"], "give the same --readout-noise beside what is new"),
        (["--criterion", "turbulent"], "give the same --criterion beside what is new"),
        (["--n-subapertures", "5", "--exponent", "2"], "3 5, the same --exponent beside what is new"),
    ):
        assert main([*argv, *given]) == 1
        assert said in capsys.readouterr().err
    assert {name: (folder / name).read_bytes() for name in names} == before
    assert main([*argv, "--diameter-over-r0", "2", "3"]) == 0
    assert len(json.loads((folder / "table.json").read_text())["rows"]) == 4
    assert yaml.safe_load((folder / "config.yaml").read_text())["diameter_over_r0"] == [2.0, 3.0]
    assert main(["table", "--config", str(folder / "config.yaml"), str(tmp_path / "again"), "--workers", "1"]) == 0
    assert (tmp_path / "again/table.csv").read_bytes() == (folder / "table.csv").read_bytes()


def test_the_folder_of_anything_else_is_refused_and_left_as_it_is(tmp_path, capsys):
    design = tmp_path / "design"
    searched = ["--n-subapertures", "4", "--budget", "20", "--n-frequencies", "32"]
    assert main(["design", *searched, "--out", str(design)]) == 0
    (design / "instrument.json").write_text("{}")
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "instrument.json").write_text("{}")
    before = {path: path.read_bytes() for folder in (design, mine) for path in folder.rglob("*") if path.is_file()}
    capsys.readouterr()
    for folder, said in (
        (design, "a run of `torchmask design`"),
        (mine, "files that are not of a table (instrument.json)"),
    ):
        assert main(["table", str(folder), *TINY]) == 1
        told = f"{folder} holds {said}, and nothing is overwritten: name a new folder, such as {folder}-2, or that"
        assert told in capsys.readouterr().err
    after = {path: path.read_bytes() for folder in (design, mine) for path in folder.rglob("*") if path.is_file()}
    assert after == before


def test_an_empty_folder_and_that_of_an_interrupted_table_are_taken(tmp_path):
    table.require_table_folder(tmp_path / "new")
    table.require_table_folder(tmp_path)
    (tmp_path / "tasks").mkdir()
    table.require_table_folder(tmp_path)
    (tmp_path / "config.yaml").write_text("command: table\n")
    (tmp_path / "notes.txt").touch()
    table.require_table_folder(tmp_path)
    (tmp_path / "config.yaml").write_text("command: [")  # cannot be read, so it is nobody's
    with pytest.raises(ValueError, match=r"files that are not of a table \(config\.yaml, notes\.txt, tasks\)"):
        table.require_table_folder(tmp_path)


def test_a_table_states_its_conditions():
    space = DesignSpace(wavelength=700e-9, mask_diameter=1.2, readout_noise=2.5, n_pixels=24, min_gap=0.02)
    rows = tuple(space.designs())
    text = str(DesignTable(space, rows))
    for said in (
        "D = 1.2 m",
        "pixels of 0.06016 arcsec at 700 nm",
        "24 x 24 pixels with read-out noise of 2.5 electrons rms",
        "photons at N d^2 / D^2 = 0.15",
        "criterion: asymptotic, instants of independent pistons, then measured under screens of outer scale 20 m",
        "min gap 0.02",
    ):
        assert said in text
    known = ExposureConditions(exposure=3e-3, wind=5.0, wavelengths=(6.9e-7, 7.1e-7), pixel_fill=0.9, sky=2.0)
    assert (
        "criterion: turbulent, outer scale 20 m, exposure 3 ms, wind 5 m/s, 2 wavelengths from 690 to 710 nm, pixel "
        "fill 0.9, sky 2 electrons per pixel and frame;"
    ) in str(DesignTable(space, rows, known))


def test_pixels_are_told_in_arcsec(tmp_path, capsys):
    argv = ["table", str(tmp_path / "table"), *TINY, "--pixel-scale-arcsec"]
    assert main([*argv, "1", "--wavelength", "550e-9"]) == 1
    assert "--pixel-scale-arcsec 1 arcsec undersamples" in capsys.readouterr().err
    assert main([*argv, "0.05"]) == 1
    assert "as --pixel-scale-arcsec holds at a wavelength only" in capsys.readouterr().err
    options = table.Options(folder=tmp_path, pixel_scale_arcsec=0.05, wavelength=550e-9)
    assert table.space_of(options).pixel_scale == 0.05 * ARCSEC
    assert "pixel_scale" not in {item.name for item in dataclasses.fields(table.Options)}


def test_under_turbulence_the_error_is_that_criterion_and_the_sky_grows_with_the_area(tmp_path):
    space = DesignSpace(
        n_subapertures=(3,), fill_factor=(0.06,), n_frequencies=32, n_frames=(4,), diameter_over_r0=(5.0,), budget=20,
        method="cma", n_photons=(1e5,), readout_noise=2.0,
    )  # fmt: skip
    conditions = ExposureConditions(pixel_fill=1.0, sky=5.0)
    found = design_table(space, tmp_path / "table", conditions=conditions, n_workers=1)
    (row,) = found.rows
    light = 1e5 * 0.06 / 0.15
    criterion = TurbulentMSE(
        space.grid,
        PowerLawPSD(1.5, light),
        NoisePSD(light, 2.0, 128**2),
        4,
        **conditions.with_light(0.06 / 0.15).keywords(0.2, 20.0),
    )
    assert row.relative_mse == pytest.approx(float(criterion.relative(found.aperture(row))), rel=1e-6)
    assert row.wiener_mse is None
    assert json.loads((tmp_path / "table" / "table.json").read_text())["conditions"]["sky"] == 5.0


def test_conditions_that_cannot_be_are_refused_before_any_work(tmp_path):
    space = DesignSpace(n_subapertures=(3,), n_frequencies=32, diameter_over_r0=(3.0,))
    for conditions, said in (
        (ExposureConditions(exposure=1e-3), "without wind"),
        (ExposureConditions(sky=-1.0), "sky"),
    ):
        with pytest.raises(ValueError, match=said):
            design_table(space, tmp_path / "table", conditions=conditions, n_workers=1)
    still = DesignSpace(n_subapertures=(3,), n_frequencies=32, diameter_over_r0=())
    with pytest.raises(ValueError, match="need turbulence"):
        design_table(still, tmp_path / "table", conditions=ExposureConditions(), n_workers=1)
    assert not (tmp_path / "table").exists()


def test_an_instrument_gives_all_but_the_axes(tmp_path, monkeypatch):
    known = Instrument(
        telescope=Telescope(diameter=1.2, central_obstruction=0.2),
        source=Source(magnitude=2.0, size=0.5),
        site=Site(r0=0.3, wind=5.0, sky=4.0, outer_scale=30.0),
        camera=Camera(n_pixels=24, readout_noise=2.5, pixel_fill=0.9, pixel_scale=0.04),
        wavelength=700e-9,
        width=20e-9,
        exposure=3e-3,
        n_frames=2,
    )
    known.save(tmp_path / "instrument.json")
    asked = {}

    def note(space, folder, **settings):
        asked.update(settings, space=space)
        folder.mkdir(exist_ok=True)
        return "no table"

    monkeypatch.setattr(table, "design_table", note)
    argv = ["table", str(tmp_path / "table"), "--instrument", str(tmp_path / "instrument.json")]
    assert main([*argv, "--fill-factor", "0.05", "0.1"]) == 0
    space, conditions = asked["space"], asked["conditions"]
    assert (space.fill_factor, space.n_frames, space.diameter_over_r0) == ((0.05, 0.1), (2,), (pytest.approx(4.0),))
    assert (space.mask_diameter, space.outer_scale, space.central_obstruction) == (1.2, 30.0, 0.2)
    assert (space.n_pixels, space.readout_noise, space.grid.shape) == (24, 2.5, (256, 256))
    assert space.grid.pixel_scale == pytest.approx(known.pixel_scale, rel=1e-14)
    area = float(SparseAperture.from_catalog("golay6", 1.2, 0.15).area)
    assert space.n_photons[0] == pytest.approx(known.photons(area), rel=1e-12)
    assert conditions.sky == pytest.approx(known.sky(area), rel=1e-12)
    assert (conditions.exposure, conditions.wind, conditions.pixel_fill) == (3e-3, 5.0, 0.9)
    assert conditions.wavelengths == known.band.wavelengths
    assert conditions.weights == pytest.approx(known.band.shares)
    assert Instrument.load(tmp_path / "table/instrument.json") == known

    other = ["--diameter-over-r0", "6", "--n-photons", "3e4", "--n-frames", "7", "--readout-noise", "1"]
    assert main([*argv, *other, "--exposure-time", "2e-3", "--sky", "9", "--pixel-scale-arcsec", "0.05"]) == 0
    used = Instrument.load(tmp_path / "table/instrument.json")
    assert (used.site.r0, used.frames, used.camera.readout_noise, used.exposure) == (pytest.approx(0.2), 7, 1.0, 2e-3)
    assert used.photons(area) == pytest.approx(3e4, rel=1e-9)
    assert used.sky(area) == pytest.approx(9.0, rel=1e-9)
    assert used.camera.pixel_scale == 0.05
    assert main([*argv, "--diameter-over-r0", "6", "7"]) == 0
    assert Instrument.load(tmp_path / "table/instrument.json").site.r0 == 0.3  # no one value: that of the file
