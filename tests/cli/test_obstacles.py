"""Masks that exist, on telescopes whose secondary mirror, vanes or rim are in the way of their holes."""

import dataclasses
import warnings

import pytest

from torchmask.cli import plan
from torchmask.cli.main import main
from torchmask.cli.obstacles import warn_of_blocked_holes
from torchmask.design.manufacture import save_json
from torchmask.instrument.parts import Telescope
from torchmask.optics.aperture import FullAperture, SparseAperture

pytestmark = pytest.mark.usefixtures("coarse_figures")

BLOCKED = SparseAperture([[-0.3, 0.0], [0.66, 0.0], [0.1, 0.2], [0.0, -0.4]], 0.1, 1.2)
OPEN = SparseAperture([[0.0, 0.35], [0.3, 0.2]], 0.1, 1.0)


@pytest.fixture
def files(tmp_path):
    for name, mask in (("blocked", BLOCKED), ("open", OPEN)):
        save_json(tmp_path / f"{name}.json", mask, 550e-9)
    return tmp_path


def test_holes_are_named_with_what_is_in_their_way_and_by_how_much(files):
    telescope = Telescope(diameter=1.0, central_obstruction=0.6, vane_width=0.04, vane_angles=(270.0,))
    with pytest.warns(UserWarning, match="not all holes") as caught:
        warn_of_blocked_holes(files / "blocked.json", BLOCKED, telescope)
    (said,) = (str(warning.message) for warning in caught)
    assert (
        "blocked.json lie in the open pupil: hole 0 reaches 0.05 m into the central obstruction of 0.6 m, hole 1 "
        "reaches 0.21 m beyond the rim of the pupil of 1 m, hole 2 reaches 0.126 m into the central obstruction of "
        "0.6 m, hole 3 reaches 0.07 m into a vane (counted from 0)"
    ) in said
    with pytest.warns(UserWarning, match=r"hole 0 reaches 0\.1 m beyond the rim of the pupil of 0\.6 m"):
        warn_of_blocked_holes(files / "open.json", OPEN, Telescope(diameter=0.6))


def test_nothing_is_said_of_holes_in_the_open_of_full_pupils_and_of_real_masks_on_no_telescope(files):
    real = SparseAperture.from_catalog("keck_lws_pattern5a_6")  # exceeds its nominal pupil
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_blocked_holes(files / "open.json", OPEN, Telescope(diameter=1.0, central_obstruction=0.5))
        warn_of_blocked_holes(files / "full", FullAperture(1.0), Telescope(diameter=1.0, central_obstruction=0.5))
        warn_of_blocked_holes(files / "keck_lws_pattern5a_6", real, None)


def test_a_plan_warns_of_them(files, recorded):
    options = dataclasses.replace(plan.Options.of_instrument(recorded), mask=files / "blocked.json")
    with pytest.warns(UserWarning, match=r"hole 1 reaches 0\.11 m beyond the rim of the pupil of 1\.2 m"):
        plan.existing_mask(options)


@pytest.mark.filterwarnings("default")
def test_a_simulation_warns_of_them(files, capsys):
    words = ["--n-pixels", "64", "--n-frames", "2", "--scene.size", "0.4"]
    assert main(["simulate", *words, "--mask", str(files / "blocked.json"), "--out", str(files / "run")]) == 0
    said = capsys.readouterr().err
    assert "torchmask simulate: warning: not all holes of --mask" in said
    assert "hole 1 reaches 0.11 m beyond the rim of the pupil of 1.2 m (counted from 0)" in said
    assert main(["simulate", *words, "--mask", str(files / "open.json"), "--out", str(files / "other")]) == 0
    assert "warning" not in capsys.readouterr().err
