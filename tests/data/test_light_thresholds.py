"""From how much light on, and for how large a loss of it, a frame counts as clouded or unlit: from both sides."""

import math

import numpy as np
import pytest

from torchmask.data.calibration import best_frames
from torchmask.data.light import find_clouds, find_unlit, frame_light

SIDE = 24
# The border of 92 pixels is 1 and -1 in turns: its median is 0, its median absolute deviation 1.
NOISE = 1.4826 * math.sqrt(SIDE**2 + math.pi / 2 * SIDE**4 / 92)


def frames_with(light):
    """Frames whose light is exactly `light`, in their middle, with the noise `NOISE`."""
    frame = np.zeros((SIDE, SIDE))
    rim = [(0, k) for k in range(SIDE)] + [(SIDE - 1, k) for k in range(SIDE)]
    rim += [(k, side) for k in range(1, SIDE - 1) for side in (0, SIDE - 1)]
    for number, place in enumerate(rim):
        frame[place] = (-1) ** number
    frames = np.repeat(frame[None], len(light), 0)
    frames[:, 11:13, 11:13] = np.array(light)[:, None, None] / 4
    return frames


def found_in(look, frames):
    return np.flatnonzero(look(frames, np.ones(frames.shape, dtype=bool))).tolist()


def found(look, light):
    return found_in(look, frames_with(light))


def test_the_light_and_its_noise_are_those_of_the_closed_form():
    frames = frames_with([1000.0, 0.0])
    light, noise = frame_light(frames, np.ones(frames.shape, dtype=bool))
    np.testing.assert_allclose(light, [1000, 0], atol=1e-9)
    np.testing.assert_allclose(noise, NOISE, rtol=1e-12)


@pytest.mark.parametrize("look", [find_clouds, find_unlit])
def test_frames_are_compared_from_five_times_the_noise_on(look):
    assert found(look, [5.1 * NOISE] * 4 + [0.0]) == [4]
    assert found(look, [4.9 * NOISE] * 4 + [0.0]) == []


@pytest.mark.parametrize("look", [find_clouds, find_unlit])
def test_three_frames_tell_what_is_usual_and_two_do_not(look):
    assert found(look, [1e6, 0.0, 1e6]) == [1]
    assert found(look, [1e6, 0.0]) == []


def test_a_cloud_takes_half_of_a_steady_light():
    assert found(find_clouds, [1e6] * 5 + [0.49e6, 0.51e6]) == [5]


def test_a_cloud_takes_more_than_five_scatters_of_an_unsteady_light():
    """Logarithms of the light are 0.2, 0 and -0.2, of a median deviation of 0.2: five scatters are a factor 0.227."""
    usual = [1e6 * math.exp(turn * 0.2) for turn in (1, -1, 1, -1, 0, 0, 1, -1)]
    limit = 1e6 * math.exp(-5 * 1.4826 * 0.2)
    assert found(find_clouds, [*usual, 1.01 * limit]) == []
    assert found(find_clouds, [*usual, 0.99 * limit]) == [8]


def test_a_frame_with_a_bright_rim_that_shows_the_target_is_not_unlit():
    """Stray light on the border counts as the level of all pixels, so that the light that is left is negative."""
    frames = frames_with([1e6] * 5)
    frames[3, [0, -1]] = frames[3, :, [0, -1]] = 1e4
    light, _ = frame_light(frames, np.ones(frames.shape, dtype=bool))
    assert light[3] < 0
    assert found_in(find_unlit, frames) == []
    frames[3, 11:13, 11:13] = 0
    assert found_in(find_unlit, frames) == [3]


def test_what_the_others_show_is_their_mean_where_they_are_valid():
    """Frame 4 shows 1.5 where the only other valid frame shows 100: 0.03 of their mean, 0.04 with the rim's ripple."""
    frames = frames_with([1e6] * 4 + [0.0])
    frames[:, 11:13, 11:13] = 100.0
    frames[:, 5, 5] = 1e6
    valid = np.ones(frames.shape, dtype=bool)
    valid[1:4, 11:13, 11:13] = False
    valid[4, 5, 5] = False
    for shown, unlit in ((1.5, [4]), (6.0, [])):
        frames[4, 11:13, 11:13] = shown
        assert np.flatnonzero(find_unlit(frames, valid)).tolist() == unlit


def test_the_number_of_frames_kept_is_the_nearest_to_the_fraction():
    frames = frames_with(np.arange(10.0, 0.0, -1.0))
    valid = np.ones(frames.shape, dtype=bool)
    for keep, count in ((0.34, 3), (0.36, 4), (0.99, 10), (0.04, 1)):
        assert best_frames(frames, valid, keep, "flux").tolist() == list(range(count))
