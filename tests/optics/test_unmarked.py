"""Saturated and dead pixels and spikes that nobody has marked: filled in, without weight, and told."""

from dataclasses import replace

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.fringes import frame_observables
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.optics.unmarked import leave_out_unmarked
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import make_scene

GRID = Grid.nyquist(1.0, 550e-9, 48)
MASK = SparseAperture.from_catalog("golay9", 1.0, fill_factor=0.15)


@pytest.fixture(scope="module")
def frames():
    """Six frames of 1e6 electrons."""
    generator = torch.Generator().manual_seed(0)
    scene, turbulence = make_scene(GRID.shape, 1e6), TurbulencePhase(0.2, 20.0)
    return simulate_observation(scene, MASK, GRID, turbulence, Detector(1.5), 6, generator=generator).frames.double()


def leave_out(frames):
    return leave_out_unmarked(frames, torch.ones_like(frames, dtype=torch.bool), GRID, MASK, stacklevel=1)


def test_frames_without_any_stay_as_they_are(frames):
    same, valid = leave_out(frames)
    assert same is frames
    assert bool(valid.all())


def test_spikes_are_filled_in_and_told(frames):
    hit = frames.clone()
    hit[3, 30, 12] += 1e5
    said = r"9 pixels of frames \[3\] of this stack, counted from 0, hold what no optics can make.*\(3, 30, 12\)"
    with pytest.warns(UserWarning, match=said) as told:
        filled, valid = leave_out(hit)
    assert told[0].filename == __file__
    around = {(3, y, x) for y in range(29, 32) for x in range(11, 14)}
    assert {tuple(place) for place in (~valid).nonzero().tolist()} == around
    torch.testing.assert_close(filled[valid], frames[valid], rtol=0, atol=0)
    assert float(filled[3, 30, 12]) <= float(frames[3].max())


def test_saturated_pixels_are_filled_in_and_told(frames):
    level = float(frames.quantile(0.99, interpolation="lower"))
    with pytest.warns(UserWarning, match="seems to cut off there") as told:
        filled, valid = leave_out(frames.clamp(max=level))
    assert torch.equal(valid, frames < level)
    n, n_frames = int((~valid).sum()), int((~valid).any(2).any(1).sum())
    start = f"{n} pixels (0.01 of all) in {n_frames} of 6 frames hold {level:.10g}, the largest value of all"
    assert str(told[0].message).startswith(start)
    assert len(told) == 1
    assert told[0].filename == __file__
    torch.testing.assert_close(filled[valid], frames[valid], rtol=0, atol=0)


def test_pixels_that_were_cut_off_before_a_flat_are_filled_in_and_told(frames):
    level = float(frames.quantile(0.97, interpolation="lower"))
    flat = 1 + 0.01 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    calibrated = frames.clamp(max=level) / flat
    with pytest.warns(UserWarning, match="cut them off before they were calibrated. They get no weight") as told:
        filled, valid = leave_out(calibrated)
    assert not bool((valid & (frames >= level)).any())
    assert int((~valid).sum()) < 1.5 * int((frames >= level).sum())
    n, lowest = int((~valid).sum()), float(calibrated[~valid].min())
    start = f"{n} pixels ({n / valid.numel():.2g} of all) in 6 of 6 frames hold {lowest:.4g} or more"
    assert str(told[0].message).startswith(start)
    assert len(told) == 1
    torch.testing.assert_close(filled[valid], calibrated[valid], rtol=0, atol=0)


@pytest.mark.filterwarnings("ignore:the fringes of the frames are not those of the mask")  # as its core is filled in
def test_the_core_of_a_steady_star_that_was_cut_off_before_a_flat_is_filled_in_and_told():
    """|V|^2 of the star, which nothing resolves, is 1; with 6 pixels taken for light it was 0.2 to 0.8."""
    star = torch.zeros(GRID.shape, dtype=torch.float64)
    star[24, 24] = 1e6
    seen = simulate_observation(star, MASK, GRID, None, Detector(1.5), 6, generator=torch.Generator().manual_seed(0))
    flat = 1 + 0.02 * torch.randn(GRID.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    level = float(seen.frames.mean(0).flatten().sort(descending=True).values[6])
    calibrated = replace(seen, frames=seen.frames.clamp(max=level) / flat)
    said = (
        r"in 6 of 6 frames hold .* or more, and the brightest of them hold one value each in all frames, so the camera"
    )
    with pytest.warns(UserWarning, match=said):
        observables = frame_observables(calibrated)
    assert float((observables.vis2 - 1).abs().max()) < 0.05


def test_what_is_marked_already_counts_neither_as_dead_nor_as_saturated(frames):
    """A border that is marked, of zeros or above all, is no news; shares are of the pixels that were valid."""
    marked = torch.ones_like(frames, dtype=torch.bool)
    marked[:, :24] = False
    for value in (0.0, 1e9):
        spoilt = torch.where(marked, frames, value)
        same, valid = leave_out_unmarked(spoilt, marked, GRID, MASK, stacklevel=1)
        assert same is spoilt
        assert torch.equal(valid, marked)
    spoilt = torch.where(marked, frames, 0.0)
    spoilt[:, 24:, 40] = 5.0
    with pytest.warns(UserWarning, match=r"^24 pixels \(0.021 of all\) hold one value"):
        leave_out_unmarked(spoilt, marked, GRID, MASK, stacklevel=1)
    level = float(frames[marked].quantile(0.9, interpolation="lower"))
    cut_off = torch.where(marked, frames.clamp(max=level), 0.0)
    with pytest.warns(UserWarning, match=r"^\d+ pixels \(0.1 of all\) in 6 of 6 frames"):
        leave_out_unmarked(cut_off, marked, GRID, MASK, stacklevel=1)


def test_dead_pixels_are_filled_in_and_told(frames):
    spoilt = frames.clone()
    spoilt[:, :, 20] = 0.0
    said = r"^48 pixels \(0.021 of all\) hold one value in all 6 frames of this stack, as dead ones"
    with pytest.warns(UserWarning, match=said) as told:
        filled, valid = leave_out(spoilt)
    assert len(told) == 1
    assert told[0].filename == __file__
    assert not bool(valid[:, :, 20].any())
    assert int(valid.sum()) == 6 * 48 * 47
    torch.testing.assert_close(filled[valid], frames[valid], rtol=0, atol=0)


def test_spikes_are_found_beside_saturated_pixels(frames):
    """A hit in a dark corner that does not reach the value at which the camera cuts off."""
    level = float(frames.quantile(0.99, interpolation="lower"))
    hit = frames.clamp(max=level)
    hit[4, 12, 40] = level - 1
    with pytest.warns(UserWarning, match="They get no weight") as told:
        _, valid = leave_out(hit)
    assert ["seems to cut off" in str(one.message) for one in told] == [True, False]
    assert not bool(valid[4, 12, 40])


def test_a_frame_without_any_other_pixel_is_refused(frames):
    spoilt = frames.clone()
    spoilt[2] = float(frames.max()) + 1
    with (
        pytest.warns(UserWarning, match="seems to cut off"),
        pytest.raises(ValueError, match=r"frames \[2\] of this stack.* have no other valid pixel: leave them out"),
    ):
        leave_out(spoilt)
