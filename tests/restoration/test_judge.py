"""Endings are judged with the mask where each has found it."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import lowpass, relative_error
from torchmask.restoration import model_error
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.change import Change
from torchmask.restoration.checkpoint import Ending, Progress, Status
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.judge import Judge
from torchmask.restoration.model_error import LeftOut, expected_error, fitted_parameters
from torchmask.restoration.motion import Setting
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.placed import moved_centers
from torchmask.restoration.placement import moved
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.traits import End
from torchmask.restoration.verdict import Finding

TURN = torch.tensor([0.02, 0.0], dtype=torch.float64)


def test_each_ending_is_judged_where_it_has_found_the_mask(explain, traits, stack_of):
    """An ending that knows of the turn is explained as if nothing had been turned; one that does not is worse."""
    objective, state = explain(noise=0.003)
    stack = stack_of(objective)
    told = objective.model.pupil.aperture
    expected = Judge(Setting.of(objective), stack, traits, Schedule()).verdict(
        objective, Ending(state, Status.CONVERGED)
    )
    turned_back = told.replace(moved_centers(told.centers, -TURN))
    objective = objective.with_changes(model=objective.model.through(turned_back))
    judge = Judge(Setting.of(objective), stack, traits, Schedule(model_errors=0.0))  # any excess counts
    there = Ending(moved(state, TURN), Status.CONVERGED)
    here = Ending(state, Status.CONVERGED)
    assert judge.verdict(objective, there).chi_square == pytest.approx(expected.chi_square, rel=1e-9)
    assert judge.verdict(objective, there) is judge.verdict(objective, there)  # which is not simulated again
    assert judge.verdict(objective, here).chi_square > 1.5 * expected.chi_square
    for now, rival in ((here, there), (there, here)):
        found = judge.compare(objective, now, rival)
        assert found.best is there
        assert not found.alike
        assert found.verdict == judge.verdict(objective, there)
    assert not judge.compare(objective, here, here).alike  # two starts of a mask may have found one wrong twin
    full = Judge(Setting.of(objective), stack, replace(traits, many_minima=True), Schedule())
    assert full.compare(objective, here, here).alike


def test_noise_told_too_large_is_no_explanation(explain, traits, stack_of):
    """Of ten times the noise, a hundredth of the chi-square is left; of the right noise, more than is asked for."""
    objective, state = explain(noise=0.003)
    ending = Ending(state, Status.CONVERGED)
    for factor, finding in ((1.0, Finding.EXPLAINED), (10.0, Finding.TOO_MUCH_NOISE)):
        stack = replace(stack_of(objective), variance=(factor * 0.003) ** 2)
        told = MyopicObjective(objective.model, stack.frames, stack.precision, objective.prior)
        verdict = Judge(Setting.of(told), stack, traits, Schedule()).verdict(told, ending)
        assert verdict.finding is finding
        pixels, n = objective.frames.numel(), state.z.numel() + 2 * len(state.z)
        of_object = math.pi * objective.model.cutoff**2 * state.image.numel()
        chance = 5 * math.sqrt(2 / verdict.degrees_of_freedom)
        assert verdict.least == pytest.approx(1 - (of_object + n) / verdict.degrees_of_freedom - chance, rel=1e-3)
        assert verdict.chi_square * verdict.degrees_of_freedom < pixels * 1.1 / factor**2


def test_the_last_descent_is_held_to_the_modes_of_the_search(explain, five_holes, monkeypatch, traits, stack_of):
    """The limit stays where it was, while the degrees of freedom count the modes that were added."""
    objective, state = explain(noise=0.003)
    few = model_error._FITTED_FRAMES
    monkeypatch.setattr(model_error, "_FITTED_FRAMES", model_error._FRAMES)  # the same frames for both
    n_modes = objective.model.aberrations.n_modes
    finer = turbulent_basis(five_holes, n_modes + 5, 0, traits.r0, traits.outer_scale)
    setting = Setting.of(objective, finer=lambda: finer)
    judge = Judge(setting, stack_of(objective), traits, Schedule(chance=0.0))
    before = judge.verdict(objective, Ending(state, Status.CONVERGED))
    there = setting.in_finer_modes(state)
    at_end = setting.objective_at(objective, there)
    after = judge.verdict(at_end, Ending(there, Status.CONVERGED))
    assert before.model_error > 0
    assert after.model_error == pytest.approx(before.model_error, rel=1e-6)
    assert after.limit == pytest.approx(before.limit, rel=1e-6)
    assert after.phase_error == pytest.approx(before.phase_error, rel=1e-6)
    # five modes more in each of five holes, less what their prior holds
    assert 0 < before.degrees_of_freedom - after.degrees_of_freedom <= 25 * len(objective.frames)
    left_out = LeftOut.of(five_holes, n_modes + 5, traits.r0, traits.outer_scale)
    fitted = expected_error(at_end, there, left_out).fitted
    assert fitted_parameters(at_end, there) == pytest.approx(fitted, rel=1e-9)
    assert after.degrees_of_freedom == round(objective.frames.numel() - fitted * len(objective.frames))
    monkeypatch.setattr(model_error, "_FITTED_FRAMES", few)
    assert fitted_parameters(at_end, there) == pytest.approx(fitted, rel=0.1)  # single frames differ by some per cent


def test_the_likelier_of_two_starts_is_kept(explain, traits, stack_of):
    """Where both fit alike, the one whose aberrations are likelier, by the turbulence that each has found for itself.

    For z of n numbers the weight n / ||z||^2 is the likeliest, and the noise that a start assumed last does not count.
    """
    objective, state = explain(noise=0.003)
    judge = Judge(Setting.of(objective), stack_of(objective), traits, Schedule(likelier=0.0), End.INTEGRATION)
    found = state.z.numel() / float(state.z.square().sum())

    def ending(weight, inflation=1.0):
        calibration = replace(state.calibration, aberration_weight=weight)
        return Ending(replace(state, calibration=calibration).with_noise_inflation(inflation), Status.CONVERGED)

    for other in (0.8, 1.25):
        best, rival = ending(found), ending(other * found, inflation=5.0)
        for pair in ((best, rival), (rival, best)):
            assert judge.compare(objective, *pair).best is best
    careful = Judge(Setting.of(objective), stack_of(objective), traits, Schedule(likelier=1e3), End.INTEGRATION)
    assert careful.compare(objective, best, rival).best is rival  # the earlier one, as the costs are close
    worse = Ending(replace(state, z=0.9 * state.z), Status.CONVERGED)
    assert judge.compare(objective, worse, ending(0.5 * found)).best is not worse


def test_faint_frames_get_several_starts_though_they_are_explained(explain, monkeypatch, traits, stack_of):
    """However many bring nothing better, which their chi-square does not tell; in bright frames it does."""
    objective, state = explain(noise=0.003)
    ending, schedule = Ending(state, Status.CONVERGED), Schedule(faint_starts=4, starts=9, in_vain=2)

    def last_start(end, in_vain):
        judge = Judge(Setting.of(objective), stack_of(objective), traits, schedule, end)
        verdict = judge.verdict(objective, ending)
        assert verdict.explained
        begun = (Progress(Candidates(state, 1), starts=n, in_vain=in_vain) for n in range(1, 20))
        return next(progress.starts for progress in begun if not judge.wants_another(verdict, progress))

    assert [last_start(End.INTEGRATION, in_vain) for in_vain in (0, 2)] == [4, 4]
    assert [last_start(End.LAST_DESCENT, in_vain) for in_vain in (0, 2)] == [9, 1]
    monkeypatch.setattr(Change, "is_scarce", True)
    for shown, most in ((0.49, 1), (0.51, 4)):  # where light is scarce no later one is kept
        monkeypatch.setattr(Change, "shown", shown)
        assert last_start(End.INTEGRATION, 0) == most
    monkeypatch.setattr(Change, "shown", 0.49)
    judge = Judge(Setting.of(objective), stack_of(objective), traits, schedule, End.INTEGRATION)
    missed = judge.verdict(objective, Ending(replace(state, z=0 * state.z), Status.CONVERGED))
    assert missed.finding is Finding.NOT_EXPLAINED
    assert judge.most_starts(missed) == 9


def test_a_start_in_faint_frames_is_given_up_where_it_costs_much_more(explain, traits, stack_of):
    """By the cost for each aberration, with the noise as given; in bright frames by a fraction."""
    objective, state = explain(noise=0.003)
    worse = replace(state, z=0.5 * state.z)
    costs = [float(objective.value_and_gradients(s.image, s.z, s.calibration).value) for s in (worse, state)]
    above = (costs[0] - costs[1]) / state.z.numel()
    assert above > 0

    def given_up(hopeless, end=End.INTEGRATION, iterations=300, rival=state, starts=1):
        schedule = Schedule(hopeless=hopeless, near=math.inf, back_within=0.0)
        judge = Judge(Setting.of(objective), stack_of(objective), traits, schedule, end)
        before = None if rival is None else Ending(rival, Status.CONVERGED)
        now = Candidates(worse.with_noise_inflation(3.0), 1)
        return judge.gives_up(objective, Progress(now, iterations * [1.0], starts=starts, rival=before))

    assert given_up(0.999 * above)
    assert not given_up(1.001 * above)
    assert not given_up(0.0, End.LAST_DESCENT)
    assert not given_up(math.inf, starts=2)
    assert not given_up(0.0, iterations=299)
    assert not given_up(0.0, rival=None)


@pytest.mark.parametrize("end", [End.LAST_DESCENT, End.BOTH, End.NONE])
def test_a_twin_of_an_explained_mask_has_to_be_near_and_is_kept_if_it_costs_less(end, explain, traits, stack_of):
    """Others are looked for if that is clear: near and clear are fractions of what the best so far costs beyond noise.

    Noise is half of the number of pixels.
    """
    objective, state = explain(noise=0.003)

    def beyond_noise(state):
        noise = 0.5 * objective.frames.numel()
        return float(objective.value_and_gradients(state.image, state.z, state.calibration).value) - noise

    other = replace(state, z=0.999 * state.z)
    low, high = sorted((state, other), key=beyond_noise)
    above, part = beyond_noise(high) / beyond_noise(low) - 1, 1 - beyond_noise(low) / beyond_noise(high)
    assert 0 < part < above

    def judge_of(nearly_at_rest=0.0, **numbers):
        schedule = Schedule(nearly_at_rest=nearly_at_rest, back_within=0.0, **numbers)
        return Judge(Setting.of(objective), stack_of(objective), traits, schedule, end)

    def given_up(near, explained=True, **numbers):
        judge, now = judge_of(near=near, **numbers), Candidates(high.with_noise_inflation(3.0), 1)
        rival = Ending(low, Status.CONVERGED)
        assert judge.verdict(objective, rival).explained is explained
        return judge.gives_up(objective, Progress(now, 300 * [1.0], starts=5, rival=rival))

    def compare(better, now, rival, **numbers):
        now, rival = (Ending(ending, Status.CONVERGED) for ending in (now, rival))
        return judge_of(better=better, **numbers).compare(objective, now, rival)

    def replaces(better, now, rival, **numbers):
        return compare(better, now, rival, **numbers).best.state is now

    def advances(better, now, rival, **numbers):
        return compare(better, now, rival, **numbers).advances

    assert given_up(0.99 * above)
    assert not given_up(1.01 * above)
    assert replaces(math.inf, low, high)
    assert not replaces(0.0, high, low)
    assert advances(0.99 * part, low, high)
    assert not advances(1.01 * part, low, high)
    assert not advances(0.0, high, low)
    # starts may end before they are at rest, by three times so much of the whole cost
    costs = [beyond_noise(ending) + 0.5 * objective.frames.numel() for ending in (low, high)]
    third = (costs[1] - costs[0]) / 3
    assert given_up(0.0, nearly_at_rest=0.99 * third / costs[0])
    assert not given_up(0.0, nearly_at_rest=1.01 * third / costs[0])
    assert advances(0.0, low, high, nearly_at_rest=0.99 * third / costs[1])
    assert not advances(0.0, low, high, nearly_at_rest=1.01 * third / costs[1])
    # where the frames are not explained, the residual tells, and the fifth start is from random aberrations
    missed = {"chance": -1e9}
    assert not given_up(0.0, explained=False, **missed)
    left = [judge_of().verdict(objective, Ending(ending, Status.CONVERGED)).excess for ending in (low, high)]
    for tell in (replaces, advances):
        assert tell(math.inf, low, high, **missed) is (left[0] <= left[1])


def test_a_twin_that_has_come_back_is_given_up(explain, traits, stack_of):
    """From some iterations on, if the object is that of the best but for its fine parts, and costs no less."""
    objective, state = explain(noise=0.003)
    finer = objective.model.cutoff / 2
    rest = state.image - lowpass(state.image, finer)
    fine = replace(state, image=state.image - 0.5 * rest)  # alike but for what is above half the cut-off
    moved = replace(state, image=state.image.roll((3, 1), (0, 1)))
    coarse = replace(state, image=state.image + 0.2 * state.image.roll(6, 0))
    apart = relative_error(coarse.image, state.image, finer)
    assert apart > 0.1

    def given_up(now, best=state, iterations=200, starts=2, end=End.LAST_DESCENT, **numbers):
        schedule = Schedule(near=math.inf, hopeless=math.inf, **{"chance": math.inf} | numbers)
        judge = Judge(Setting.of(objective), stack_of(objective), traits, schedule, end)
        progress = Progress(Candidates(now, 1), iterations * [1.0], starts=starts, rival=Ending(best, Status.CONVERGED))
        return judge.gives_up(objective, progress)

    assert given_up(fine)
    assert given_up(moved)  # frames do not say where the object lies
    assert given_up(fine, iterations=900)
    assert not given_up(fine, iterations=199)
    assert not given_up(fine, back_after=201)
    assert given_up(fine, iterations=400, glance=300, back_after=400)
    assert given_up(fine, iterations=250, glance=300)
    assert not given_up(fine, back_within=0.0)
    assert not given_up(state, best=fine)  # it costs less
    assert given_up(coarse, back_within=1.01 * apart)
    assert not given_up(coarse, back_within=0.99 * apart)
    assert not given_up(fine, end=End.INTEGRATION)
    assert not given_up(fine, chance=-1e9, promising=math.inf)  # the best does not explain the frames


def test_a_start_that_explains_a_masks_frames_is_replaced_by_none_that_does_not(explain, traits, stack_of):
    """Even if that costs less; through a full pupil the residual tells."""
    objective, state = explain(noise=0.003)
    # not only darker, as transmissions would take that over and rounding decide which residual is smaller
    dear = replace(state, image=state.image + 0.01 * state.image.roll(6, 0))
    cheap, explains = Ending(state, Status.CONVERGED), Ending(dear, Status.CONVERGED)
    schedule = Schedule(better=0.0, nearly_at_rest=0.0, chance=math.inf)

    def best(**options):
        judge = Judge(Setting.of(objective), stack_of(objective), replace(traits, **options), schedule)
        assert judge.compare(objective, cheap, explains).best is cheap  # as long as both explain the frames
        told = judge.verdict(objective, cheap)
        judge._given[id(cheap.state), True] = cheap.state, replace(told, finding=Finding.NOT_EXPLAINED)
        assert judge.verdict(objective, explains).explained
        return judge.compare(objective, cheap, explains).best

    assert best() is explains
    assert best(many_minima=True) is cheap


def test_the_best_start_is_heated_once_if_twins_may_improve_it(explain, traits, stack_of):
    """And as many iterations are left as a twin has before it may be given up."""
    objective, state = explain(noise=0.003)

    def may(end=End.LAST_DESCENT, spent=0, n=1, tempered=False, many_minima=False, **numbers):
        told = replace(traits, max_iterations=1000, many_minima=many_minima)
        schedule = Schedule(**{"chance": math.inf, "glance": 300} | numbers)
        judge = Judge(Setting.of(objective), stack_of(objective), told, schedule, end)
        verdict = judge.verdict(objective, Ending(state, Status.CONVERGED))
        return judge.may_temper(verdict, Progress(Candidates(state, 1), spent * [1.0], starts=n, tempered=tempered))

    assert may()
    assert may(End.BOTH)
    assert may(spent=699)
    assert not may(spent=700)
    assert may(n=8)
    assert not may(n=9)
    assert not may(tempered=True)
    assert not may(cooling=0)
    assert not may(in_vain=0)
    assert not may(chance=-1e9)
    assert not may(End.INTEGRATION)
    assert not may(End.FULL_PUPIL, many_minima=True)


def test_a_mask_of_three_holes_has_no_twins(explain, three_holes, traits, stack_of):
    """Their common pistons are a tilt, which shifts the object."""
    for aperture, again in ((three_holes, False), (None, True)):
        model = None
        if aperture is not None:
            basis = turbulent_basis(aperture, 3, 0, 0.25, 20.0)
            model = ExposureModel(aperture, Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2), basis)
        objective, state = explain(model, noise=0.003)
        judge = Judge(Setting.of(objective), stack_of(objective), traits, Schedule(chance=math.inf))
        verdict = judge.verdict(objective, Ending(state, Status.CONVERGED))
        assert verdict.explained
        assert judge.wants_another(verdict, Progress(Candidates(state, 1))) is again


def test_a_start_that_explains_the_frames_ends_when_nearly_at_rest(explain, traits, stack_of):
    """The last descent goes on from there; otherwise it has to be at rest."""
    objective, state = explain(noise=0.003)
    schedule = Schedule(nearly_at_rest=0.01)
    known, wrong = (Progress(Candidates(found, 1)) for found in (state, replace(state, z=0 * state.z)))

    def rests(progress, decrease, end=End.LAST_DESCENT, tolerance=0.001, schedule=schedule):
        told = replace(traits, tolerance=tolerance, many_minima=end is End.FULL_PUPIL)
        judge = Judge(Setting.of(objective), stack_of(objective), told, schedule, end)
        return judge.is_at_rest(objective, progress, decrease)

    assert rests(known, 0.009)
    assert not rests(known, 0.011)
    assert not rests(wrong, 0.009)
    assert not rests(known, 0.009, End.NONE)
    assert not rests(known, 0.009, End.INTEGRATION)
    assert not rests(known, 0.009, End.FULL_PUPIL)
    assert not rests(known, 0.009, End.OBJECT)
    assert rests(known, 0.011, tolerance=0.02)
    # explained, as any model error is allowed, but doubted, as no chance is
    doubted = replace(schedule, model_errors=1e12, chance=-1e9, doubtful=0.0)
    judge = Judge(Setting.of(objective), stack_of(objective), traits, doubted, End.LAST_DESCENT)
    assert judge.verdict(objective, known.ending).explained
    assert not rests(known, 0.009, schedule=doubted)
    assert rests(known, 0.009, schedule=replace(doubted, doubtful=1e12))
    for progress in (known, wrong):
        assert rests(progress, 0.001)
