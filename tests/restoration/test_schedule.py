"""The numbers of a restoration: what a tournament may look like, and what is refused."""

import math

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


@pytest.mark.parametrize(
    ("name", "wrong", "range_"),
    [
        ("segment", 0, "a whole number of at least 1"),
        ("segment", 2.5, "a whole number of at least 1"),
        ("starts", 0, "a whole number of at least 1"),
        ("in_vain", -1, "a whole number of at least 0"),
        ("averaged", 0, "a whole number of at least 1"),
        ("rounds", 0, "a whole number of at least 1"),
        ("renewal", 0, "a whole number of at least 1"),
        ("moves", -1, "a whole number of at least 0"),
        ("restarts", -1, "a whole number of at least 0"),
        ("twins", -1, "a whole number of at least 0"),
        ("reflections", math.inf, "a whole number of at least 0"),
        ("farthest", 1.5, "a number from 0 to 1"),
        ("farthest", math.nan, "a number from 0 to 1"),
        ("outlying", -1.0, "a number from 0 to inf"),
        ("chance", math.nan, "a number from -inf to inf"),
        ("start_rms", math.inf, r"a number from 0 to 1\.8e\+308"),
        ("first_inflation", 0.0, "a number from 2.23e-308 to inf"),
    ],
)
def test_refuses_numbers_out_of_range(name, wrong, range_):
    with pytest.raises(ValueError, match=f"{name} is {wrong}: it must be {range_}"):
        Schedule(**{name: wrong})


def test_takes_whole_numbers_that_arithmetic_made():
    assert Schedule(segment=50.0).segment == 50
    assert isinstance(Schedule(segment=50.0).segment, int)


def test_refuses_stages_and_steps_that_cannot_be():
    with pytest.raises(ValueError, match=r"candidates is \(\(2, 0\),\): each stage needs at least 1 iteration"):
        Schedule(candidates=((2, 0),))
    for step in (0.0, math.nan):
        with pytest.raises(ValueError, match=r"pixel_steps is .*: they must be finite and positive, in pixels"):
            Schedule(pixel_steps=(0.4, step))


def test_what_switches_a_step_off_is_allowed():
    off = {"faint": math.inf, "chance": math.inf, "alike": -1.0, "nearly_at_rest": -math.inf, "twins": 0, "restarts": 0}
    assert Schedule(**off, last_segments=0, retrievals=0, first_inflation=math.inf).twins == 0
    assert Schedule.plain().averaged == 1
