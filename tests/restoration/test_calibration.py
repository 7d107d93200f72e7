"""What frames tell of themselves between two descents, in closed form."""

import pytest
import torch

from torchmask.restoration.calibration import sharpen_noise_inflation
from torchmask.restoration.state import Calibration, State


@pytest.mark.parametrize(("power", "expected"), [(2, [2.0, 8.0, 18.0]), (1, [2.0, 4.0, 6.0])])
def test_frames_are_weighed_by_how_well_they_fit(power, expected):
    """Against the best frame, by the square through a full pupil."""
    inflation = torch.tensor([2.0, 4.0, 6.0], dtype=torch.float64)
    state = State(torch.ones(2, 2), torch.zeros(3, 1), Calibration(torch.ones(3), inflation, 1.0))
    assert sharpen_noise_inflation(state, power).calibration.noise_inflation.tolist() == expected
