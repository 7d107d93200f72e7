"""Masks that are wider than the frequency torus, whose baselines alias."""

import pytest
import torch

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import mean_square_otf
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD


@pytest.mark.parametrize("longest", [1.3, 1.7])
def test_holes_a_period_apart_and_more_leave_what_each_shows_alone(longest):
    """At frequencies below a hole, where the lenses of all holes with themselves meet; the baselines of such holes lie
    elsewhere on the torus, 0.3 of a period from there. The integral's own samples err by half a per cent, and
    the promise is 3 %."""
    grid = Grid.nyquist(1.0, 550e-9, 32)
    ends = [[-longest / 2 * grid.period, 0.0], [longest / 2 * grid.period, 0.0], [0.0, 0.3]]
    mask, seeing = SparseAperture(ends, 0.3, 2 * grid.period), Seeing(0.4, 20.0)
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=seeing.r0, outer_scale=20.0)
    pixels = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 2]])
    found = criterion.expected_power(mask)[pixels[:, 0], pixels[:, 1]]
    exact = mean_square_otf(mask, grid, pixels.flip(-1).double() / 32, seeing)
    assert (exact > 0.02 / 3**2).all()  # of what one pair of holes gives at most
    torch.testing.assert_close(found, exact, rtol=0.03, atol=0)


@pytest.mark.parametrize("longest", [0.95, 1.0, 1.04])
def test_baselines_that_alias_onto_others_add_without_their_phases(longest):
    """Those of two holes a period apart fall on the lenses of holes with themselves, with which they share nothing, as
    a mean phasor over 2 m is below 1e-6. What one lens keeps of its own light is taken at the baseline on the torus:
    holes of 0.15 r0 lose 4 % of a fifth of the light, a part of the promised 3 %."""
    grid, seeing = Grid.nyquist(1.0, 550e-9, 32), Seeing(0.8, 20.0)
    ends = [[-longest / 2 * grid.period, 0.0], [longest / 2 * grid.period, 0.0], [0.0, 0.3]]
    mask = SparseAperture(ends, 0.15 * seeing.r0, 2 * grid.period)
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=seeing.r0, outer_scale=20.0)
    pixels = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
    found = criterion.expected_power(mask)[pixels[:, 0], pixels[:, 1]]
    frequencies = pixels.flip(-1).double() / 32
    aliases = [frequencies + torch.tensor([turns, 0.0], dtype=torch.float64) for turns in (-1, 0, 1)]
    exact = torch.stack([mean_square_otf(mask, grid, nu, seeing) for nu in aliases]).sum(0)
    torch.testing.assert_close(found, exact, rtol=0.03, atol=0)
