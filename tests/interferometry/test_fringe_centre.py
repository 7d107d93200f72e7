"""Where fringes are fitted: around the light, wherever it stands and whatever part of it is seen."""

import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.fringe_fit import FringeModel
from torchmask.interferometry.fringes import frame_observables
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

SIDE, SEEDS, READOUT = 48, 20, 3.0
GRID = Grid.nyquist(1.0, 550e-9, SIDE)
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.15)


def expected(seed, x=0.0, electrons=1e6):
    """Frame (1, H, W) of a star at (x, 0.3) pixels from the middle, through holes of random pistons, in closed form."""
    model = FringeModel(MASK, GRID)
    generator = torch.Generator().manual_seed(seed)
    pistons = 2 * math.pi * torch.rand(MASK.n_subapertures, generator=generator, dtype=torch.float64)
    phases = pistons[model.pairs[:, 1]] - pistons[model.pairs[:, 0]]
    fringes = torch.cat([phases.cos(), phases.sin()]) / MASK.n_subapertures
    light = torch.cat([torch.ones(1, dtype=torch.float64), fringes]) @ model.columns(x, 0.3)
    return electrons * light.view(1, SIDE, SIDE)


def exposure(seed, x=0.0):
    """That frame with photon and read-out noise."""
    generator = torch.Generator().manual_seed(seed)
    photons = torch.poisson(expected(seed, x).clamp(min=0), generator)  # rounding makes dark pixels negative
    return photons + READOUT * torch.randn(photons.shape, generator=generator, dtype=torch.float64)


def all_valid():
    return torch.ones(GRID.shape, dtype=torch.bool)


def no_lower_core():
    valid = all_valid()
    valid[:, 25:32] = False
    return valid


def no_core():
    valid = all_valid()
    valid[17:32, 17:45] = False
    return valid


@pytest.mark.parametrize(
    ("x", "valid"),
    [(0.2, all_valid), (16.2, all_valid), (20.2, all_valid), (23.4, all_valid), (0.2, no_lower_core), (0.2, no_core)],
    ids=["middle", "8 from the border", "4 from the border", "at the border", "half the core", "most of the core"],
)
def test_light_that_is_seen_in_part_has_the_visibilities_of_all(x, valid):
    """|V|^2 of a point is 1 and its closure phases are 0, so the mean square of their pulls is 1.

    With the centre pulled towards what is seen it was up to 900. At least as many are independent as holes have
    baselines less pistons, 28 in a frame, but the light is common to all |V|^2: 8 count.
    """
    squares, closures = [], []
    for seed in range(SEEDS):
        found = frame_observables(Observation(exposure(seed, x), MASK, GRID, READOUT, valid=valid()))
        squares.append(((found.vis2 - 1) / found.vis2_errors).square().mean())
        closures.append((found.closure_phases / found.closure_errors).square().mean())
    most = 1 + 5 * math.sqrt(2 / 8 / SEEDS)
    assert float(torch.stack(squares).mean()) < most
    assert float(torch.stack(closures).mean()) < most


@pytest.mark.parametrize("x", [0.2, 16.2, 20.2, 23.4])
def test_the_centre_is_the_place_of_the_star(x):
    """To a tenth of a pixel, without noise, which is what |V|^2 asks for.

    The envelope is 15 pixels wide. Moved by a tenth it overlaps itself by all but (0.1 / 15)^2 or so, of which |V|^2
    loses twice as much: 1e-4, a hundredth of the errors of 1e6 electrons. The centre of what is seen was off by pixels.
    """
    for seed in range(3):
        found = FringeModel(MASK, GRID).centre(expected(seed, x), all_valid()[None])
        assert math.dist(found, (x, 0.3)) < 0.1


def test_values_of_pixels_that_are_not_valid_do_not_move_the_centre():
    model, frames, valid = FringeModel(MASK, GRID), exposure(0), no_core()[None]
    spoilt = torch.where(valid, frames, math.nan)
    assert model.centre(spoilt, valid) == model.centre(frames, valid)
