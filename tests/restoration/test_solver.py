"""The course of a restoration: why it ends, when it starts again, and what it reports."""

from pathlib import Path

import pytest
import torch

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.observation import Observation
from torchmask.optics.detector import Detector
from torchmask.record import Record
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.schedule import Schedule
from torchmask.simulation.exposures import simulate_observation
from torchmask.simulation.scene import SceneOptions, make_scene

STACKS = Path(__file__).parents[3] / "shared" / "stacks"
ALL_MISSED = {"missed": -1.0, "chance": -1e9}  # no fit is good enough
PLAIN = {"sharp_after": 50, "escapes": 0}  # ends when a segment brings nothing more


def test_a_descent_at_rest_comes_to_an_end(observation):
    """With tolerance 0 too, when no step lowers the cost any more."""
    method = MyopicDeconvolution(
        observation.aperture,
        observation.grid,
        1,
        readout_noise=observation.readout_noise,
        aberration_prior=False,
        max_iterations=2000,
        tolerance=0,
        schedule=Schedule(start_iterations=2000),
    )
    result = method.restore(observation.frames[:1], known_object=observation.object)
    assert result.converged
    assert len(result.cost) < 2000


@pytest.mark.slow
def test_a_missed_object_gets_a_second_start(observation, restoring, tmp_path):
    """Here nothing is missed, so the thresholds are lowered: the better of both is kept, resumed or not."""
    once = restoring(schedule=Schedule(start_iterations=400)).restore(observation.frames)
    assert len(once.cost) <= 400
    method = restoring(schedule=Schedule(start_iterations=400, alike=-1.0, starts=2, **ALL_MISSED))
    twice = method.restore(observation.frames)
    assert len(once.cost) < len(twice.cost) <= 800
    assert torch.equal(twice.cost[: len(once.cost)], once.cost)
    assert "the best of 2 starts" in twice.message
    assert float(twice.chi_square.mean()) <= float(once.chi_square.mean()) + 1e-12

    def interrupt(record: Record) -> None:
        if record.step == len(once.cost) + 150:
            raise KeyboardInterrupt

    path = tmp_path / "state.npz"
    with pytest.raises(KeyboardInterrupt):
        method.restore(observation.frames, checkpoint=path, callback=interrupt)
    resumed = method.restore(observation.frames, checkpoint=path)
    assert torch.equal(resumed.object, twice.object)
    assert torch.equal(resumed.cost, twice.cost)
    assert resumed.message == twice.message


@pytest.mark.slow
def test_starts_that_end_alike_are_the_last(observation, restoring):
    """A second start of the same aberrations ends where the first did: nothing else is there to be found."""
    method = restoring(3, tolerance=0.05, schedule=Schedule(start_rms=0.0, **ALL_MISSED, **PLAIN))
    message = method.restore(observation.frames[:4]).message
    assert message.endswith("; the best of 2 starts, two of which ended alike")


@pytest.mark.slow
def test_noise_alone_is_no_reason_for_another_start(observe, restoring):
    """In faint frames it is more than the share of the change from frame to frame that a good fit may leave."""
    faint = observe(n_frames=4, n_photons=1e3, seed=2)
    method = restoring(3, tolerance=0.01, schedule=Schedule(**PLAIN))
    assert "starts" not in method.restore(faint.frames).message
    method = restoring(3, tolerance=0.01, schedule=Schedule(chance=0.0, **PLAIN))
    assert "starts" in method.restore(faint.frames).message


@pytest.mark.slow
def test_further_starts_that_are_worse_change_nothing(observation, restoring):
    satisfied = Schedule(missed=float("inf"), **PLAIN)
    once = restoring(3, tolerance=0.05, schedule=satisfied).restore(observation.frames[:4])
    nothing_there = Schedule(start_rms=30.0, starts=3, **ALL_MISSED, **PLAIN)
    twice = restoring(3, tolerance=0.05, schedule=nothing_there).restore(observation.frames[:4])
    assert once.converged
    assert twice.message == once.message + "; the best of 3 starts"
    assert torch.equal(twice.object, once.object)


@pytest.mark.slow
@pytest.mark.skipif(not STACKS.is_dir(), reason="the mask of the reference stacks lies beside the checkout")
def test_further_starts_find_what_the_first_has_missed():
    stack = Observation.load(STACKS / "skylab_1e7_mask.npz")
    diameter = stack.aperture.mask_diameter
    grid = Grid.nyquist(diameter, stack.grid.wavelength, 64)
    turbulence = TurbulencePhase(diameter / 10, 20 * diameter)
    generator = torch.Generator().manual_seed(2)
    scene = make_scene(grid.shape, 1e7, SceneOptions(size=0.5))
    seen = simulate_observation(scene, stack.aperture, grid, turbulence, Detector(1.5), 10, generator)
    result = MyopicDeconvolution(stack.aperture, grid).restore(seen.frames)
    assert relative_error(result.object, seen.object, 0.5) < 0.1
    assert "starts" in result.message


def test_records_hold_the_state(observation, restoring):
    records: list[Record] = []
    result = restoring(max_iterations=20, tolerance=0).restore(observation.frames, callback=records.append)
    assert [record.step for record in records] == list(range(1, 21))
    assert all(record.n_steps == 20 and record.stage == "restoration" for record in records)
    assert torch.allclose(records[-1].arrays["object"], result.object)
    assert torch.allclose(records[-1].arrays["coefficients"], result.coefficients)
    costs = [record.scalars["cost"] for record in records]
    assert costs == result.cost.tolist()
    assert costs[-1] < costs[0]
    assert "max_iterations = 20" in result.message
    assert not result.converged
