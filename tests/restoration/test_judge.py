"""Endings are judged with the mask where each has found it."""

import pytest
import torch

from torchmask.restoration.checkpoint import Ending, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.judge import Judge
from torchmask.restoration.motion import Setting
from torchmask.restoration.placed import moved_centers
from torchmask.restoration.placement import moved
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.traits import Refinement, Traits

TURN = torch.tensor([0.02, 0.0], dtype=torch.float64)
TRAITS = Traits(
    many_minima=False,
    estimated=False,
    prior_on_aberrations=True,
    r0_is_open=False,
    r0=0.25,
    outer_scale=20.0,
    max_iterations=1000,
    tolerance=0.0,
    seed=0,
    refinement=Refinement.ON,
)


def test_each_ending_is_judged_where_it_has_found_the_mask(explain):
    """An ending that knows of the turn is explained as if nothing had been turned; one that does not is worse."""
    objective, state = explain(noise=0.003)
    stack = FrameStack(objective.frames, torch.ones_like(objective.frames, dtype=torch.bool), 1.0, 0.003**2)
    told = objective.model.pupil.aperture
    expected = Judge(Setting.of(objective), stack, TRAITS, Schedule()).verdict(
        objective, Ending(state, Status.CONVERGED)
    )
    turned_back = told.replace(moved_centers(told.centers, -TURN))
    objective = objective.with_changes(model=objective.model.through(turned_back))
    judge = Judge(Setting.of(objective), stack, TRAITS, Schedule(model_errors=0.0))  # any excess counts
    there = Ending(moved(state, TURN), Status.CONVERGED)
    here = Ending(state, Status.CONVERGED)
    assert judge.verdict(objective, there).chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert judge.verdict(objective, here).chi_square > 1.5 * expected.chi_square
    for now, rival in ((here, there), (there, here)):
        found = judge.compare(objective, now, rival)
        assert found.best is there
        assert not found.alike
        assert found.verdict == judge.verdict(objective, there)
    assert judge.compare(objective, here, here).alike
