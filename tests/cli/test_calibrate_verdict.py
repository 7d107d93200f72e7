"""`torchmask calibrate` on what is no single star."""

import json

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.cli.main import main
from torchmask.cli.program import NOT_EXPLAINED
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation

pytestmark = pytest.mark.usefixtures("coarse_figures")


@pytest.mark.filterwarnings("default:not explained by a star")
@pytest.mark.parametrize(("companion", "status"), [(0.0, 0), (0.3, NOT_EXPLAINED)])
def test_the_exit_status_says_whether_a_star_explains_the_exposures(companion, status, tmp_path, capsys):
    mask, grid = SparseAperture.from_catalog("golay9", 1.0, 0.15), Grid.nyquist(1.0, 550e-9, 40)
    scene = torch.zeros(40, 40, dtype=torch.float64)
    scene[20, 20], scene[20, 30] = 1e6, companion * 1e6
    turbulence, generator = TurbulencePhase(0.2, 20.0), torch.Generator().manual_seed(0)
    seen = simulate_observation(scene, mask, grid, turbulence, Detector(1.5), 4, generator)
    Observation(seen.frames, mask, grid, 1.5).save(tmp_path / "star.npz")
    assert main(["calibrate", str(tmp_path / "star.npz"), "--out", str(tmp_path / "run")]) == status
    verdict = json.loads((tmp_path / "run" / "calibration.json").read_text())["verdict"]
    assert verdict["explained"] == (status == 0)
    assert (verdict["chi_square"] > verdict["limit"]) == (status != 0)
    said = capsys.readouterr()
    assert verdict["text"] in said.out
    assert ("check for a companion" in said.err) == (status != 0)
