"""Whole waves of piston in a band: what a line divides, and frames that find their fringes again."""

import itertools
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.descent import descend
from torchmask.restoration.escapes import escape
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.fringes import change_fringes, sides_of_lines
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.starts import fit_new_frames
from torchmask.restoration.traits import Refinement, Traits


def is_divided(points, side):
    """Whether a line has the points of `side` on one side and the others on the other, by linear programming."""
    signs = [1 if chosen else -1 for chosen in side]
    rows = [[-sign * x, -sign * y, -sign] for sign, (x, y) in zip(signs, points, strict=True)]
    return linprog([0, 0, 0], A_ub=rows, b_ub=[-1] * len(rows), bounds=[(None, None)] * 3).status == 0


@settings(max_examples=20)
@given(st.lists(st.tuples(*[st.integers(-999, 999)] * 2), min_size=3, max_size=6, unique=True))
def test_sides_are_all_that_a_line_divides_and_each_hole_alone(points):
    """Each once, as the side without the first hole; points nearly in a row are left out, where rounding decides."""
    for a, b, c in itertools.combinations(points, 3):
        if abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) < 2000:
            return
    found = {tuple(side) for side in sides_of_lines(torch.tensor(points, dtype=torch.float64)).tolist()}
    n = len(points)
    every = [(False, *rest) for rest in itertools.product((False, True), repeat=n - 1) if any(rest)]
    alone = {(False,) * k + (True,) + (False,) * (n - 1 - k) for k in range(1, n)} | {(False,) + (True,) * (n - 1)}
    assert found == {side for side in every if is_divided(points, side)} | alone


def test_sides_do_not_repeat_and_their_number_is_that_of_points_in_general_position():
    centers = torch.randn(11, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    sides = sides_of_lines(centers)
    assert len(torch.unique(sides, dim=0)) == len(sides)
    divided = sum(is_divided(centers.tolist(), side) for side in sides.tolist())
    assert divided == 11 * 10 / 2  # of N points N (N - 1) / 2, but for none and all


@pytest.mark.parametrize(
    "waves",
    [
        [[0, 0, 0, 0, 0], [0, 1, 0, 0, 0], [0, 0, 0, -1, 0], [0, 0, 0, 0, 0]],
        [[1, 1, 0, 0, 0], [0, 0, 0, 0, 0], [0, -1, -1, 0, 0], [0, 2, 0, 0, 0]],  # two holes side by side; two waves
    ],
)
def test_frames_find_their_fringes_again(waves, wide, off):
    objective, state = wide
    lost = off(objective, state, waves)
    costs = [objective.frame_costs(one.image, one.z, one.calibration) for one in (lost, state)]
    wrong = [any(row) for row in waves]
    assert (costs[0] > costs[1] + 1)[wrong].all()  # the band shows them
    found, n_evaluations = change_fringes(objective, lost)
    torch.testing.assert_close(found.z, state.z, rtol=0, atol=1e-9)
    right = [not one for one in wrong]
    assert torch.equal(found.z[right], lost.z[right])
    assert torch.equal(found.image, lost.image)
    assert n_evaluations > 0


def test_evaluations_are_those_of_the_frames_that_move(wide, five_holes, off):
    objective, state = wide
    n_changes = 2 * len(sides_of_lines(five_holes.centers)) + 1  # and the frame as it is
    stays, once = change_fringes(objective, state)
    assert stays is state
    assert once == n_changes
    waves = torch.zeros(len(state.z), 5)
    waves[0, 1] = 1
    assert change_fringes(objective, off(objective, state, waves.tolist()))[1] == n_changes + n_changes // len(state.z)


def test_common_aberrations_weigh_the_same_in_every_round(wide, five_holes, explain, off, in_band):
    """In the second round one frame is left, two waves off at first, whose prior would hold them alone."""
    basis = turbulent_basis(five_holes, 3, 6, 0.25, 20.0)
    objective, state = explain(in_band(basis))
    z = state.z.clone()
    z[:, basis.n_own :] *= 100 / z[0, basis.n_own :].norm()  # (1 - 1/4) 100^2 / 2 is more than any gain
    frames = objective.model(state.image, z)
    objective = MyopicObjective(objective.model, frames, objective.precision, objective.prior)
    lost = off(objective, replace(state, z=z), [[0, 2, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 0], [0, 0, 0, 0, 0]])
    torch.testing.assert_close(change_fringes(objective, lost)[0].z, z, rtol=0, atol=1e-9)


def test_one_wavelength_does_not_show_them(explained):
    objective, state = explained
    lost = replace(
        state, z=state.z + objective.model.aberrations.parameters_of_pistons(torch.tensor([5.0, 0, 0, 0, 0]))
    )
    assert change_fringes(objective, lost) == (lost, 0)


def test_a_full_pupil_has_none(explain):
    grid = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.5)
    objective, state = explain(ExposureModel(FullAperture(1.0), grid, 4, Band.top_hat(600e-9, 200e-9, 5)), n_frames=2)
    assert change_fringes(objective, state) == (state, 0)


def test_an_escape_of_a_mask_changes_them(wide, off):
    objective, state = wide
    lost, alone = off(objective, state, [[0, 1, 0, 0, 0]] * 4), objective.with_changes(free=Free.ABERRATIONS)
    known = {"estimated": False, "prior_on_aberrations": True, "r0_is_open": False, "r0": 0.25, "outer_scale": 20.0}
    known |= {"max_iterations": 1, "tolerance": 0.0, "seed": 0, "refinement": Refinement.OFF}
    for many_minima in (False, True):
        how = (Traits(many_minima=many_minima, **known), Schedule(outlying=math.inf), ProjectedLBFGS(), 1)
        found, n_evaluations = escape(alone, lost, 30.0, *how, whole_waves=True)
        if many_minima:
            assert found is lost
            continue
        torch.testing.assert_close(found.z, state.z, rtol=0, atol=1e-9)
        assert n_evaluations == change_fringes(alone, lost)[1]


def test_an_escape_leaves_them_where_they_are_not_asked_for(wide, off):
    objective, state = wide
    lost, alone = off(objective, state, [[0, 1, 0, 0, 0]] * 4), objective.with_changes(free=Free.ABERRATIONS)
    known = {"estimated": False, "prior_on_aberrations": True, "r0_is_open": False, "r0": 0.25, "outer_scale": 20.0}
    known |= {"max_iterations": 1, "tolerance": 0.0, "seed": 0, "refinement": Refinement.OFF, "many_minima": False}
    how = (Traits(**known), Schedule(outlying=math.inf), ProjectedLBFGS(), 1)
    assert escape(alone, lost, 30.0, *how, whole_waves=False)[0] is lost


def test_a_descent_does_not_find_them(wide, off):
    """Which is why they are tried: for four frames, with each hole off by a wave either way, it ends at a higher cost.

    By chance it finds one now and then: one of the 40 was seen, where the aberrations are those of other signs of
    eigenvectors, as processors differ in these. At that rate more than four are found in 0.4 % of all cases (Poisson).
    """
    objective, state = wide
    alone = objective.with_changes(free=Free.ABERRATIONS)
    least, higher = objective.frame_costs(state.image, state.z, state.calibration), 0
    for hole, wave in itertools.product(range(5), (-1, 1)):
        lost = off(objective, state, [[wave if other == hole else 0 for other in range(5)]] * 4)
        ended = descend(alone, lost, 200, ProjectedLBFGS(), lambda *told: None)
        higher += int((objective.frame_costs(ended.image, ended.z, ended.calibration) > least + 1).sum())
    assert higher >= 40 - 4


def test_new_frames_find_them_for_the_object_of_earlier_ones(wide, off):
    """The last of four frames is new, and begins a wave off. The evaluations are those of one frame in four."""
    objective, state = wide
    lost = off(objective, state, [[0, 0, 0, 0, 0]] * 3 + [[0, 1, 0, 0, 0]])
    fitted, spent = fit_new_frames(objective, lost, 3, None, Schedule(segment=60), ProjectedLBFGS(), 0)
    new, alone = slice(3, 4), objective.of_frames(slice(3, 4), free=Free.ABERRATIONS)
    right = descend(alone, state.of_frames(new), 60, ProjectedLBFGS(), lambda *told: None)
    counts = []
    stays = descend(alone, lost.of_frames(new), 60, ProjectedLBFGS(), lambda *told: counts.append(told[1]))
    found = fitted.of_frames(new)  # from which the restoration descends further
    ends = [descend(alone, one, 60, ProjectedLBFGS(), lambda *told: None) for one in (found, right, stays)]
    costs = [float(alone.frame_costs(one.image, one.z, one.calibration)) for one in ends]
    assert costs[0] < costs[1] + 1 < costs[2]
    assert torch.equal(fitted.z[:3], lost.z[:3])
    tried = 2 * (2 * len(sides_of_lines(objective.model.pupil.aperture.centers)) + 1)  # it changes in the first round
    assert spent == (sum(counts) + tried) // 4
