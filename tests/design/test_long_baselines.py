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
    a mean phasor over 2 m is below 1e-6."""
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


@pytest.mark.parametrize(
    ("turns", "wavelengths"),
    [((1.02, 0.0), None), ((0.98, 0.98), None), ((0.0, -1.02), None), ((1.0, 0.0), (500e-9, 600e-9))],
)
def test_what_a_lens_keeps_is_decided_by_its_true_baseline(turns, wavelengths):
    """Holes of 1.5 r0 whose baselines, of 10 r0, alias onto zero frequency, where turbulence leaves all of a lens: with
    what it leaves there masks were 16 to 21 % too bright (4 % in a band, whose baselines alias around it)."""
    grid, seeing, turns = Grid.nyquist(1.0, 550e-9, 32), Seeing(0.2, 20.0), torch.tensor(turns, dtype=torch.float64)
    ends = grid.period / 2 * torch.stack([-turns, turns])
    mask = SparseAperture(torch.cat([ends, torch.tensor([[0.15, 0.35]])]), 1.5 * seeing.r0, 3 * grid.period)
    psds = PowerLawPSD(1.5, 1e5), NoisePSD(1e5)
    criterion = TurbulentMSE(grid, *psds, 20, r0=seeing.r0, outer_scale=20.0, wavelengths=wavelengths)
    pixels = torch.tensor([[0, 0], [1, 1]])
    found = criterion.expected_power(mask)[pixels[:, 0], pixels[:, 1]]
    aliases = [pixels.flip(-1) / 32 + number * turns.round() for number in (-1, 0, 1)]
    exact = torch.stack([mean_square_otf(mask, grid, nu, seeing, criterion.band) for nu in aliases]).sum(0)
    torch.testing.assert_close(found, exact, rtol=0.03, atol=0)


@pytest.mark.parametrize(("longest", "columns"), [(1.01, (0, 1)), (1.3, (9, 10))])
def test_redundant_baselines_that_alias_share_what_they_do_where_they_are(longest, columns):
    """Two pairs of holes of half r0 with nearly one baseline, whose lenses lie side by side: what they share was 50 to
    80 % too bright where they alias onto zero frequency, and 30 % at 0.3 of a period. 3 % are promised."""
    grid, seeing = Grid.nyquist(1.0, 550e-9, 32), Seeing(0.5, 20.0)
    end = longest / 2 * grid.period
    mask = SparseAperture([[-end, 0.0], [end, 0.0], [-end, 0.3], [end, 0.32]], seeing.r0 / 2, 3 * grid.period)
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=seeing.r0, outer_scale=20.0)
    pixels = torch.tensor([[row, column] for row in (0, 1) for column in columns])
    found = criterion.expected_power(mask)[pixels[:, 0], pixels[:, 1]]
    aliases = [pixels.flip(-1).double() / 32 + torch.tensor([turns, 0.0]) for turns in (-1, 0, 1)]
    exact = torch.stack([mean_square_otf(mask, grid, nu, seeing) for nu in aliases]).sum(0)
    assert (exact > 0.02 / 4**2).all()
    torch.testing.assert_close(found, exact, rtol=0.03, atol=0)


def test_gradients_of_redundant_baselines_that_alias():
    grid = Grid.nyquist(1.0, 550e-9, 24)
    criterion = TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=0.5, outer_scale=20.0)
    centers = torch.tensor([[-1.01, 0.013], [1.013, 0.0], [-1.017, 0.31], [1.0, 0.327]]).double().requires_grad_()
    torch.autograd.gradcheck(lambda x: criterion.relative(SparseAperture(x, 0.25, 3.0)), centers, eps=1e-6, atol=1e-6)
