"""Many faint frames, whose light lies in a few rings of frequencies: what they say about the mask."""

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.which_mask import MaskLook, look_at_mask
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.15)


def faint_frames(mask, n_frames, seed):
    scene, generator = make_scene(GRID.shape, n_photons=1e4).double(), torch.Generator().manual_seed(seed)
    turbulence = TurbulencePhase(r0=0.2, outer_scale=20.0)
    return simulate_observation(scene, mask, GRID, turbulence, Detector(1.5), n_frames, generator).frames


@pytest.mark.parametrize(("n_frames", "seed"), [(100, 0), (100, 1), (200, 0), (400, 0)])
def test_the_right_mask_is_not_accused(n_frames, seed):
    """Its share is 0.03 to 0.11, with an error of 0.22 to 0.27 if light is taken to lie at all frequencies."""
    assert look_at_mask(faint_frames(MASK, n_frames, seed), MASK, GRID) == MaskLook()


@pytest.mark.parametrize("told", [4, 5, 8])
@pytest.mark.parametrize("seed", range(3))
def test_other_masks_are_still_told(seed, told):
    other = SparseAperture.random(9, 1.0, 0.15, torch.Generator().manual_seed(told))
    assert "not those of the mask" in look_at_mask(faint_frames(MASK, 100, seed), other, GRID).contradiction


def test_no_mask_is_named_by_the_little_that_few_rings_show():
    """Light at all frequencies taken for granted, another orientation of this mask seems to fit by four errors."""
    other = SparseAperture.random(9, 1.0, 0.15, torch.Generator().manual_seed(12))
    assert look_at_mask(faint_frames(MASK, 100, 2), other, GRID) == MaskLook()
