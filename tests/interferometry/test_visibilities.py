"""Visibilities and closure phases of restored objects: closed forms, errors, and what a restoration gains."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from torch import Tensor

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.visibilities import restored_observables, sky_stations
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.pixel import SquarePixel
from torchmask.optics.round import disc_otf
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.simulation.exposures import simulate_observation

CENTERS = [[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05]]
WAVELENGTH = 550e-9


@pytest.fixture
def mask():
    return SparseAperture(CENTERS, 0.1, 1.0)


@pytest.fixture
def grid(mask):
    return Grid.nyquist(mask.extent, WAVELENGTH, 48, 1.1)


def wrapped(angle):
    return (angle + math.pi) % (2 * math.pi) - math.pi


@dataclass(frozen=True)
class Restored:
    """All that visibilities need of a restoration."""

    object: Tensor
    coefficients: Tensor
    noise: float
    chi_square: Tensor


def restored(scene, mask, n_frames=1, noise=1.0):
    coefficients = torch.zeros(n_frames, mask.n_subapertures, 3, dtype=torch.float64)
    return Restored(scene, coefficients, noise, torch.ones(n_frames))


def test_oblong_and_skewed_pixels_have_the_phase_of_their_place_on_the_sky(mask, grid, sky_cards):
    header = sky_cards(0.4, grid.pixel_scale)
    header |= {"CD1_1": 1.01 * header["CD1_1"], "CD2_1": 1.02 * header["CD2_1"]}
    matrix = np.radians([[header["CD1_1"], header["CD1_2"]], [header["CD2_1"], header["CD2_2"]]])
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0, header=header)
    x, y = 5.0, -3.0
    nu = mask.centers.numpy() / grid.period
    expected = nu @ [x, y]
    stations = sky_stations(observation).numpy()
    np.testing.assert_allclose(stations @ (matrix @ [x, y]) / WAVELENGTH, expected, rtol=1e-12, atol=1e-12)


def test_a_restored_object_has_exactly_the_visibilities_of_its_pixels(mask, grid, binary):
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[24, 24], scene[29, 17] = 300.0, 60.0
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0)
    observables = restored_observables(restored(scene, mask), observation)
    pair = binary(-7 * grid.pixel_scale, 5 * grid.pixel_scale, 0.2)
    expected = pair.visibilities(observables.baselines, WAVELENGTH)
    np.testing.assert_allclose(observables.visibilities, expected, atol=1e-12)
    np.testing.assert_allclose(observables.vis2, np.abs(expected) ** 2, atol=1e-12)
    phases = observables.closure_phases.numpy() - pair.closure_phases(observables.baselines, WAVELENGTH)
    np.testing.assert_allclose(wrapped(phases), 0, atol=1e-12)


@pytest.mark.filterwarnings("ignore:frames .* repeat earlier ones")  # without noise
@pytest.mark.parametrize("pixel", [None, SquarePixel()])
def test_errors_of_a_restored_object_are_those_of_frames_with_its_noise(pixel, expose_points):
    # White noise, no aberrations, patches that do not overlap: two ways to the same error.
    mask = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15]], 0.07, 1.0)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 96, 1.1)
    frames = expose_points(mask, grid, electrons=1e5, n_frames=2, pistons=False)
    if pixel is not None:
        frames = torch.fft.ifft2(torch.fft.fft2(frames) * pixel.transfer(*grid.frequencies(torch.float64))).real
    observation = Observation(frames, mask, grid, 0.0, errors=torch.full_like(frames, 3.0), pixel=pixel)
    direct = frame_observables(observation)
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[48, 48] = 1e5
    found = restored_observables(restored(scene, mask, n_frames=2, noise=3.0), observation)
    # a hole, sampled 8 times, and its patch of 40 frequencies are known to some percent
    for name in ("visibility_errors", "vis2_errors", "closure_errors", "triple_errors"):
        torch.testing.assert_close(getattr(found, name), getattr(direct, name), rtol=0.08, atol=0)
    louder = restored_observables(restored(scene, mask, n_frames=2, noise=6.0), observation)
    torch.testing.assert_close(louder.closure_errors, 2 * found.closure_errors)
    worse = replace(restored(scene, mask, n_frames=2, noise=3.0), chi_square=torch.tensor([3.0, 5.0]))
    torch.testing.assert_close(restored_observables(worse, observation).closure_errors, 2 * found.closure_errors)


def test_squares_have_the_covariance_of_circular_noise_and_of_light_that_all_share(mask, grid):
    """Of |V + n|^2 it is 2 |V|^2 E|n|^2 + (E|n|^2)^2, and light that is wrong by a fraction e lowers all by 2 e."""
    scene = torch.zeros(grid.shape, dtype=torch.float64)
    scene[24, 24], scene[25, 23] = 300.0, 60.0
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0)
    found = restored_observables(restored(scene, mask, n_frames=2, noise=2.0), observation)
    power, noise = found.vis2, 2 * found.visibility_errors**2  # of real and imaginary part
    assert float((noise / power).min()) > 0.1  # the square of the noise counts
    nu_y, nu_x = grid.frequencies(torch.float64)
    transfer = disc_otf((torch.hypot(nu_x, nu_y) / grid.cutoff(0.1)).clamp(max=1))  # of all holes, about zero frequency
    of_light = 2.0**2 * math.prod(grid.shape) / (360.0**2 * 2 * float(transfer.square().sum()))
    apart = torch.triu_indices(6, 6, 1).unbind()
    shared = found.vis2_covariance[apart] / (power[:, None] * power)[apart]
    torch.testing.assert_close(shared, shared[0].expand(15), rtol=1e-9, atol=0)
    # a hole, sampled 8 times, and its patch of 40 frequencies are known to some percent
    assert float(shared[0]) == pytest.approx(4 * of_light, rel=0.08)
    own = found.vis2_covariance.diagonal() - shared[0] * power**2
    torch.testing.assert_close(own, 2 * power * noise + noise**2, rtol=1e-9, atol=0)


def test_restoring_a_binary_brings_its_closure_phases_nearer_the_truth(binary):
    mask = SparseAperture.from_catalog("golay6", 1.0, 0.12)
    grid = Grid.nyquist(mask.extent, WAVELENGTH, 48)
    scene = torch.zeros(48, 48, dtype=torch.float64)
    scene[24, 24], scene[20, 27] = 1e6, 3e5
    turbulence, generator = TurbulencePhase(0.2, 20.0), torch.Generator().manual_seed(0)
    seen = simulate_observation(scene, mask, grid, turbulence, Detector(), 8, generator)
    result = MyopicDeconvolution(mask, grid, r0=0.2, max_iterations=300).restore(seen.frames)
    pair, rms = binary(3 * grid.pixel_scale, -4 * grid.pixel_scale, 0.3), []
    for observables in (restored_observables(result, seen), frame_observables(seen)):
        truth = pair.closure_phases(observables.baselines, WAVELENGTH)
        rms.append(float(np.sqrt((wrapped(observables.closure_phases.numpy() - truth) ** 2).mean())))
    assert np.abs(truth).max() > 0.5
    assert rms[0] < 0.5 * rms[1]
    assert rms[1] < 0.06


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (torch.zeros(48, 48), "the restored object is zero everywhere: it has no visibilities"),
        (torch.ones(8, 8), r"the object has shape \(8, 8\): the observation's frames have \(48, 48\)"),
    ],
)
def test_objects_without_visibilities_are_refused(mask, grid, scene, message):
    observation = Observation(torch.ones(1, *grid.shape), mask, grid, 0.0)
    with pytest.raises(ValueError, match=message):
        restored_observables(restored(scene, mask), observation)


def test_a_full_pupil_has_no_baselines(grid):
    observation = Observation(torch.ones(1, *grid.shape), FullAperture(0.9), grid, 0.0)
    with pytest.raises(ValueError, match=r"give at least two holes"):
        restored_observables(restored(torch.ones(grid.shape), FullAperture(0.9)), observation)
