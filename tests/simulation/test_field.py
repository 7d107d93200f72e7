"""PSFs that vary over the field: against one PSF for each pixel, and through the whole simulation."""

import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector, image_formation
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposed_psf import ExposedPSF
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.field import SPACING, field_points
from torchmask.simulation.wavefronts import isoplanatic_angle, wavefronts

WAVELENGTH = 550e-9
GRID = Grid.nyquist(1.0, WAVELENGTH, 24)
MASK = SparseAperture([[0.0, 0.38], [0.33, -0.2], [-0.35, -0.15]], 0.25, 1.0)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def turbulence(theta0, r0=0.15, **options):
    """Half at the pupil, half so high that theta0 is as wanted [rad]."""
    near = Layers.from_fractions(r0, WAVELENGTH, [0.0, 1.0], [0.5, 0.5])
    layers = Layers.from_fractions(r0, WAVELENGTH, [0.0, near.theta0(WAVELENGTH) / theta0], [0.5, 0.5])
    return LayeredPhase(layers, WAVELENGTH, 20.0, **options)


def lit(first, last):
    scene = torch.zeros(GRID.shape, dtype=torch.float64)
    scene[first : last + 1, first : last + 1] = torch.rand(
        last + 1 - first, last + 1 - first, generator=seeded(9)
    ).double()
    return scene


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 22), st.integers(1, 23), st.integers(0, 23), st.integers(0, 23), st.floats(0.3, 40.0))
def test_every_pixel_of_light_is_divided_among_the_points(top, height, left, width, spacing):
    scene = torch.zeros(24, 24, dtype=torch.float64)
    scene[top : top + height, left : left + width + 1] = 3.0
    points = field_points(scene, GRID, spacing * GRID.pixel_scale)
    torch.testing.assert_close(sum(point.light for point in points), scene)
    assert min(float(point.light.min()) for point in points) >= 0
    columns = sorted({x / GRID.pixel_scale for (x, _), _ in points})
    assert all(b - a <= max(1, spacing) * (1 + 1e-6) for a, b in itertools.pairwise(columns))
    # the middle of the light of a point that is not at the rim lies at the point, as for any bilinear interpolation
    places = torch.arange(24, dtype=torch.float64) - 12
    for axis, k in ((0, 1), (1, 0)):
        mean = sum(float(point.light.sum()) * point.direction[k] / GRID.pixel_scale for point in points)
        assert mean == pytest.approx(float((scene.sum(1 - axis) * places).sum()), rel=1e-9, abs=1e-6)


def test_without_height_there_is_one_psf():
    scene = lit(3, 20)
    assert isoplanatic_angle(TurbulencePhase(0.1, 20.0)) == math.inf
    (point,) = field_points(scene, GRID, math.inf)
    assert point.direction == (0.0, 0.0)
    assert torch.equal(point.light, scene)


@pytest.fixture(scope="module")
def brute_force():
    """Frames of a scene as wide as twice theta0, each lit pixel with a PSF of its own; and those of fewer points."""
    scene, theta0 = lit(7, 17), 5.0 * GRID.pixel_scale
    high, optics = turbulence(theta0), ExposedPSF(MASK, GRID)

    def frames(spacing):
        points = field_points(scene, GRID, spacing)
        stream = wavefronts(high, optics.samples, 2, [0.0], seeded(1))
        images = [sum(image_formation(light, optics(w(direction))) for direction, light in points) for w in stream]
        return torch.stack(images)

    exact = torch.zeros(2, 24, 24, dtype=torch.float64)
    for t, wavefront in enumerate(wavefronts(high, optics.samples, 2, [0.0], seeded(1))):
        for row, column in torch.nonzero(scene).tolist():
            direction = ((column - 12) * GRID.pixel_scale, (row - 12) * GRID.pixel_scale)
            psf = optics(wavefront(direction)).roll((row, column), (0, 1))[:24, :24]
            exact[t] += scene[row, column] * psf
    return exact, {share: frames(share * theta0) for share in (0.2, SPACING / 2, SPACING, 2 * SPACING, math.inf)}


def test_a_point_for_each_pixel_is_brute_force(brute_force):
    exact, found = brute_force
    torch.testing.assert_close(found[0.2], exact, rtol=0, atol=1e-12)


def test_the_frames_of_fewer_points_come_close_to_brute_force(brute_force):
    """Halfway between points SPACING theta0 apart the phase differs from theirs by 0.25^(5/3) = 0.1 rad^2, of which
    bilinear interpolation leaves less than half; a PSF differs by as much of its speckles in amplitude, and sums over a
    scene average it: the error is below 0.03 of what varies in the frames, and falls with the spacing."""
    exact, found = brute_force
    varies = float((exact - exact.mean()).norm())
    error = {share: float((frames - exact).norm()) / varies for share, frames in found.items()}
    assert error[SPACING] < 0.03
    assert error[SPACING / 2] < 0.6 * error[SPACING]
    assert error[2 * SPACING] > 1.5 * error[SPACING]
    assert error[math.inf] > 4 * error[SPACING]  # one PSF is not enough here


def test_the_simulation_is_that_of_its_points(brute_force):
    exact, _ = brute_force
    scene = lit(7, 17)
    seen = simulate_observation(1e8 * scene, MASK, GRID, turbulence(5.0 * GRID.pixel_scale), Detector(), 2, seeded(4))
    # the screens have a seed of the simulation's own
    seed = int(torch.randint(2**62, (2,), generator=seeded(4))[0])
    optics = ExposedPSF(MASK, GRID)
    high = turbulence(5.0 * GRID.pixel_scale)
    points = field_points(scene, GRID, SPACING * high.layers.theta0(WAVELENGTH))
    for t, wavefront in enumerate(wavefronts(high, optics.samples, 2, [0.0], seeded(seed))):
        expected = 1e8 * sum(image_formation(light, optics(wavefront(direction))) for direction, light in points)
        assert float(((seen.frames[t] - expected) / expected.sqrt()).abs().max()) < 5.5  # photons, of 1152 pixels
        middle = optics(wavefront((0.0, 0.0))).roll((12, 12), (0, 1))[:24, :24]
        torch.testing.assert_close(seen.psfs[t], middle, rtol=0, atol=1e-15)
    assert seen.r0 == pytest.approx(0.15)
    assert seen.outer_scale == 20.0
    assert exact.shape == seen.frames.shape


def test_frozen_flow_without_layers_is_one_layer_at_the_pupil():
    """Frames follow each other under the wind, and exposures last in it."""
    scene = 1e6 * lit(8, 14)
    flow = TurbulencePhase(0.15, 20.0, (6.0, 2.0), 0.01)
    layer = Layers.from_fractions(0.15, WAVELENGTH, [0.0], [1.0], [(6.0, 2.0)])
    layered = LayeredPhase(layer, WAVELENGTH, 20.0, 0.01)
    for conditions in (Conditions(), Conditions(exposure_time=0.01)):
        one, other = (
            simulate_observation(scene, MASK, GRID, t, Detector(), 2, seeded(2), conditions=conditions)
            for t in (flow, layered)
        )
        torch.testing.assert_close(one.psfs, other.psfs, rtol=0, atol=1e-14)
        assert float((one.psfs[0] - one.psfs[1]).abs().max()) > 1e-3
