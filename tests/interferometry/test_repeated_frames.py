"""Frames that are read twice tell nothing new, though errors shrink by them as if they did: a warning names them."""

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.calibration import calibrate_mask
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.15)


def calibration(frames):
    return calibrate_mask(frames, MASK, GRID, readout_noise=1.5)


def test_frames_that_repeat_others_are_named():
    """The two as they are give no warning, which would be an error here."""
    star = torch.zeros(GRID.shape, dtype=torch.float64)
    star[16, 16] = 1e6
    generator = torch.Generator().manual_seed(0)
    frames = simulate_observation(star, MASK, GRID, TurbulencePhase(0.2, 20.0), Detector(1.5), 2, generator).frames
    calibration(frames)
    with pytest.warns(UserWarning, match=r"frames \[2, 3\] of this stack, counted from 0, repeat earlier") as caught:
        calibration(frames.repeat(2, 1, 1))
    assert [warning.filename for warning in caught] == [__file__]
