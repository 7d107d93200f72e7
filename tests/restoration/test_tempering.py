"""A start from the best object heated: in how much noise it wanders, and what it leaves as it is."""

from dataclasses import replace

import pytest
import torch

from torchmask.restoration import tempering
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.tempering import temper

BRIEF = Schedule(cooling=3, heat=4.0, moves=2, settling=5)


@pytest.mark.parametrize(("cooling", "heats"), [(3, [4.0, 2.0, 1.0]), (2, [4.0, 1.0]), (1, [4.0])])
def test_the_noise_falls_by_equal_factors_to_what_it_is(cooling, heats, explained, monkeypatch):
    objective, state = explained
    given = []

    def sample_rounds(objective, state, heats, *rest, **more):
        given.extend(heats)
        yield replace(state, z=state.z + 1).with_noise_inflation(7.0), 0.5

    monkeypatch.setattr(tempering, "sample_rounds", sample_rounds)
    records = []
    found, evaluations = temper(objective, state, replace(BRIEF, cooling=cooling), 0, records.append)
    assert [(record.stage, record.step, record.n_steps) for record in records] == [("heated start", 1, cooling)]
    assert given == pytest.approx(heats)
    assert evaluations == cooling * (2 + 2)
    assert torch.equal(found.z, state.z + 1)
    assert found.calibration is state.calibration


def test_one_seed_moves_the_aberrations_one_way_and_the_object_follows(explained):
    objective, state = explained
    first, again, other = (temper(objective, state, BRIEF, seed)[0] for seed in (0, 0, 1))
    assert torch.equal(first.z, again.z)
    assert torch.equal(first.image, again.image)
    assert not torch.equal(first.z, other.z)
    assert not torch.equal(first.image, state.image)
    assert float(first.image.min()) >= 0


def test_more_heat_moves_them_farther(explained):
    """In a single move of a fixed part of their standard deviations, which grow by less than the root of the heat.

    The prior holds them beside the frames, which are so noisy here that it counts.
    """
    objective, state = explained
    state = state.with_noise_inflation(1e4)
    once = replace(BRIEF, cooling=1, moves=1)

    def distance(heat):
        return float((temper(objective, state, replace(once, heat=heat), 0)[0].z - state.z).norm())

    near, far = distance(1.0), distance(4.0)
    assert near < far < 2 * near
