"""The instrument that a run leaves for other commands: that of its file, with what was given beside it."""

import dataclasses
import math

import pytest

from torchmask.cli import table
from torchmask.cli.instrument_used import instrument_used, with_light
from torchmask.cli.main import main
from torchmask.instrument.instrument import Instrument

pytestmark = pytest.mark.usefixtures("coarse_figures")


def test_every_command_writes_the_instrument_it_used(folder, monkeypatch, recorded, golay):
    """As values: the file may be gone, and what was given beside it counts."""
    told = ["--instrument", str(folder / "instrument.json")]
    tiny = ["--n-frequencies", "32", "--budget", "20", "--criterion", "asymptotic"]
    small = ["--n-subapertures", "3", "--fill-factor", "0.06", "--no-refine"]
    rank_one = ["rank", "golay6", "--fill-factor", "0.1", "--r0", "0.2"]
    seen = ["simulate", "--mask", str(folder / "mask.json")]
    runs = {
        "design": ["design", *small, *tiny],
        "rank": [*rank_one, *tiny, "--n-frames", "9", "--n-photons", "1e5"],
        "simulate": [*seen, "--readout-noise", "4", "--conditions.sky", "6", "--turbulence.wind", "6", "8"],
        "same": seen,
    }
    found = {}
    for name, words in runs.items():
        assert main([*words, *told, "--out", str(folder / name)]) == 0
        found[name] = Instrument.load(folder / name / "instrument.json")
    assert found["design"] == found["same"] == recorded
    changed = dataclasses.replace(recorded.camera, readout_noise=4.0)
    assert found["simulate"].camera == changed
    assert found["simulate"].site.wind == 10.0
    assert found["simulate"].sky(float(golay.area)) == pytest.approx(6.0, rel=1e-12)
    assert (found["rank"].frames, found["rank"].site.r0) == (9, 0.2)
    assert found["rank"].photons(math.pi / 4 * 0.1 * 1.2**2) == pytest.approx(1e5, rel=1e-12)
    monkeypatch.setattr(table, "design_table", lambda space, where, **_: where.mkdir(exist_ok=True))
    for _ in range(2):  # the same folder goes on
        assert main(["table", str(folder / "table"), *told]) == 0
        assert Instrument.load(folder / "table" / "instrument.json") == recorded


def test_what_is_given_is_in_the_place_that_it_has(recorded):
    scale = recorded.pixel_scale * 0.8 * 180 * 3600 / math.pi  # arcsec
    given = {"exposure": 5e-3, "n_frames": 2, "pixel_scale_arcsec": scale, "knee": recorded.knee, "pixel_fill": None}
    found = with_light(instrument_used(recorded, given | {"mask_diameter": 1.1, "exponent": 1.5}), 0.1, 3e4, 0.0)
    assert (found.telescope.diameter, found.exposure, found.frames, found.source.exponent) == (1.1, 5e-3, 2, 1.5)
    assert found.pixel_scale == pytest.approx(0.8 * recorded.pixel_scale, rel=1e-12)
    assert found.knee == pytest.approx(recorded.knee, rel=1e-12)
    assert found.photons(0.1) == pytest.approx(3e4, rel=1e-12)
    assert (found.sky(0.1), found.camera.pixel_fill, found.band.wavelengths) == (0.0, 0.9, recorded.band.wavelengths)
    still = {"exposure": 0.0, "n_frames": 2, "r0": math.inf, "outer_scale": math.inf, "wind": 0.0, "width": 0.0}
    assert instrument_used(recorded, still) == recorded
