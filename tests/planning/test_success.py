"""The map of success: what was measured at its points, between its points, and a warning beyond them."""

import itertools
import math
import warnings

import numpy as np
import pytest

from torchmask.planning.smearing import smearing_map
from torchmask.planning.success import BlindOutlook, SuccessMap, success_map

FRAMES, PHOTONS, SIZES = (1, 4), (1e5, 1e6, 1e8), (0.5, 1.5)
TRIED = np.full((2, 3, 2), 8.0)
SUCCEEDED = np.array([[[2, 0], [6, 1], [8, 4]], [[4, 1], [8, 3], [8, 7]]], float)
COST = 1 + 2 * (1 - SUCCEEDED / 8) ** 2
MAP = SuccessMap(FRAMES, PHOTONS, SIZES, TRIED, SUCCEEDED, COST)


def test_its_points_are_what_was_measured():
    for (i, frames), (j, photons), (k, size) in itertools.product(*map(enumerate, (FRAMES, PHOTONS, SIZES))):
        outlook = MAP.outlook(size, photons, frames)
        assert outlook.success == pytest.approx(SUCCEEDED[i, j, k] / 8, abs=1e-12)
        assert outlook.cost == pytest.approx(COST[i, j, k], rel=1e-12)
        assert outlook.outside == ()


def test_between_two_points_it_is_even_in_the_logarithms_of_frames_and_photons():
    """A third of the way from the first to the second point along each axis in turn."""
    first = SUCCEEDED[0, 0, 0] / 8, math.log(COST[0, 0, 0])
    for other, point in (
        ((1, 0, 0), (0.5, 1e5, 4 ** (1 / 3))),
        ((0, 1, 0), (0.5, 1e5 * 10 ** (1 / 3), 1)),
        ((0, 0, 1), (0.5 + 1 / 3, 1e5, 1)),
    ):
        outlook = MAP.outlook(*point)
        last = SUCCEEDED[other] / 8, math.log(COST[other])
        assert outlook.success == pytest.approx((2 * first[0] + last[0]) / 3, abs=1e-12)
        assert math.log(outlook.cost) == pytest.approx((2 * first[1] + last[1]) / 3, abs=1e-12)


def test_the_level_is_that_of_its_points_and_even_in_logarithms():
    """Where none was measured, it is 1 everywhere."""
    level = np.linspace(0.2, 0.9, 12).reshape(2, 3, 2)
    measured = SuccessMap(FRAMES, PHOTONS, SIZES, TRIED, SUCCEEDED, COST, level=level)
    assert measured.outlook(1.5, 1e6, 1).restored == pytest.approx(level[0, 1, 1], rel=1e-12)
    between = math.sqrt(level[0, 1, 0] * level[0, 1, 1])
    assert measured.outlook(1.0, 1e6, 1).restored == pytest.approx(between, rel=1e-12)
    assert MAP.outlook(1.0, 1e6, 1).restored == 1


def test_it_rises_and_falls_as_the_measurements_do():
    """These rise with frames and photons and fall with the size of the holes, at every point of the lattice."""
    for name, values, sign in (
        ("n_frames", np.geomspace(1, 4, 7), 1),
        ("n_photons", np.geomspace(1e5, 1e8, 13), 1),
        ("d_over_r0", np.linspace(0.5, 1.5, 7), -1),
    ):
        middle = {"n_frames": 2, "n_photons": 3e5, "d_over_r0": 0.9}
        chances = [MAP.outlook(**(middle | {name: value})).success for value in values]
        assert (sign * np.diff(chances) > 0).all()


def test_the_interval_is_that_of_a_binomial():
    """Its ends are the chances that lie one standard error, by their own variance, from what was counted."""
    outlook = MAP.outlook(0.5, 1e6, 1)
    for end in (outlook.low, outlook.high):
        assert abs(end - 6 / 8) == pytest.approx(math.sqrt(end * (1 - end) / 8), rel=1e-12)
    assert MAP.outlook(1.5, 1e5, 1).low == 0
    assert MAP.outlook(0.5, 1e8, 4).high == 1


@pytest.mark.parametrize(
    ("name", "value", "edge", "said"),
    [
        ("n_frames", 100, 4, "numbers of frames from 1 to 4"),
        ("n_photons", 1e4, 1e5, r"photons per frame from 100000 to 1e\+08"),
        ("d_over_r0", 2.0, 1.5, "d/r0 from 0.5 to 1.5"),
    ],
)
def test_beyond_it_warns_and_takes_the_edge(name, value, edge, said):
    inside = {"n_frames": 2, "n_photons": 1e6, "d_over_r0": 1.0}
    with pytest.warns(UserWarning, match=said):
        outlook = MAP.outlook(**(inside | {name: value}))
    assert outlook.outside == (name,)
    assert outlook.harder == ((name,) if name == "d_over_r0" else ())  # more light and frames lose no more
    within = MAP.outlook(**(inside | {name: edge}))
    assert (outlook.success, outlook.cost) == (within.success, within.cost)


def test_the_part_of_an_error_that_can_be_avoided_grows_by_the_square():
    """A cost below 1 is no gain, and no error exceeds that of knowing nothing."""
    errors = [BlindOutlook(cost, 0.5, 0.4, 0.6).mse(0.3, 0.2) for cost in (0.9, 1.0, 1.5, 9.0)]
    assert errors == pytest.approx([0.3, 0.3, 0.1 + 2.25 * 0.2, 1.0], rel=1e-12)


@pytest.mark.parametrize("pupil", ["mask", "full"])
def test_the_maps_of_the_library_are_as_large_as_they_say(pupil):
    measured = success_map(pupil)
    assert ("a full pupil, " in measured.conditions) == (pupil == "full")
    assert measured.pupil == pupil
    through = {"mask": "masks", "full": "a full pupil"}[pupil]
    with pytest.warns(UserWarning, match=f"restorations through {through} were tried for photons per frame from"):
        measured.outlook(measured.d_over_r0[0], 1.0, measured.n_frames[-1])
    told = smearing_map(pupil)
    with pytest.warns(UserWarning, match=f"restorations through {through} were tried for exposures"):
        told.outlook(BlindOutlook(1.0, 1.0, 1.0, 1.0), n_photons=1e6, exposure=1e3, spread=0.5)
    assert measured.conditions.startswith(f"{int(measured.tried.sum())} restorations of 64 x 64 pixels")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        measured.outlook(measured.d_over_r0[0], measured.n_photons[-1], measured.n_frames[-1])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"n_frames": (4, 1)}, "rising order"),
        ({"tried": np.ones((2, 3))}, "tried has shape"),
        ({"succeeded": TRIED + 1}, "no more successes"),
        ({"tried": 0 * TRIED, "succeeded": 0 * TRIED}, "at least one restoration"),
        ({"level": np.ones((2, 3))}, "level has shape"),
        ({"level": np.zeros((2, 3, 2))}, "positive cost and level"),
    ],
)
def test_a_map_that_cannot_be_is_refused(changes, said):
    known = {"n_frames": FRAMES, "n_photons": PHOTONS, "d_over_r0": SIZES}
    with pytest.raises(ValueError, match=said):
        SuccessMap(**(known | {"tried": TRIED, "succeeded": SUCCEEDED, "cost": COST} | changes))


@pytest.mark.parametrize("known", [success_map, smearing_map])
def test_a_pupil_of_which_no_map_is_known_is_refused(known):
    with pytest.raises(ValueError, match="pupil is 'ful': maps are known of mask and full"):
        known("ful")


@pytest.mark.parametrize("value", [0.0, math.nan, -1.0])
def test_points_that_cannot_be_are_refused(value):
    with pytest.raises(ValueError, match=r"n_photons is .*: it must be finite and positive"):
        MAP.outlook(0.5, value, 1)
    with pytest.raises(ValueError, match=r"d_over_r0 is 0.*: it must be finite and positive"):
        success_map().outlook(0.0, 1e6, 5)
