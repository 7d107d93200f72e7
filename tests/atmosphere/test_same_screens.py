"""With the same generator every pupil on a raster sees the same screens, and nothing jumps as a hole moves."""

import pytest
import torch

from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.psf import PSF

GRID = Grid.nyquist(1.0, 550e-9, 32)
CENTERS = torch.tensor([[0.0, 0.3], [0.3, -0.2], [-0.25, -0.15]], dtype=torch.float64)
KINDS = {
    "still": TurbulencePhase(0.15, 20.0),
    "flow": TurbulencePhase(0.15, 20.0, wind=(3.0, 1.0), frame_interval=0.01),
    "layers": LayeredPhase(named_layers("hv57", n_layers=2), 550e-9, 20.0),
}


def mask_of(centers):
    return SparseAperture(centers, 0.2, 1.0)


def on_raster(turbulence, samples):
    """The phases (2, rows * columns) of two frames, NaN where the pupil has no samples."""
    phase = turbulence(samples, 2, torch.Generator().manual_seed(0))
    raster = phase.new_full((2, samples.raster[0] * samples.raster[1]), torch.nan)
    raster[:, samples.index.flatten()] = phase.flatten(1)
    return raster


@pytest.mark.parametrize("turbulence", KINDS.values(), ids=KINDS.keys())
@pytest.mark.parametrize("oversampling", [1, 4])
def test_masks_and_full_pupils_see_the_same_screens(turbulence, oversampling):
    seen = [
        on_raster(turbulence, pupil.samples(GRID, oversampling))
        for pupil in (FullAperture(1.0), mask_of(CENTERS), mask_of(0.8 * CENTERS), FullAperture(0.6))
    ]
    for other in seen[1:]:
        both = ~(seen[0].isnan() | other.isnan())
        assert both.any()
        assert torch.equal(seen[0][both], other[both])


@pytest.mark.parametrize("turbulence", KINDS.values(), ids=KINDS.keys())
def test_a_mask_sees_alone_what_it_sees_in_a_population(turbulence):
    masks = torch.stack([CENTERS, 0.9 * CENTERS, CENTERS.flip(-1)])
    together = turbulence(mask_of(masks).samples(GRID), 2, torch.Generator().manual_seed(0))
    for centers, phase in zip(masks, together, strict=True):
        alone = turbulence(mask_of(centers).samples(GRID), 2, torch.Generator().manual_seed(0))
        assert torch.equal(alone, phase)


@pytest.mark.parametrize("turbulence", KINDS.values(), ids=KINDS.keys())
def test_single_precision_sees_the_screens_of_double_precision(turbulence):
    """But for rounding: of the phasors and sums that make the screens, a few units in the last place of the largest."""
    double, single = (
        turbulence(mask_of(CENTERS.to(dtype)).samples(GRID), 2, torch.Generator().manual_seed(0))
        for dtype in (torch.float64, torch.float32)
    )
    assert single.dtype == torch.float32
    few = 64 * torch.finfo(torch.float32).eps
    torch.testing.assert_close(single.double(), double, rtol=0, atol=few * float(double.abs().max()))


@pytest.mark.parametrize("turbulence", KINDS.values(), ids=KINDS.keys())
def test_psfs_do_not_jump_as_a_hole_moves(turbulence):
    """Where the outermost hole begins to be sampled from the next cell on; the screens themselves were others then.

    A step of 1e-5 of a hole's diameter changes a PSF of unit sum by about as little; one through another screen differs
    by about 1. The bound lies between the two.
    """
    step, cell = 1e-6, 2.0 / 64  # [m]

    def psf(x):
        centers = torch.tensor([[0.0, 0.3], [x, -0.2], [-0.25, -0.15]], dtype=torch.float64)
        made = PSF(mask_of(centers), GRID, oversampling=2)
        return made(turbulence(made.samples(), 1, torch.Generator().manual_seed(0)))

    with torch.no_grad():
        for x in (9.5 * cell, 10.5 * cell):
            assert (psf(x + step) - psf(x - step)).abs().sum() < 1e-3


@pytest.mark.parametrize("turbulence", KINDS.values(), ids=KINDS.keys())
def test_a_population_of_none_has_no_phases(turbulence):
    none = mask_of(CENTERS.expand(0, 3, 2)).samples(GRID)
    assert turbulence(none, 4).shape == (0, 4, 3, none.index.shape[-1])


def test_stars_of_none_have_no_phases():
    samples = mask_of(CENTERS).samples(GRID)
    assert KINDS["layers"](samples, 4, direction=torch.zeros(0, 2)).shape == (0, 4, *samples.index.shape)
