"""The numbers of a restoration: what a tournament may look like, and what is refused."""

import pytest

from torchmask.restoration.schedule import Schedule


def test_every_number_of_candidates_has_its_iterations():
    schedule = Schedule()
    n_candidates = schedule.n_candidates
    stages = 0
    while n_candidates > 1:
        assert schedule.stage_iterations(n_candidates) > 0
        n_candidates //= 2
        stages += 1
    assert stages == len(schedule.candidates)


def test_without_candidates_there_is_one():
    assert Schedule(candidates=()).n_candidates == 1
    assert Schedule(candidates=((2, 7),)).stage_iterations(2) == 7


@pytest.mark.parametrize(
    "candidates",
    [
        ((8, 1), (2, 1)),  # leaves one out
        ((2, 1), (4, 1)),
        ((6, 1), (3, 1)),  # ends with three
        ((1, 10),),
        ((4, 1), (2, 1), (1, 1)),
    ],
)
def test_refuses_candidates_that_do_not_halve(candidates):
    with pytest.raises(ValueError, match="each stage must have half as many as the one before it"):
        Schedule(candidates=candidates)


@pytest.mark.parametrize("name", ["segment", "start_iterations", "starts", "averaged"])
def test_refuses_counts_below_one(name):
    with pytest.raises(ValueError, match=f"{name} is 0: it must be at least 1"):
        Schedule(**{name: 0})
