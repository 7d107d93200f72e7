import math

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import OTF, analytic_otf

WAVELENGTH = 550e-9


def random_mask(seed, diameter=0.12, shape="disc", n=7):
    """Seven holes (or the first n of them) that do not overlap, turned and jittered."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand((), generator=generator, dtype=torch.float64)
    turn = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
    spots = [[0.02, 0.01], [0.3, 0.05], [-0.32, 0.1], [0.1, 0.3], [-0.12, -0.33], [0.25, -0.22], [-0.2, 0.31]]
    jitter = 0.05 * torch.rand(7, 2, generator=generator, dtype=torch.float64)
    centers = (torch.tensor(spots, dtype=torch.float64) + jitter)[:n] @ turn.T
    return SparseAperture(centers, diameter, 1.0, shape, orientation=0.3 * seed)


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_otf_approaches_the_autocorrelation_everywhere(shape):
    """At worst 0.6 / (samples across a hole), two-sided, and falling as the sampling grows; measured: 0.33."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    worst = []
    for oversampling in (2, 4, 8):
        errors = []
        for seed in range(4):
            aperture = random_mask(seed, shape=shape)
            numerical = OTF(aperture, grid, oversampling)()
            errors.append(float((numerical - analytic_otf(aperture, grid)).abs().max()))
            # Zero frequency is exactly one by normalisation, up to the rounding of the sums.
            assert abs(complex(numerical[0, 0]) - 1) < 1e-13
        samples_across = 0.12 * 64 * oversampling / grid.period
        worst.append(max(errors) * samples_across)
        assert worst[-1] < 0.6
    assert worst[2] < 1.1 * worst[0]  # error x sampling does not grow: the fall is at least linear


@pytest.mark.parametrize("obstruction", [0.0, 0.4])
def test_full_pupil_approaches_the_textbook_otf(obstruction):
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    aperture = FullAperture(1.0, obstruction)
    for oversampling in (1, 4):
        error = (OTF(aperture, grid, oversampling)() - analytic_otf(aperture, grid)).abs().max()
        # edges are what is misjudged: in proportion to their length over the area
        assert error < 0.6 / (32 * oversampling) / (1 - obstruction)


def test_pistons_enter_as_in_the_closed_form():
    grid = Grid.nyquist(1.0, WAVELENGTH, 64)
    aperture = random_mask(5)
    pistons = torch.tensor([[0.0, 1.0, -2.0, 0.5, 3.0, -0.7, 0.1], [0.0] * 7], dtype=torch.float64)
    model = OTF(aperture, grid, 8)
    n_samples = model.samples().weights.shape[-1]
    numerical = model(pistons[..., None].expand(-1, -1, n_samples))
    analytic = analytic_otf(aperture, grid, pistons)
    assert (numerical - analytic).abs().max() < 0.6 / (0.12 * 64 * 8 / grid.period)
    # Broken on purpose: the conjugate pistons miss by far.
    assert (numerical[0] - analytic_otf(aperture, grid, -pistons)[0]).abs().max() > 0.05


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_otf_follows_a_hole_that_moves_by_a_tenth_of_a_sample(shape):
    """At 15 samples across a hole, where the error is dominated by light aliased at the border of the field."""
    grid = Grid.nyquist(1.0, WAVELENGTH, 128)
    for seed in range(4):
        aperture = random_mask(seed, shape=shape)
        moved = aperture.centers.clone()
        moved[seed, seed % 2] += 0.1 * grid.period / 256
        other = aperture.replace(centers=moved)
        numerical = OTF(other, grid, 2)() - OTF(aperture, grid, 2)()
        analytic = analytic_otf(other, grid) - analytic_otf(aperture, grid)
        assert (numerical - analytic).abs().max() <= 1e-3
        assert analytic.abs().max() > 1e-3  # there is a change to follow
