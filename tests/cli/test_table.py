"""torchmask table: rows, what is there already, the telescope's rules, and the instrument's exposures."""

import json

import pytest
import torch

from torchmask.cli import table
from torchmask.cli.main import main
from torchmask.design.conditions import ExposureConditions
from torchmask.design.constraints import KeepOutDisc, MinimumGap, check_mask
from torchmask.design.space import DesignSpace
from torchmask.design.table import design_table
from torchmask.design.turbulent import TurbulentMSE
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
    assert main([*argv, "--diameter-over-r0", "30"]) == 1
    assert "no combination can be built" in capsys.readouterr().err
    assert main([*argv, "--exponent", "-3"]) == 1
    assert capsys.readouterr().err == "torchmask table: error: --exponent is -3.0: it must be finite and not negative\n"


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
        source=Source(magnitude=2.0, size=3.0),
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
        folder.mkdir()
        return "no table"

    monkeypatch.setattr(table, "design_table", note)
    argv = ["table", str(tmp_path / "table"), "--instrument", str(tmp_path / "instrument.json")]
    assert main([*argv, "--fill-factor", "0.05", "0.1"]) == 0
    space, conditions = asked["space"], asked["conditions"]
    assert (space.fill_factor, space.n_frames, space.diameter_over_r0) == ((0.05, 0.1), (2,), (pytest.approx(4.0),))
    assert (space.mask_diameter, space.outer_scale, space.central_obstruction) == (1.2, 30.0, 0.2)
    assert (space.n_pixels, space.readout_noise, space.grid) == (24, 2.5, known.grid(256))
    area = float(SparseAperture.from_catalog("golay6", 1.2, 0.15).area)
    assert space.n_photons[0] == pytest.approx(known.photons(area), rel=1e-12)
    assert conditions.sky == pytest.approx(known.sky(area), rel=1e-12)
    assert (conditions.exposure, conditions.wind, conditions.pixel_fill) == (3e-3, 5.0, 0.9)
    assert conditions.wavelengths == known.band.wavelengths
    assert conditions.weights == pytest.approx(known.band.shares)
