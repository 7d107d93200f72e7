"""Turbulence on grids of unlike sides, whose frequencies lie closer along one axis than along the other."""

import pytest
import torch

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.transfer import mean_square_otf
from torchmask.design.turbulent import TurbulentMSE
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.spectra import NoisePSD, PowerLawPSD

SEEING = Seeing(0.15)
# five holes of r0, of which two touch
MASK = SparseAperture([[-0.38, 0.0], [-0.22, 0.04], [0.3, 0.1], [0.05, 0.3], [0.1, -0.33]], 0.16, 1.0)


def power_of(mask, shape):
    grid = Grid.nyquist(1.0, 550e-9, shape)
    return TurbulentMSE(grid, PowerLawPSD(1.5, 1e5), NoisePSD(1e5), 20, r0=SEEING.r0).expected_power(mask)


@pytest.mark.parametrize("shape", [(24, 40), (25, 39)])
def test_a_mask_and_a_grid_that_are_turned_together_show_the_same(shape):
    """By 90 degrees: the same tables, and sums over the same pixels, whose fits of five terms are rounded otherwise."""
    turned = MASK.replace(centers=MASK.centers.flip(-1) * torch.tensor([-1, 1]))
    lying, upright = power_of(MASK, shape), power_of(turned, shape[::-1])
    torch.testing.assert_close(lying, upright.flip(1).roll(1, 1).T, rtol=0, atol=1e-9)


@pytest.mark.parametrize("shape", [(24, 40), (39, 25)])
def test_masks_on_them_agree_with_the_general_integral(shape):
    """At a few of the frequencies that carry more than 2 % of what a pair of holes gives at most; 3 % are promised."""
    power = power_of(MASK, shape)
    pixels = (power[: shape[0] // 2] > 0.02 / 5**2).nonzero()
    pixels = pixels[torch.randperm(len(pixels), generator=torch.Generator().manual_seed(0))[:8]]
    nu_y, nu_x = (torch.fft.fftfreq(side, dtype=torch.float64)[one] for side, one in zip(shape, pixels.T, strict=True))
    exact = mean_square_otf(MASK, Grid.nyquist(1.0, 550e-9, shape), torch.stack([nu_x, nu_y], -1), SEEING)
    torch.testing.assert_close(power[*pixels.T], exact, rtol=0.03, atol=0)
