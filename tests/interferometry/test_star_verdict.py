"""Whether what was in the beam was a single star, from what the fit of one leaves."""

import math
import warnings

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.calibration import calibrate_mask
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation

GRID = Grid.nyquist(1.0, 550e-9, 32)
MASK = SparseAperture.from_catalog("golay9", 1.0, 0.15)
NOT_EXPLAINED = "not explained by a star and this mask: chi-square is .* check for a companion"


def exposures(electrons=1e6, companion=0.0, apart=5, r0=0.2, n_frames=2, seed=0, scene=None):
    if scene is None:
        scene = torch.zeros(GRID.shape, dtype=torch.float64)
        scene[16, 16], scene[16, 16 + apart] = 1.0, companion
    generator = torch.Generator().manual_seed(seed)
    turbulence = TurbulencePhase(r0, 20.0)
    return simulate_observation(electrons * scene, MASK, GRID, turbulence, Detector(1.5), n_frames, generator).frames


@pytest.mark.parametrize(
    ("electrons", "r0"), [(1e4, 0.2), (3e5, 0.1), (1e6, 0.33), (1e7, 0.2)], ids=["faint", "strong", "weak", "bright"]
)
def test_a_single_star_is_explained_with_the_modes_that_are_left_out(electrons, r0):
    """A warning would be an error here. In bright light modes beyond the six of each hole are far above the noise."""
    verdict = calibrate_mask(exposures(electrons, r0=r0, n_frames=4, seed=1), MASK, GRID).verdict
    assert verdict is not None
    assert verdict.explained
    assert str(verdict).startswith("explained: chi-square is ")
    if electrons == 1e7:
        assert verdict.chi_square > 5
        assert verdict.chi_square == pytest.approx(1 + verdict.model_error, rel=0.5)


@pytest.mark.parametrize(("companion", "apart"), [(0.3, 10), (0.3, 2), (0.1, 5)])
def test_a_double_star_is_no_star(companion, apart):
    with pytest.warns(UserWarning, match=NOT_EXPLAINED) as caught:
        found = calibrate_mask(exposures(companion=companion, apart=apart), MASK, GRID)
    assert caught[0].filename == __file__
    assert found.verdict is not None
    assert found.verdict.chi_square > 2 * found.verdict.limit
    assert "not explained by a star" in str(found)


def test_a_resolved_star_is_no_star():
    """A Gaussian of a third of the diffraction limit, which no mode of a hole imitates at all baselines."""
    y, x = torch.meshgrid(torch.arange(-16, 16), torch.arange(-16, 16), indexing="ij")
    disc = (-(x**2 + y**2) / (2 * 0.6**2)).exp().double()
    with pytest.warns(UserWarning, match="a resolved star"):
        calibrate_mask(exposures(scene=disc / disc.sum()), MASK, GRID)


def test_noise_that_is_not_told_is_measured():
    """Read-out noise of 12 electrons is most of the noise of 3e4 photons."""
    frames = exposures(3e4, n_frames=5, seed=3)
    frames = frames + 12 * torch.randn(frames.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    unknown, known = (calibrate_mask(frames, MASK, GRID, readout_noise=noise).verdict for noise in (0.0, 12.0))
    assert unknown is not None
    assert known is not None
    assert unknown.explained
    assert unknown.chi_square == pytest.approx(1, abs=0.2)
    assert known.chi_square == pytest.approx(unknown.chi_square, rel=0.15)


def test_a_frame_that_a_satellite_has_crossed_is_named():
    """Its glint is as wide as any optics make it, unlike a cosmic ray, which is left out."""
    frames = exposures(n_frames=4)
    y, x = torch.meshgrid(*(torch.arange(side) for side in frames.shape[1:]), indexing="ij")
    frames[3] += 1e4 * torch.exp(-((y - 20.0) ** 2 + (x - 13.0) ** 2) / 6)
    verdict = calibrate_mask(frames, MASK, GRID).verdict
    assert verdict is not None
    assert verdict.explained
    assert verdict.lost == (3,)
    assert "but for frames 3, counted from 0" in str(verdict)


@pytest.mark.parametrize(("companion", "explained"), [(0.1, False), (0.0, True)])
def test_frames_under_clouds_excuse_no_double_star(companion, explained):
    """Four frames and two of noise: the verdict on all is that on the four alone, and the two are named."""
    frames = exposures(companion=companion, n_frames=4)
    noise = torch.randn(2, *GRID.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    noise = 1.5 * noise - (1.5 * noise).mean((1, 2), keepdim=True) + 0.05
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the double star
        clear = calibrate_mask(frames, MASK, GRID, readout_noise=1.5).verdict
        with pytest.warns(
            UserWarning, match=r"frames \[4, 5\] of this stack, .* show no star behind this mask"
        ) as caught:
            found = calibrate_mask(torch.cat([frames, noise]), MASK, GRID, readout_noise=1.5).verdict
    assert caught[0].filename == __file__
    assert clear is not None
    assert found is not None
    assert found.explained == clear.explained == explained
    assert found.limit == pytest.approx(clear.limit, rel=0.1)
    assert found.chi_square == pytest.approx(clear.chi_square, rel=0.1)
    assert set(found.lost) == {*clear.lost, 4, 5}


def test_frames_too_small_for_more_modes_are_not_judged():
    """A square of 9 x 9 pixels has fewer of them than nine holes have modes of the next radial order."""
    grid = Grid.nyquist(1.0, 550e-9, 9)
    scene = torch.zeros(9, 9, dtype=torch.float64)
    scene[4, 4] = 1e6
    frames = simulate_observation(scene, MASK, grid, None, Detector(), 2).frames
    verdict = calibrate_mask(frames, MASK, grid).verdict
    assert verdict is not None
    assert verdict.explained
    assert math.isinf(verdict.limit)


def test_a_star_that_is_too_faint_is_told_so():
    with pytest.raises(ValueError, match=r"noise is \d+ % of the variance of the frames: the star is too faint"):
        calibrate_mask(exposures(500.0), MASK, GRID)


def test_a_wide_object_is_not_called_faint():
    """A disc of more than three times the diffraction limit, in bright light."""
    y, x = torch.meshgrid(torch.arange(-16, 16), torch.arange(-16, 16), indexing="ij")
    disc = (x**2 + y**2 < 3.4**2).double()
    with pytest.raises(ValueError, match=r"explains only \d+ % .* give frames of a point source"):
        calibrate_mask(exposures(scene=disc / disc.sum(), n_frames=1), MASK, GRID)
