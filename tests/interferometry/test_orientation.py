"""What the power of the fringes tells of a mask's orientation, and what it does not."""

import math

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.orientation import _fringe_power, mean_power, orientation_warning
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.geometry import MaskGeometry
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid.nyquist(1.0, 550e-9, 64)
MASK = SparseAperture.random(9, 1.0, 0.12, torch.Generator().manual_seed(4))
ORIENTATIONS = {
    "with x reversed": MaskGeometry(mirrored=True),
    "with x and y swapped": MaskGeometry(math.pi / 2, mirrored=True),
    "turned by 90 degrees": MaskGeometry(math.pi / 2),
}


@pytest.fixture(scope="module")
def frames():
    scene = make_scene((64, 64), n_photons=1e7).double()
    turbulence = TurbulencePhase(r0=1 / 7, outer_scale=20.0)
    generator = torch.Generator().manual_seed(2)
    return simulate_observation(scene, MASK, GRID, turbulence, Detector(1.5), 10, generator).frames.double()


def test_as_told_there_is_nothing_to_say(frames):
    assert orientation_warning(frames, MASK, GRID) is None


@pytest.mark.parametrize("name", ORIENTATIONS)
def test_another_orientation_is_named(frames, name):
    """The mask is told as the inverse of what fits; mirrors and swaps are their own inverses."""
    told = ORIENTATIONS[name].apply(MASK)
    message = orientation_warning(frames, told, GRID)
    assert message is not None
    assert name in message


def test_half_a_turn_changes_nothing(frames):
    assert orientation_warning(frames, MASK.replace(-MASK.centers), GRID) is None


def test_a_mirror_of_symmetric_baselines_cannot_be_seen():
    mask = SparseAperture.from_catalog("golay3", 1.0, 0.15)
    power = _fringe_power(mask, GRID)
    torch.testing.assert_close(power, _fringe_power(ORIENTATIONS["with x reversed"].apply(mask), GRID))


@pytest.mark.parametrize("value", [0.0, 100.0])
def test_noise_says_nothing(value):
    generator = torch.Generator().manual_seed(0)
    noise = value + torch.randn(6, 64, 64, generator=generator, dtype=torch.float64)
    assert orientation_warning(noise, MASK, GRID) is None


def test_expected_power_is_the_sum_of_the_patches_of_all_pairs():
    step = GRID.period / 64  # centres on samples, where the series that a convolution interpolates by is exact
    mask, nu = MASK.replace((0.5 * MASK.centers / step).round() * step), torch.tensor([-10, 3, 17])
    centers = mask.centers / GRID.period
    place = torch.stack(torch.meshgrid(nu / 64, nu / 64, indexing="ij"), -1).double()  # (y, x)
    total = torch.zeros(3, 3, dtype=torch.float64)
    for m in range(9):
        for n in range(9):
            if m != n:
                shift = (place.flip(-1) - centers[m] + centers[n]) * GRID.period
                total += mask.shape.otf(shift, mask.subaperture_diameter) ** 2
    found = _fringe_power(mask, GRID)[nu[:, None], nu]
    torch.testing.assert_close(found, total)


def test_power_at_baselines_is_that_of_the_dft():
    frames = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    grid = Grid(16, 550e-9, 550e-9)  # a period of 1 m
    centers = torch.tensor([[3 / 16, 0.0], [0.0, -2 / 16], [0.0, 0.0]], dtype=torch.float64)
    power = (torch.fft.fft2(frames).abs() ** 2).mean(0)
    expected = torch.stack([power[2, 3], power[0, 3], power[-2, 0]])
    torch.testing.assert_close(mean_power(frames, centers, grid), expected)


def test_a_restoration_warns_of_a_mirrored_mask_and_skips_a_full_pupil(frames):
    mirrored = ORIENTATIONS["with x reversed"].apply(MASK)
    with pytest.warns(UserWarning, match="with x reversed"):
        MyopicDeconvolution(mirrored, GRID, n_modes=3, max_iterations=1).restore(frames)
    MyopicDeconvolution(FullAperture(1.0), GRID, n_modes=3, max_iterations=1).restore(frames)
