"""Errors that are told to frame_observables: those of valid pixels must make sense, and no other counts."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture([[0.0, 0.4], [-0.35, -0.2], [0.35, -0.25]], 0.15, 1.0)


def exposures():
    star = torch.zeros(GRID.shape, dtype=torch.float64)
    star[16, 16] = 1e6
    generator = torch.Generator().manual_seed(0)
    return simulate_observation(star, MASK, GRID, None, Detector(3.0), 3, generator).frames


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -1.0])
def test_errors_of_pixels_that_are_not_valid_do_not_matter(value):
    frames, valid = exposures(), torch.ones(GRID.shape, dtype=torch.bool)
    valid[10, 12] = False
    errors = (frames.clamp(min=0) + 9).sqrt()
    spoilt = errors.where(valid, value)
    good, found = (
        frame_observables(Observation(frames, MASK, GRID, 3.0, valid=valid, errors=e)) for e in (errors, spoilt)
    )
    for name in ("vis2", "vis2_covariance", "closure_phases", "closure_covariance"):
        assert torch.equal(getattr(found, name), getattr(good, name))


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -1.0])
def test_errors_of_valid_pixels_must_be_finite_and_positive(value):
    frames = exposures()
    errors = torch.full_like(frames, 3.0)
    errors[1, 10, 12] = value
    message = r"errors are not finite and positive at 1 valid pixels, .* \(1, 10, 12\), .* False in `valid`"
    with pytest.raises(ValueError, match=message):
        frame_observables(Observation(frames, MASK, GRID, 3.0, errors=errors))
