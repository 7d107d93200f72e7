"""What a judge compares and allows: costs with common aberrations, endings that are alike, and a single frame."""

from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture
from torchmask.restoration.aberrations import AberrationBasis, plain_basis
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Ending, Progress, Status
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.judge import Judge
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import State
from torchmask.restoration.traits import End
from torchmask.restoration.variation import TotalVariation
from torchmask.restoration.verdict import Finding

NOISE = 0.003


def test_common_aberrations_do_not_count_in_the_likelihood_of_a_weight(
    explain, five_holes, five_hole_basis, traits, stack_of
):
    """The weight of the prior is that of a frame's own aberrations: for n numbers z of these n / |z|^2 is the
    likeliest, of two starts that are else the same."""
    basis = AberrationBasis(five_hole_basis.mixing, 3, n_common=6)
    objective, state = explain(ExposureModel(five_holes, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2), basis))
    own = state.z[:, : basis.n_own]
    found = own.numel() / float(own.square().sum())
    judge = Judge(Setting.of(objective), stack_of(objective), traits, Schedule(likelier=0.0), End.INTEGRATION)

    def ending(weight):
        return Ending(state.calibrated(aberration_weight=weight), Status.CONVERGED)

    for other in (0.9, 1.1):  # as many more numbers as common ones would move the likeliest weight by 3 / 4
        best, rival = ending(found), ending(other * found)
        for pair in ((best, rival), (rival, best)):
            assert judge.compare(objective, *pair).best is best


@pytest.mark.parametrize(
    ("before", "after", "limit", "alike"),
    [
        (0.010, 0.024, 1.5, True),  # they differ by less than 0.03 of what may be left
        (0.010, 0.026, 1.5, False),
        (1.000, 1.029, 1.5, True),  # or of what the better one leaves, if that is more
        (1.000, 1.031, 1.5, False),
        (-0.010, 0.004, 1.5, True),
    ],
)
def test_endings_of_a_full_pupil_are_alike_by_the_larger_of_what_is_left_and_what_may_be(
    before, after, limit, alike, explained, traits, stack_of
):
    objective, state = explained
    judge = Judge(Setting.of(objective), stack_of(objective), replace(traits, many_minima=True), Schedule(alike=0.03))
    told = judge.verdict(objective, Ending(state, Status.CONVERGED))
    endings = [Ending(replace(state), Status.CONVERGED) for _ in range(2)]
    for ending, excess in zip(endings, (before, after), strict=True):
        verdict = replace(told, chi_square=1 + excess, limit=limit)
        judge._given[id(ending.state), True] = ending.state, verdict
    for one, other in (endings, endings[::-1]):
        found = judge.compare(objective, one, other)
        assert found.best is endings[0]
        assert found.alike is alike


@pytest.mark.parametrize(("n_frames", "estimated", "asks"), [(1, False, True), (1, True, False), (2, False, False)])
def test_one_frame_is_to_be_checked_against_others_unless_a_sensor_has_measured_it(
    n_frames, estimated, asks, traits, stack_of
):
    """Many objects, each with aberrations to suit, explain a single frame; not where these are known but for errors."""
    pupil, grid = FullAperture(1.0), Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
    model = ExposureModel(pupil, grid, plain_basis(pupil, 3))
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(model.window.field.shape, dtype=torch.float64, generator=generator)
    z = torch.zeros(n_frames, 3, dtype=torch.float64)
    frames = model(image, z)
    frames = frames + NOISE * torch.randn(frames.shape, dtype=torch.float64, generator=generator)
    precision = torch.full((1, 1, 1), NOISE**-2, dtype=torch.float64)
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    told = replace(traits, many_minima=True, estimated=estimated)
    judge = Judge(Setting.of(objective), stack_of(objective), told, Schedule(chance=4.0))
    calibration = objective.neutral_calibration()
    verdict = judge.verdict(objective, Ending(State(image, z, calibration), Status.CONVERGED))
    assert verdict.explained
    assert ("against other frames" in verdict.check) is asks


@pytest.mark.parametrize(("left", "goes_on"), [(6.9, True), (7.1, False)])
def test_a_twin_has_to_be_well_ahead_of_a_best_start_that_does_not_explain_the_frames(
    left, goes_on, explained, traits, stack_of
):
    """It is given up at a glance unless it leaves less than 0.7 of the excess; one from random aberrations never is."""
    objective, state = explained
    schedule = Schedule(promising=0.7, glance=300, twins=3)
    judge = Judge(Setting.of(objective), stack_of(objective), traits, schedule, End.LAST_DESCENT)
    best, now = Ending(state, Status.CONVERGED), Candidates(replace(state), 1)
    told = replace(judge.verdict(objective, best), finding=Finding.NOT_EXPLAINED)
    judge._given[id(best.state), True] = best.state, replace(told, chi_square=11.0)
    for at_rest in (False, True):
        judge._given[id(now.state), at_rest] = now.state, replace(told, chi_square=1 + left)

    def given_up(iterations=300, starts=2):
        return judge.gives_up(objective, Progress(now, iterations * [1.0], starts=starts, rival=best))

    assert given_up() is not goes_on
    assert not given_up(iterations=299)
    assert not given_up(iterations=301)
    assert not given_up(starts=5)  # the fourth further start
