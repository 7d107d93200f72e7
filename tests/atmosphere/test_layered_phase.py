"""The phase behind layers, as stars in several directions show it at several times."""

import itertools
import math

import pytest
import torch

from torchmask.atmosphere.endless import Screen
from torchmask.atmosphere.layers import Layers
from torchmask.atmosphere.phase import LayeredPhase, TurbulencePhase
from torchmask.atmosphere.profiles import named_layers
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture

WAVELENGTH = 500e-9
GRID = Grid.nyquist(1.0, WAVELENGTH, 32)
PUPIL = FullAperture(1.0)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def inside(samples, phase):
    """Of the pupil's samples those that are open."""
    return phase[..., 0, samples.weights[0] > 0]


def places(samples):
    """Which sample stands at (row, column), counted from a corner of the raster, with the pupil in its middle."""
    rows, columns = samples.raster
    found = zip((samples.index[0] // columns).tolist(), (samples.index[0] % columns).tolist(), strict=True)
    return {((r + rows // 2) % rows, (c + columns // 2) % columns): k for k, (r, c) in enumerate(found)}


def mean_square(difference):
    """Over pupil and frames (frame, P), with its standard error from frame to frame."""
    values = difference.square().mean(-1)
    return float(values.mean()), float(values.std()) / math.sqrt(len(values))


def test_the_phase_is_the_sum_of_its_screens_where_the_rays_meet_them():
    """x + h direction - wind t on every layer, whose strength is its own: frozen flow, frame 2, and a delay."""
    layers = Layers([100.0, 3000.0, 9000.0], [3e-13, 1e-13, 5e-14], [(5.0, 1.0), (-8.0, 6.0), (0.0, 30.0)])
    samples, (angle_x, angle_y) = PUPIL.samples(GRID), (2e-5, -1e-5)
    frames = LayeredPhase(layers, WAVELENGTH, 20.0, frame_interval=0.01).draws(samples, seeded(1))
    frame = next(itertools.islice(frames, 2, None))
    time = 2 * 0.01 + 0.003
    expected = 0.0
    for screen, height, (vx, vy), r0 in zip(
        frame.screens, layers.heights, layers.winds, layers.layer_r0(WAVELENGTH), strict=True
    ):
        plain = Screen(screen.window, 1.0, screen.seed)
        expected = expected + r0 ** (-5 / 6) * plain.at((height * angle_x - vx * time, height * angle_y - vy * time))
    assert len({screen.seed for screen in frame.screens}) == 3
    torch.testing.assert_close(
        frame.phase(0.003, (angle_x, angle_y)), expected.flatten()[frame.place], rtol=1e-10, atol=1e-10
    )


def test_frames_differ_in_direction_and_time_as_the_layers_say():
    """Drawn: 80 frames, each with its mean square over the pupil; moves of one to three samples."""
    layers = Layers([0.0, 3000.0, 9000.0], [3e-13, 1e-13, 5e-14], [(30.0, 0.0), (-36.0, 32.0), (0.0, 60.0)])
    samples, outer_scale = PUPIL.samples(GRID), 2.0
    frames = itertools.islice(LayeredPhase(layers, WAVELENGTH, outer_scale).draws(samples, seeded(2)), 80)
    views = [(0.0, (0.0, 0.0)), (0.003, (0.0, 0.0)), (0.0, (2e-5, -1e-5)), (-0.003, (-1e-5, 2e-5))]
    drawn = [[frame.phase(*view) for view in views] for frame in frames]
    seen = torch.stack([inside(samples, torch.stack(phases)) for phases in drawn], dim=1)
    for k in range(1, len(views)):
        for m in range(k):
            found, error = mean_square(seen[k] - seen[m])
            direction = tuple(a - b for a, b in zip(views[k][1], views[m][1], strict=True))
            later = views[k][0] - views[m][0]
            exact = float(layers.structure_function(WAVELENGTH, outer_scale, direction=direction, delay=later))
            assert error < 0.06 * exact
            assert found == pytest.approx(exact, abs=4 * error + 0.015 * exact), (k, m)


# ---- geometry, exactly


def test_a_star_to_the_right_is_seen_through_what_lies_to_the_right():
    """The phase of a star three samples of the layer to +x is that of the star in the middle, three samples further."""
    layer = Layers([2000.0], [1e-13])
    samples = PUPIL.samples(GRID)
    stars = torch.tensor([[0.0, 0.0], [3 * samples.step[1] / 2000, 0.0], [0.0, 3 * samples.step[0] / 2000]])
    middle, right, up = LayeredPhase(layer, WAVELENGTH, 20.0)(samples, 1, seeded(4), stars.double())[:, 0, 0]
    at = places(samples)
    for star, (dy, dx) in ((right, (0, 3)), (up, (3, 0))):
        pairs = [(k, at[r + dy, c + dx]) for (r, c), k in at.items() if (r + dy, c + dx) in at]
        here, there = torch.tensor(pairs).T
        assert len(pairs) > 250
        # float32 directions are off by 6e-8 of three samples
        torch.testing.assert_close(star[here], middle[there], rtol=0, atol=1e-5)
        assert float((star - middle).abs().max()) > 0.1


def test_a_wind_shows_later_what_a_direction_shows_now():
    layer = Layers([4000.0], [1e-13], [(10.0, -6.0)])
    frame = next(LayeredPhase(layer, WAVELENGTH, 20.0).draws(PUPIL.samples(GRID), seeded(5)))
    later, aside = frame.phase(delay=0.002), frame.phase(direction=(-0.02 / 4000, 0.012 / 4000))
    torch.testing.assert_close(later, aside, rtol=0, atol=1e-9)
    assert float((later - frame.phase()).abs().max()) > 0.1


def test_one_layer_at_the_ground_is_the_same_flow_as_plain_turbulence():
    wind, samples = (12.0, 7.0), PUPIL.samples(GRID)
    layer = Layers.from_fractions(0.12, WAVELENGTH, [0.0], [1.0], [wind])
    flow = LayeredPhase(layer, WAVELENGTH, 20.0, frame_interval=0.005)(samples, 4, seeded(6), (1e-5, 0.0))
    plain = TurbulencePhase(0.12, 20.0, wind, 0.005)(samples, 4, seeded(6))
    torch.testing.assert_close(flow, plain, rtol=1e-12, atol=1e-12)


def test_frames_flow_on_or_are_independent():
    layers, samples = Layers([1000.0], [1e-13], [(1e-3, 0.0)]), PUPIL.samples(GRID)
    flow = LayeredPhase(layers, WAVELENGTH, 2.0, frame_interval=1.0)(samples, 30, seeded(7))[:, 0]
    independent = LayeredPhase(layers, WAVELENGTH, 2.0)(samples, 30, seeded(7))[:, 0]
    assert float((flow[1:] - flow[:-1]).std()) < 0.02 * float(flow.std())  # it moves by a millimetre
    change = (independent[1:] - independent[:-1]).square().mean() / independent.square().mean()
    assert 1 < float(change) < 3  # twice the variance; 30 frames within a pupil of half the outer scale


def test_axes_types_and_seeds():
    layers = named_layers("hv57", 2)
    centers = torch.tensor([[[0.0, 0.3], [0.2, -0.2]], [[0.2, -0.2], [-0.3, 0.1]]], dtype=torch.float32)
    samples = SparseAperture(centers, 0.3, 1.2).samples(Grid.nyquist(1.2, WAVELENGTH, 32))
    turbulence = LayeredPhase(layers, WAVELENGTH, 20.0)
    stars = torch.zeros(4, 1, 2)
    phase = turbulence(samples, 3, seeded(), stars)
    assert phase.shape == (4, 1, 2, 3, 2, samples.weights.shape[-1])  # (direction, mask, frame, hole, sample)
    assert phase.dtype == torch.float32
    assert torch.equal(phase[0, 0], phase[3, 0])
    assert torch.equal(phase[0, 0, 0, :, 1], phase[0, 0, 1, :, 0])  # the same hole in two masks
    assert torch.equal(turbulence(samples, 2, seeded()), phase[0, 0, :, :2])
    assert not torch.allclose(turbulence(samples, 3, seeded(1)), phase[0, 0])


def test_bad_input_is_refused():
    layers = named_layers("hv57", 2)
    with pytest.raises(ValueError, match="outer_scale is 0"):
        LayeredPhase(layers, WAVELENGTH, 0.0)
    with pytest.raises(ValueError, match="wavelength is -1"):
        LayeredPhase(layers, -1.0, 20.0)
    with pytest.raises(ValueError, match="frame_interval is 0"):
        LayeredPhase(layers, WAVELENGTH, 20.0, frame_interval=0.0)
    turbulence, samples = LayeredPhase(layers, WAVELENGTH, 20.0), PUPIL.samples(GRID)
    with pytest.raises(ValueError, match="n_frames is 0"):
        turbulence(samples, 0)
    with pytest.raises(ValueError, match=r"direction has shape \(3,\): its last axis must be \(x, y\), in rad"):
        turbulence(samples, 1, None, torch.zeros(3))
