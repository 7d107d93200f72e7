"""Cosmic rays, hot and dead pixels, told from light and noise by what they hold beyond the cut-off."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.spikes import find_spikes
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid.nyquist(1.0, 550e-9, 48)
MASK = SparseAperture.from_catalog("golay9", 1.0, fill_factor=0.15)
READOUT = 1.5


def exposures(n_photons, n_frames=6, seed=0, scene=None, grid=GRID):
    scene = make_scene(grid.shape, n_photons) if scene is None else scene
    turbulence, detector = TurbulencePhase(0.2, 20.0), Detector(READOUT)
    generator = torch.Generator().manual_seed(seed)
    seen = simulate_observation(scene, MASK, grid, turbulence, detector, n_frames, generator=generator)
    return seen.frames.double()


def everywhere(frames):
    return torch.ones_like(frames, dtype=torch.bool)


def around(frame, row, column):
    return {(frame, y, x) for y in range(row - 1, row + 2) for x in range(column - 1, column + 2)}


def places(found):
    return {tuple(place) for place in found.nonzero().tolist()}


def test_frames_without_spikes_have_none():
    """A scene, a star, even light and a sharp edge, of few and many photons, in pixels that are fine or not, of one
    frame or several: 54 stacks, in each of which there is one by chance in a thousand at most."""
    star, even, edge = (torch.zeros(GRID.shape) for _ in range(3))
    star[24, 20], even[:], edge[:, 30:] = 1.0, 1.0, 1.0
    for n_photons in (3e2, 1e5, 1e8):
        for n_frames in (1, 2, 8):
            for scene in (star, even, edge):
                scene = scene * (n_photons / float(scene.sum()))
                frames = exposures(n_photons, n_frames, n_frames, scene)
                assert not bool(find_spikes(frames, everywhere(frames), GRID, MASK).any())
            for fineness in (1.0, 0.7, 0.5):
                grid = Grid(48, fineness * GRID.pixel_scale, 550e-9)
                frames = exposures(n_photons, n_frames, n_frames, make_scene(grid.shape, n_photons), grid)
                assert not bool(find_spikes(frames, everywhere(frames), grid, MASK).any())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n_frames", [1, 2, 6])
@pytest.mark.parametrize("height", [1.0, 10.0, 1e4])
def test_a_hit_is_found_wherever_it_is_and_nothing_else(height, n_frames, dtype):
    """From the brightest pixel of the stack on: noise reaches a tenth of it beyond the cut-off."""
    frames = exposures(1e6, n_frames).to(dtype)
    for row, column in ((12, 30), (24, 24), (40, 8)):  # beside the object, in it, near the border
        hit = frames.clone()
        hit[-1, row, column] += height * frames.max()
        assert places(find_spikes(hit, everywhere(hit), GRID, MASK)) == around(n_frames - 1, row, column)


def test_what_noise_does_not_reach_is_found():
    """A step of A in one pixel is A times the share of frequencies beyond the cut-off, and noise its root.

    Of even light L a spike stands out from about sqrt(2 log(2 n / 0.001) L / share) on, if photons are many: half of it
    is never found there, twice as much always.
    """
    level, share = 100.0, float((torch.hypot(*GRID.frequencies(torch.float64)) > 0.5).double().mean())
    generator = torch.Generator().manual_seed(1)
    frames = torch.poisson(torch.full((8, *GRID.shape), level, dtype=torch.float64), generator=generator)
    least = math.sqrt(2 * math.log(2 * frames.numel() / 0.001) * level / share)
    assert 0.02 * level < 0.25 * math.sqrt(level)  # an uneven flat counts for little
    for factor, found in ((0.5, False), (2.0, True)):
        for sign in (1, -1):
            hit = frames.clone()
            hit[3, 20, 20] += sign * factor * least
            assert bool(find_spikes(hit, everywhere(hit), GRID, MASK)[3, 20, 20]) is found


def test_few_photons_do_not_make_a_spike():
    """One photon in a hundred pixels: two in one of 92160 are common, and seven standard deviations of a normal."""
    generator = torch.Generator().manual_seed(3)
    frames = torch.poisson(torch.full((40, *GRID.shape), 0.01, dtype=torch.float64), generator=generator)
    assert frames.max() >= 2
    assert 2 > 7 * 0.1  # standard deviations
    assert not bool(find_spikes(frames, everywhere(frames), GRID, MASK).any())
    frames[5, 20, 20] += 100
    assert bool(find_spikes(frames, everywhere(frames), GRID, MASK)[5, 20, 20])


def test_hot_and_dead_pixels_are_found_in_every_frame():
    frames = exposures(1e6)
    hot = frames.clone()
    hot[:, 20, 33] += 3 * frames.max()
    found = find_spikes(hot, everywhere(hot), GRID, MASK)
    assert places(found) == set().union(*(around(number, 20, 33) for number in range(len(frames))))
    bright = 1e4 + torch.poisson(torch.full_like(frames, 1e4), generator=torch.Generator().manual_seed(0))
    bright[:, 20, 33] = 0.0
    dead = find_spikes(bright, everywhere(bright), GRID, MASK)
    assert bool(dead[:, 20, 33].all())
    assert int(dead.sum()) == int(dead[:, 18:23, 31:36].sum())  # what touches it has side lobes above zero


@pytest.mark.parametrize("shape", ["pair", "column", "corner", "line", "block"])
def test_hits_of_several_pixels_are_left_out_whole(shape):
    offsets = {
        "pair": [(0, 0), (0, 1)],
        "column": [(0, 0), (1, 0)],
        "corner": [(0, 0), (0, 1), (1, 0)],
        "line": [(0, 0), (1, 0), (2, 0)],
        "block": [(0, 0), (0, 1), (1, 0), (1, 1)],
    }[shape]
    frames = exposures(1e6)
    hit = frames.clone()
    for y, x in offsets:
        hit[2, 20 + y, 30 + x] += 5 * frames.max()
    found = find_spikes(hit, everywhere(hit), GRID, MASK)
    assert {(2, 20 + y, 30 + x) for y, x in offsets} <= places(found)
    assert int(found.sum()) <= 40  # of 13824, all of this frame
    assert not bool(found[[0, 1, 3, 4, 5]].any())


@given(
    hits=st.lists(
        st.tuples(st.integers(0, 5), st.integers(6, 41), st.integers(6, 41), st.floats(1, 50)), min_size=1, max_size=5
    )
)
@settings(deadline=None, max_examples=10)
def test_several_hits_are_all_found(hits):
    frames = exposures(1e6)
    hit, top = frames.clone(), float(frames.max())
    for frame, row, column, height in hits:
        hit[frame, row, column] += height * top
    found = find_spikes(hit, everywhere(hit), GRID, MASK)
    assert {(frame, row, column) for frame, row, column, _ in hits} <= places(found)


def test_marked_pixels_may_hold_anything_finite_and_are_not_found_again():
    frames = exposures(1e6)
    valid = everywhere(frames)
    frames[1, 15, 20] = 1e9
    valid[1, 15, 20] = False
    assert not bool(find_spikes(frames, valid, GRID, MASK).any())
    frames[4, 15, 20] += 1e5
    assert places(find_spikes(frames, valid, GRID, MASK)) == around(4, 15, 20)


@pytest.mark.parametrize(("share", "found"), [(0.02, False), (0.0005, True)])
def test_an_image_that_no_optics_have_blurred_is_not_taken_apart(share, found):
    """A fiftieth of its pixels are a thousand times as bright as the others: more
    than cosmic rays hit. One of two thousand is a few spikes."""
    generator = torch.Generator().manual_seed(4)
    frames = torch.where(torch.rand(4, *GRID.shape, generator=generator) < share, 1e4, 10.0).double()
    frames = torch.poisson(frames, generator=generator)
    assert bool(find_spikes(frames, everywhere(frames), GRID, MASK).any()) is found


def test_near_the_border_none_is_found():
    """In a twelfth of the side, 4 pixels of 48: there the light that the border cuts off stands out too."""
    frames = exposures(1e6)
    for row, found in ((0, False), (3, False), (4, True), (43, True), (44, False)):
        hit = frames.clone()
        hit[2, row, 20] += 5 * frames.max()
        assert bool(find_spikes(hit, everywhere(hit), GRID, MASK).any()) is found


def test_a_bright_star_that_the_border_cuts_off_is_no_spike():
    """In pixels of half the size there is room to look as far beyond the cut-off as a fading border spreads light."""
    grid, star = Grid(48, 0.5 * GRID.pixel_scale, 550e-9), torch.zeros(48, 48)
    star[2, 28] = 1e8
    for seed in range(4):
        frames = exposures(1e8, 3, seed, star, grid)
        assert not bool(find_spikes(frames, everywhere(frames), grid, MASK).any())


def test_photons_of_a_bright_core_are_no_spikes():
    """In the core of a blob there is more noise than around it, and a single frame does not show how much.

    Of 200 frames one in five thousand has a spike by chance.
    """
    x = torch.arange(48, dtype=torch.float64) - 24
    blob = 400 * torch.exp(-(x[:, None] ** 2 + x**2) / (2 * 1.6**2))
    generator = torch.Generator().manual_seed(0)
    for _ in range(200):
        frame = torch.poisson(blob[None], generator=generator) + 0.5 * torch.randn(1, 48, 48, generator=generator)
        assert not bool(find_spikes(frame, everywhere(frame), GRID, MASK).any())


def test_readout_noise_makes_no_spikes():
    """Of dark frames all noise is of the detector, and the largest of 55296 deviates is above four."""
    generator = torch.Generator().manual_seed(0)
    frames = 5 + 30 * torch.randn(24, *GRID.shape, dtype=torch.float64, generator=generator)
    assert frames.max() > 4 * 30
    assert not bool(find_spikes(frames, everywhere(frames), GRID, MASK).any())


def test_without_frequencies_beyond_the_cutoff_none_is_found():
    coarse = Grid.nyquist(1.0, 550e-9, (4, 4))
    frames = torch.rand(3, 4, 4, dtype=torch.float64)
    frames[1, 2, 2] = 1e3
    assert not bool(find_spikes(frames, everywhere(frames), coarse, FullAperture(1.0)).any())


def test_the_unit_of_frames_does_not_matter_as_long_as_it_is_no_larger_than_an_electron():
    """Frames that add up to 1 have far less noise than electrons of that light, and their hits are found as well."""
    frames = exposures(1e6)
    frames[3, 30, 12] += frames.max()
    expected = around(3, 30, 12)
    for factor in (1.0, 1e-3, 1e-9):
        scaled = factor * frames
        assert places(find_spikes(scaled, everywhere(frames), GRID, MASK)) == expected
