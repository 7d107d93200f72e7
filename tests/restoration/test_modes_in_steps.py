"""A blind search of a mask has at most six modes for each hole; those that are asked for beyond enter after it."""

import math

import pytest
import torch

from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.schedule import Schedule

BRIEF = {"start_iterations": 20, "segment": 10, "sharp_after": 10, "escapes": 0, "starts": 1, "faint_starts": 1}
BRIEF |= {"last_segments": 1, "last_settling": 5, "comparing": 3, "rounds": 2, "moves": 2, "noisy": 0.0}
BRIGHT, FAINT = {"faint": 0.0}, {"faint": math.inf}


@pytest.fixture
def restored(observe, five_holes):
    """Restore with modes that are asked for, and return the result with the modes of every stage."""
    seen = observe(n_frames=2, shape=(32, 32))

    def restore(n_modes, max_iterations=100, **options):
        stages = {}

        def listen(record):
            if "coefficients" in record.arrays:
                stages.setdefault(record.stage, set()).add(record.arrays["coefficients"].shape[-1])
            else:
                stages.setdefault(record.stage, set())

        schedule = options.pop("schedule", None) or Schedule(**BRIEF | options)
        method = MyopicDeconvolution(
            five_holes, seen.grid, n_modes, readout_noise=1.5, max_iterations=max_iterations, schedule=schedule
        )
        return method.restore(seen.frames, callback=listen), stages

    return restore


@pytest.mark.parametrize("light", [BRIGHT, FAINT], ids=["bright", "faint"])
def test_the_search_has_six_and_the_result_all(restored, light):
    result, stages = restored(8, **light)
    assert stages["restoration"] == {6}
    assert result.coefficients.shape == (2, 5, 8)
    assert (result.coefficients[..., 6:] != 0).all()


def test_further_modes_change_no_object_of_faint_frames(restored):
    """They are fitted to it in the end, and spread a little more of its light beyond the field."""
    few, many = (restored(n_modes, **FAINT) for n_modes in (6, 8))
    fields = [result.extended_object * (1 - result.light_beyond) for result, _ in (few, many)]
    torch.testing.assert_close(*fields, rtol=1e-13, atol=0)
    assert "further modes" in many[1]
    assert "further modes" not in few[1]
    assert few[0].n_evaluations < many[0].n_evaluations


@pytest.mark.parametrize("light", [BRIGHT, FAINT], ids=["bright", "faint"])
def test_a_search_that_is_cut_short_has_none_of_them(restored, light):
    result, _ = restored(8, max_iterations=1, **light)
    assert result.coefficients.shape == (2, 5, 8)
    assert float(result.coefficients[..., 6:].abs().max()) < 1e-9


def test_fewer_modes_are_searched_as_they_are(restored):
    assert restored(3, **BRIGHT)[1]["restoration"] == {3}


@pytest.mark.parametrize("schedule", [Schedule.plain(), Schedule(**BRIEF | BRIGHT | {"last_segments": 0})])
def test_without_a_last_descent_the_search_has_all(restored, schedule):
    """Nothing follows that could have more."""
    assert restored(8, max_iterations=2, schedule=schedule)[1]["restoration"] == {8}
