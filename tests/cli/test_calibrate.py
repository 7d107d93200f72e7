"""`torchmask calibrate`: from exposures of a star to a mask file."""

import json
import math

import pytest
import torch

from torchmask.cli.main import main
from torchmask.design.manufacture import load_mask, mask_wavelength
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.simulation.exposures import simulate_observation

TOLD = SparseAperture([[0.0, 0.35], [-0.35, -0.2], [0.3, -0.25]], 0.2, 1.0)
TRUE = MaskGeometry(rotation=0.02, magnification_x=1.01, magnification_y=1.01)
GRID = Grid.nyquist(1.1, 550e-9, 64)


@pytest.fixture
def star(tmp_path):
    scene = torch.zeros(64, 64, dtype=torch.float64)
    scene[32, 32] = 1e7
    seen = simulate_observation(scene, TRUE.apply(TOLD), GRID, None, Detector(), n_frames=1)
    Observation(seen.frames, TOLD, GRID, 1.0).save(tmp_path / "star.npz")
    return tmp_path / "star.npz"


def test_the_mask_where_it_lies_is_written(star, tmp_path, capsys):
    assert main(["calibrate", str(star), "--out", str(tmp_path / "run")]) == 0
    numbers = json.loads((tmp_path / "run" / "calibration.json").read_text())
    assert abs(numbers["rotation"] - 0.02) < 4 * numbers["errors"]["rotation"] + 1e-4
    mask = load_mask(tmp_path / "run" / "mask.json")
    assert mask_wavelength(tmp_path / "run" / "mask.json") == GRID.wavelength
    expected = MaskGeometry(**{name: numbers[name] for name in TRUE.__dataclass_fields__}).apply(TOLD)
    assert torch.equal(mask.centers, expected.centers)
    assert f"{math.degrees(numbers['rotation']):.4f}" in capsys.readouterr().out


def test_without_a_star_or_a_mask_nothing_is_written(tmp_path, capsys):
    frames = torch.ones(1, 64, 64)
    Observation(frames, TOLD, GRID, 1.0).save(tmp_path / "sky.npz")
    Observation(frames, FullAperture(1.0), GRID, 1.0).save(tmp_path / "full.npz")
    for file, message in (("sky.npz", "point source"), ("full.npz", "full pupil")):
        assert main(["calibrate", str(tmp_path / file), "--out", str(tmp_path / "run")]) == 1
        assert message in capsys.readouterr().err
        assert not (tmp_path / "run").exists()
    assert main(["calibrate"]) == 1
    assert "give .npz or FITS files" in capsys.readouterr().err
