"""Frames without light are left out, clouds are told, and neither is seen where there is none."""

import warnings
from functools import cache

import numpy as np
import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.data.light import find_clouds, find_unlit, frame_light, usable_frames
from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.conditions import Conditions
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

MASK = SparseAperture.from_catalog("golay6", 1.0, 0.15)
GRID = Grid.nyquist(1.0, 550e-9, 32)


@cache
def satellite(size):
    """One electron of it; rendered once for all stacks."""
    return make_scene(GRID.shape, 1.0, SceneOptions(size=size))


def observe(n_photons=1e5, size=0.5, seed=0, **conditions):
    scene = n_photons * satellite(size)
    generator = torch.Generator().manual_seed(seed)
    seen = simulate_observation(
        scene,
        MASK,
        GRID,
        TurbulencePhase(0.2, 20.0),
        Detector(3.0),
        12,
        generator,
        conditions=Conditions(**conditions),
    )
    return seen.frames.numpy()


def everywhere(frames):
    return np.ones(frames.shape, dtype=bool)


def usable(frames, skip=()):
    """The numbers that are kept and what is said."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return usable_frames(frames, everywhere(frames), skip).tolist(), [str(warning.message) for warning in caught]


@pytest.mark.parametrize("sky", [0.0, 50.0])
@pytest.mark.parametrize("bias", [0.0, 40.0])
def test_a_closed_shutter_is_seen_with_or_without_a_bias(sky, bias):
    frames = observe(sky=sky)
    rng = np.random.default_rng(1)
    frames[[2, 7]] = bias + 3.0 * rng.standard_normal((2, 32, 32))
    kept, said = usable(frames)
    assert kept == [0, 1, 3, 4, 5, 6, 8, 9, 10, 11]
    if bias:
        assert said == [
            "frames [2, 7] show nothing of what the others show, as with a closed shutter: they are left out, and "
            "10 remain"
        ]


@pytest.mark.parametrize("conditions", [{}, {"sky": 100.0}, {"transparency_scatter": 0.2}, {"n_photons": 3e3}])
@pytest.mark.parametrize("size", [0.3, 1.0])
def test_good_frames_stay_without_a_word(conditions, size):
    """Ten stacks of each kind: faint ones, wide objects, passing haze."""
    for seed in range(10):
        assert usable(observe(seed=seed, size=size, **conditions)) == (list(range(12)), [])


def test_a_star_that_was_moved_far_is_not_taken_for_a_closed_shutter():
    rng = np.random.default_rng(2)
    frames = 3.0 * rng.standard_normal((8, 32, 32))
    frames[:, 8, 8] += 1e4
    frames[5] = np.roll(frames[5], (15, 15), (0, 1))
    assert not find_unlit(frames, everywhere(frames)).any()


def test_negative_frames_and_those_without_a_valid_pixel_are_left_out():
    frames = observe()
    frames[3] -= 2 * frames[3].mean()
    valid = everywhere(frames)
    valid[5] = False
    with (
        pytest.warns(UserWarning, match=r"\[5\] have no valid pixel"),
        pytest.warns(UserWarning, match=r"\[3\] hold no"),
    ):
        assert usable_frames(frames, valid).tolist() == [0, 1, 2, 4, 6, 7, 8, 9, 10, 11]
    frames = np.abs(frames)
    with pytest.raises(ValueError, match=r"frames \[0, .* 11\] hold no light: .* not positive, and no other is left"):
        usable_frames(-frames, everywhere(frames))


@pytest.mark.parametrize("share", [0.1, 0.4])
def test_a_cloud_is_told_and_its_frame_stays(share):
    frames = observe(sky=20.0)
    frames[4] = 20 + share * (frames[4] - 20)
    kept, said = usable(frames)
    assert kept == list(range(12))
    assert said == [
        "frames [4] have less than half the light of the others, as through a cloud: they stay unless you skip them"
    ]


def test_light_leaves_out_what_is_constant_and_its_noise_is_that_of_the_border():
    """A blob of 1000 on noise of 2 and a level: 400 draws scatter as much as is said."""
    rng = np.random.default_rng(3)
    frames = 7 + 2 * rng.standard_normal((400, 24, 24))
    frames[:, 10:14, 10:14] += 1000 / 16
    light, noise = frame_light(frames, everywhere(frames))
    assert light.mean() == pytest.approx(1000, abs=4 * noise.mean() / 20)
    # the scatter of 400 numbers is known to 1 / sqrt(800); a border of 92 pixels tells its spread to 10 % each
    assert light.std() == pytest.approx(noise.mean(), rel=0.15)
    assert not find_clouds(frames, everywhere(frames)).any()


def test_skip_counts_from_0_and_names_what_is_not_there():
    frames = observe()
    assert usable(frames, (0, 11, 11))[0] == list(range(1, 11))
    for skip, message in (
        ((12,), "skip names frame 12, but the stack has 12 frames, with numbers from 0 to 11"),
        ((-1,), "skip names frame -1"),
    ):
        with pytest.raises(ValueError, match=message):
            usable_frames(frames, everywhere(frames), skip)
    numbers = range(20, 44, 2)
    assert usable_frames(frames, everywhere(frames), (20, 42), numbers).tolist() == list(range(1, 11))
    with pytest.raises(ValueError, match=r"skip names frame 21, .* numbers from 20 to 42"):
        usable_frames(frames, everywhere(frames), (21,), numbers)
    frames[3] = -frames[3]
    with pytest.warns(UserWarning, match=r"frames \[26\] hold no light"):
        usable_frames(frames, everywhere(frames), (), numbers)
    frames[3] = -frames[3]
    with pytest.raises(ValueError, match="skip leaves none of the 12 frames"):
        usable_frames(frames, everywhere(frames), range(12))
