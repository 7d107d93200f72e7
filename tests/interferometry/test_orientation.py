"""The power at a mask's baselines, where the geometry of a mask is looked for."""

import torch

from torchmask.grid import Grid
from torchmask.interferometry.orientation import mean_power


def test_power_at_baselines_is_that_of_the_dft():
    frames = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grid = Grid(16, 550e-9, 550e-9)  # a period of 1 m
    centers = torch.tensor([[3 / 16, 0.0], [0.0, -2 / 16], [0.0, 0.0]], dtype=torch.float64)
    power = (torch.fft.fft2(frames).abs() ** 2).mean(0)
    expected = torch.stack([power[2, 3], power[0, 3], power[-2, 0]])
    torch.testing.assert_close(mean_power(frames, centers, grid), expected)
