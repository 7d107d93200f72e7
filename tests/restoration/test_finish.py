"""The end of a restoration: more modes, a smoother object, and when there is neither."""

import functools
import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import relative_error
from torchmask.optics.aperture import FullAperture
from torchmask.optics.band import Band
from torchmask.restoration import finish, myopic, spectrum
from torchmask.restoration.aberrations import moving_basis, turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.calibration import fit_of_frames
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.change import Change
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.finish import Finisher
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.motion import Setting
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import EdgePreserving
from torchmask.restoration.projected_lbfgs import Minimum, ProjectedLBFGS
from torchmask.restoration.recipe import ModelRecipe
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.slopes import gradient, rate_of_descent, rate_of_slopes
from torchmask.restoration.solver import Solver
from torchmask.restoration.spectrum import Power
from torchmask.restoration.traits import End, Refinement, Traits
from torchmask.restoration.variation import AdaptedVariation, SmoothVariation, TotalVariation
from torchmask.simulation.scene import SceneOptions, make_scene

BLIND = Free.OBJECT | Free.ABERRATIONS | Free.COMMON
R0, OUTER_SCALE = 0.25, 20.0
GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)
FULL_PUPIL = Traits(True, False, True, False, R0, OUTER_SCALE, 1000, 0.0, 0, Refinement.OFF)
CHANGE = Change(100.0, 10, 4096)
TRAITS = Traits(False, False, True, False, R0, OUTER_SCALE, 1000, 0.0, 0, Refinement.OFF)
BRIEF = {"last_settling": 5, "comparing": 3}  # where it does not matter how well an object is settled


def basis_of(mask, n_modes, n_common=0, exposure=0.0, r0=R0):
    still = turbulent_basis(mask, n_modes, n_common, r0, OUTER_SCALE)
    return moving_basis(still, mask, exposure, R0, OUTER_SCALE) if exposure else still


@pytest.mark.parametrize(("n_common", "exposure"), [(0, 0.0), (2, 0.0), (8, 1.0)])
def test_finer_modes_begin_at_the_same_aberrations(n_common, exposure, five_holes, explain):
    still, fine = (basis_of(five_holes, n_modes, n_common) for n_modes in (3, 6))
    finer = basis_of(five_holes, 6, n_common, exposure)
    moving = basis_of(five_holes, 3, n_common, exposure) if exposure else None
    objective, state = explain(ExposureModel(five_holes, GRID, still))
    setting = Setting.of(objective, moving, lambda: finer)
    state = setting.in_motion(state, seed=0)
    there = setting.in_finer_modes(state)
    before, after = setting.objective_at(objective, state), setting.objective_at(objective, there)
    assert after.model.aberrations.n_modes == fine.n_modes
    assert there.z.shape == after.centre.shape == (4, finer.n_parameters)
    assert torch.allclose(after.model(state.image, there.z), before.model(state.image, state.z), rtol=1e-9)
    common = slice(finer.n_own, None)
    assert torch.equal(there.z[:, common], state.z[:, state.z.shape[1] - finer.n_common :])
    again = setting.in_first_modes(there)
    assert again.modes is state.modes
    assert torch.allclose(again.z, state.z, atol=1e-9)
    assert setting.in_first_modes(state) is state
    back = setting.objective_at(after, again)
    assert back.centre.shape == state.z.shape
    assert torch.equal(back.model(state.image, state.z), before.model(state.image, state.z))


def test_aberrations_stay_as_they_are_without_finer_modes(five_holes, explained):
    objective, state = explained
    assert Setting.of(objective).in_finer_modes(state) is state
    waiting = Setting.of(objective, basis_of(five_holes, 3, 0, 1.0), lambda: basis_of(five_holes, 6, 0, 1.0))
    assert waiting.in_finer_modes(state) is state  # it has not begun to move


@pytest.mark.parametrize(
    ("options", "n_modes"),
    [({}, 6), ({"last_modes": 3}, None), ({"last_modes": 2}, None), ({"whitened": False}, None)],
)
def test_a_recipe_has_a_finer_basis_if_it_has_more_modes(options, n_modes, five_holes):
    given = {"frame_modes": 3, "static_modes": 0, "r0": R0, "outer_scale": OUTER_SCALE, "whitened": True}
    given |= {"dtype": torch.float64, "device": None, "last_modes": 6} | options
    finer = ModelRecipe(five_holes, GRID, Band.of([550e-9]), **given).finer_basis()
    assert (finer and finer.n_modes) == n_modes
    if finer is not None:  # white under the same turbulence
        assert torch.allclose(finer.mixing, basis_of(five_holes, 6).mixing)


def ended(
    objective,
    state,
    setting,
    schedule,
    records=None,
    minimizer=None,
    end=End.LAST_DESCENT,
    traits=TRAITS,
    finer=None,
    change=CHANGE,
):
    progress = Progress(Candidates(state, 1), finer=finer)
    listen = None if records is None else records.append
    minimizer = minimizer or ProjectedLBFGS()
    finisher = Finisher(setting, schedule, minimizer, listen, traits, lambda progress: None, change)
    return finisher.finish(objective, progress, end), progress


def test_more_modes_explain_what_few_leave(five_holes, explain):
    """Frames of six modes, of which three are fitted to them before.

    In six cases 2 to 6 % of the excess chi-square are left, 4.1 % on average with a standard deviation of 1.3 %.
    """
    truth, state = explain(ExposureModel(five_holes, GRID, basis_of(five_holes, 6, r0=0.5)), noise=0.008)
    few = truth.with_changes(
        model=ExposureModel(five_holes, GRID, basis := basis_of(five_holes, 3, r0=0.5)),
        centre=torch.zeros(4, basis.n_parameters, dtype=torch.float64),
        prior=TotalVariation(0.01),  # which does not keep the object from the noise
    )
    start = truth.model.aberrations.coefficients(state.z)[..., :3]
    begun = replace(state, z=basis.parameters_of(start))
    setting = Setting.of(few, finer=lambda: truth.model.aberrations)
    records = []
    objective, progress = ended(few, begun, setting, Schedule(last_segments=2, last_gain=0.0), records)
    chi_square = [float(fit_of_frames(*pair)[1].mean()) for pair in ((few, begun), (objective, progress.state))]
    assert chi_square[0] > 2
    pixels = truth.frames.numel()
    fitted = state.z.numel() + state.image.numel()
    left = 0.041 + 3 * 0.013 * math.sqrt(1 + 1 / 6)
    assert 1 - fitted / pixels < chi_square[1] < 1 + left * (chi_square[0] - 1)
    assert isinstance(objective.prior, SmoothVariation)
    assert progress.state.geometry == begun.geometry
    assert len(records) <= progress.n_evaluations <= 2 * len(records) + 5
    assert [record.step for record in records] == list(range(1, len(records) + 1))


@pytest.mark.parametrize(("traits", "end"), [(TRAITS, End.LAST_DESCENT), (FULL_PUPIL, End.FULL_PUPIL)])
def test_the_last_descent_ends_when_half_a_segment_gains_little(traits, end, explained):
    objective, state = explained
    gains = [0.5, 0.02, 0.009, 0.5]

    def says(cost, start, lower, *, max_iterations, callback):
        """A minimiser of four iterations that stays where it is, and says what the second half of them gained."""
        gain = gains.pop(0)
        for step, told in enumerate((9.0, 9.0, 1 + gain, 1.0), start=1):
            callback(start, told, step)
        return Minimum(start, 1.0, 4, 4, False, "says so")

    own, other = ("last_gain_full", "last_gain") if traits.many_minima else ("last_gain", "last_gain_full")
    setting, schedule = Setting.of(objective), Schedule(**{own: 0.01, other: 0.3}, **BRIEF)
    _, progress = ended(objective, state, setting, schedule, minimizer=says, traits=traits, end=end)
    assert gains == [0.5]
    assert progress.n_evaluations == 3 * 4
    gains = [0.5] * 4
    ended(objective, state, setting, replace(schedule, last_segments=3), minimizer=says, traits=traits, end=end)
    assert len(gains) == 1


@pytest.mark.parametrize(
    ("change", "end"),
    [(1.0, End.INTEGRATION), (2.0, End.BOTH), (2.99, End.BOTH), (3.0, End.LAST_DESCENT), (math.inf, End.LAST_DESCENT)],
)
def test_how_a_restoration_ends_depends_on_how_much_its_frames_change(change, end):
    assert End.of(change, TRAITS, Schedule(faint=2.0, noisy=3.0), BLIND) is end
    assert end.descends is (end is not End.INTEGRATION)


@pytest.mark.parametrize(
    ("end", "stages"),
    [
        (End.LAST_DESCENT, ["last descent"] * 4),
        (End.BOTH, ["last descent"] * 4 + ["integration"] * 3),
        (End.INTEGRATION, ["integration"] * 5),
    ],
)
def test_aberrations_are_integrated_out_after_the_last_descent_or_in_its_place(explained, end, stages):
    objective, state = explained
    schedule, records = Schedule(segment=4, last_segments=1, rounds=5, fine_rounds=3, moves=2, **BRIEF), []
    found, progress = ended(objective, state, Setting.of(objective), schedule, records, end=end)
    assert [record.stage for record in records] == stages
    assert progress.integrated is (end is not End.LAST_DESCENT)
    assert isinstance(found.prior, SmoothVariation)  # that of the integration, or of the last descent without it
    assert progress.n_evaluations >= sum(2 + 2 if stage == "integration" else 1 for stage in stages)


@pytest.mark.parametrize(
    ("end", "gentle", "descends", "integrates"),
    [
        (End.LAST_DESCENT, False, True, None),
        (End.FULL_PUPIL, False, True, None),
        (End.OBJECT, False, True, None),
        (End.BOTH, False, False, True),
        (End.BOTH, True, False, False),
        (End.INTEGRATION, False, None, False),
        (End.INTEGRATION, True, None, False),
    ],
)
def test_which_priors_are_adapted_to_the_object(end, gentle, descends, integrates, explained, monkeypatch):
    """That of a descent, before each of its segments, and that of an integration after one, unless slopes are gentle:
    neither in the descent before it, nor where the search has ended in faint frames."""
    objective, state = explained
    asked, told = {True: set(), False: set()}, []
    monkeypatch.setattr(finish, "shows_gentle_slopes", lambda *given, faint: gentle)
    monkeypatch.setattr(SmoothVariation, "adapted_to", lambda self, image, reach: told.append((image, reach)) or self)
    descend, integrate = finish.descend, finish.integrate_aberrations

    def look_at_descent(objective, state, *rest):
        asked[True].add(any(image is state.image for image, _ in told))
        return descend(objective, state, *rest)

    def look_at_integration(objective, state, *rest, **more):
        asked[False].add(any(image is state.image for image, _ in told))
        return integrate(objective, state, *rest, **more)

    monkeypatch.setattr(finish, "descend", look_at_descent)
    monkeypatch.setattr(finish, "integrate_aberrations", look_at_integration)
    monkeypatch.setattr(finish, "settle", lambda objective, state, n_iterations: state)
    schedule = Schedule(segment=4, last_segments=2, last_gain=0.0, last_gain_full=0.0, rounds=2, fine_rounds=2, moves=1)
    traits = FULL_PUPIL if end is End.FULL_PUPIL else TRAITS
    ended(objective, state, Setting.of(objective), schedule, traits=traits, end=end)
    assert asked == {
        True: set() if descends is None else {descends},
        False: set() if integrates is None else {integrates},
    }
    assert {reach for _, reach in told} <= {0.5 / objective.model.cutoff}


@pytest.mark.parametrize(
    ("prior", "rate", "n_segments"),
    [
        (TotalVariation(0.5), 0.3, 3),
        (TotalVariation(0.5), 1.0, 0),
        (TotalVariation(0.5), math.inf, 0),
        (EdgePreserving(), 0.3, 0),
    ],
)
def test_a_search_under_a_lighter_prior_descends_under_the_given_one_again(
    prior, rate, n_segments, explained, monkeypatch
):
    """With the noise estimated anew each time; the integration begins from there, under a prior of that scale."""
    objective, state = explained
    course, records, asked = [], [], []

    def descend(objective, state, n_iterations, minimizer, listen):
        course.append((objective.prior, n_iterations))
        listen(1.0, 7, lambda: None)
        return replace(state, image=2 * state.image)

    def integrate(objective, state, *rest, **more):
        course.extend([objective.prior, state.image])
        return state, 0

    def recalibrate(objective, state, power, **more):
        course.append("recalibrated")
        return state

    monkeypatch.setattr(finish, "descend", descend)
    monkeypatch.setattr(finish, "recalibrate", recalibrate)
    monkeypatch.setattr(finish, "integrate_aberrations", integrate)
    monkeypatch.setattr(finish, "shows_gentle_slopes", lambda *given, faint: asked.append((given[2], faint)) or True)
    schedule = Schedule(faint_segments=3, segment=4)
    end_rate, change = 0.8, Change(6.0, 10, 4096)
    state = replace(state, image=state.image * rate_of_slopes(state.image) / end_rate / 2**n_segments)
    progress = Progress(Candidates(state, 1), rate=rate)
    finisher = Finisher(
        Setting.of(objective), schedule, ProjectedLBFGS(), records.append, TRAITS, lambda progress: None, change
    )
    finisher.finish(objective.with_changes(prior=prior), progress, End.INTEGRATION)
    *segments, own, image = course
    assert segments == n_segments * ["recalibrated", (prior, 4)]
    assert torch.equal(image, 2**n_segments * state.image)
    assert asked == [(change, False)]  # whether slopes are gentle, of frames that change by more than `faint`
    assert repr(own) == repr(prior.suited_to(max(end_rate, change.light / 40)))
    assert own.weight == prior.weight * (change.light / 40 if isinstance(prior, TotalVariation) else 1)
    assert progress.n_evaluations == 7 * n_segments
    assert [(record.stage, record.step) for record in records] == [
        ("before integration", number + 1) for number in range(n_segments)
    ]
    fainter = replace(finisher, schedule=replace(schedule, faint=7.0))
    fainter.finish(objective.with_changes(prior=prior), Progress(Candidates(state, 1), rate=rate), End.INTEGRATION)
    assert asked[1:] == [(change, True)]


@pytest.mark.parametrize(("gentle", "too_steep"), [(False, True), (True, False), (True, True)])
def test_an_object_that_is_steeper_than_its_gentle_slopes_is_integrated_as_astray(
    gentle, too_steep, explained, monkeypatch
):
    objective, state = explained
    told = []
    monkeypatch.setattr(
        finish, "integrate_aberrations", lambda *given, astray, **more: told.append(astray) or (state, 0)
    )
    monkeypatch.setattr(finish, "shows_gentle_slopes", lambda *given, faint: gentle)
    monkeypatch.setattr(finish, "is_too_steep", lambda *given: too_steep)
    ended(objective, state, Setting.of(objective), Schedule(), end=End.INTEGRATION)
    assert told == [gentle and too_steep]


def test_a_prior_is_adapted_to_an_object_that_is_settled_under_itself(explained, monkeypatch):
    """Never to one that was settled under an adapted prior, whose edges are sharper already."""
    objective, state = explained
    asked, settled = [], []
    adapted_to, settle = SmoothVariation.adapted_to, finish.settle

    def adapt(self, image, reach):
        asked.append((self, image))
        return adapted_to(self, image, reach)

    def look(objective, state, n_iterations):
        found = settle(objective, state, n_iterations)
        settled.append((objective.prior, found.image, n_iterations))
        return found

    monkeypatch.setattr(SmoothVariation, "adapted_to", adapt)
    monkeypatch.setattr(finish, "settle", look)
    schedule = Schedule(segment=4, last_segments=2, last_gain=0.0, last_settling=5, lost=math.inf)
    found, _ = ended(objective, state, Setting.of(objective), schedule)
    assert isinstance(found.prior, AdaptedVariation)
    plain = [(prior, image) for prior, image, _ in settled if not isinstance(prior, AdaptedVariation)]
    assert len(plain) == 3  # before two segments and after them
    for prior, image in plain:
        assert any(one is prior and other is image for one, other in asked)
    assert {n_iterations for *_, n_iterations in settled} == {5}


@pytest.mark.parametrize(("each", "adapts"), [(4.9, False), (5.0, True)])
def test_priors_of_faint_frames_are_not_adapted(each, adapts, explained):
    """They show too little of the object, even where the aberrations are known."""
    objective, state = explained
    schedule = Schedule(segment=2, last_segments=1, lost=math.inf, **BRIEF)
    assert schedule.faint == 5.0
    found, _ = ended(objective, state, Setting.of(objective), schedule, change=Change(each, 10, 4096))
    assert isinstance(found.prior, AdaptedVariation) is adapts


def test_nothing_follows_the_search_of_a_schedule_without_last_segments(observe, five_holes):
    assert End.of(math.inf, TRAITS, Schedule(), BLIND) is End.LAST_DESCENT
    assert End.of(10.0, TRAITS, Schedule(last_segments=0), BLIND) is End.NONE
    assert End.of(math.inf, TRAITS, Schedule.plain(), BLIND) is End.NONE
    seen, stages = observe(n_frames=2, shape=(32, 32)), []
    schedule = Schedule(start_iterations=10, segment=10, last_segments=0, chance=math.inf, faint=0.0)
    method = MyopicDeconvolution(five_holes, seen.grid, readout_noise=1.5, schedule=schedule)
    result = method.restore(seen.frames, callback=lambda record: stages.append(record.stage))
    assert stages == 10 * ["restoration"]
    assert "TotalVariation" in result.prior


def found_rate(objective, state, change, *, faint, full):
    """The rate of slopes that are gentle."""
    return rate_of_descent(rate_of_slopes(state.image), full=full)


def test_the_priors_of_the_last_descent():
    """One that is heavier by the rate, up to three times; else from the given one down to the rate."""
    prior = TotalVariation(2.0, 0.3)
    for rate, weight in [(1.5, 3.0), (2.9, 5.8), (3.1, 6.0)]:
        (heavier,) = prior.choices(rate)
        assert isinstance(heavier, SmoothVariation)
        assert (heavier.weight, heavier.bending, heavier.epsilon) == pytest.approx((weight, 0.25, 0.3), rel=1e-9)
    every = [2.0, 1.26, 0.8, 0.5, 0.32, 0.2, 0.126, 0.08, 0.05]
    for rate, weights in [(0.97, every[:1]), (0.5, every[:2]), (0.2, every[:4]), (0.01, every), (0.0, every[:1])]:
        lighter = prior.choices(rate)
        assert [choice.weight for choice in lighter] == pytest.approx(weights, rel=1e-9)
        assert {(type(choice), choice.bending, choice.epsilon) for choice in lighter} == {(SmoothVariation, 0.1, 0.3)}
    for own in (heavier, EdgePreserving()):
        assert own.choices(1.5) == own.family(1.5) == (own,)


def test_the_priors_for_known_aberrations():
    """Lighter ones than the given, with its epsilon, and for a rate above 1 heavier ones too, with more on bends."""
    family = TotalVariation(2.0, 0.3).family(1.01)
    weights = [12.6, 8.0, 5.0, 3.2, 2.0, 1.26, 0.8, 0.5, 0.32, 0.2, 0.126, 0.08, 0.05]
    assert [prior.weight for prior in family] == pytest.approx(weights, rel=1e-9)
    assert {(type(prior), prior.bending, prior.epsilon) for prior in family} == {(SmoothVariation, 0.25, 0.3)}
    lighter = TotalVariation(2.0, 0.3).family(0.99)
    assert [prior.weight for prior in lighter] == pytest.approx(weights[4:], rel=1e-9)
    assert {prior.bending for prior in lighter} == {0.1}


@pytest.mark.parametrize("full", [False, True])
def test_gentle_slopes_ask_for_a_heavier_prior_in_a_last_descent(full):
    """Three times the weight that suits them, up to 2 or 3 times the given one, but never less than what suits them."""
    most = 3.0 if full else 2.0
    rates = (0.0, 0.1, 0.33, 0.34, 0.6, 0.99, 1.5, 2.5, 3.5)
    expected = [0.0, 0.1, 0.33, 1.02, 1.8, min(2.97, most), most, max(2.5, most), 3.5]
    assert [rate_of_descent(rate, full=full) for rate in rates] == pytest.approx(expected, rel=1e-12)


def test_the_frames_choose_the_prior_of_each_segment_and_of_the_end(explained, five_holes, monkeypatch):
    """They are asked with the object at hand, in finer modes; those of full pupils or before integrations are not."""
    objective, state = explained
    asked = []

    def choose(objective, state, priors, n_iterations):
        asked.append((float(state.image.max()), len(priors), n_iterations, objective.model.aberrations.n_modes))
        return priors[len(asked)]

    def descend(objective, state, *rest):
        for cost in (3.0, 2.0, 1.0):
            rest[2](cost, 1, lambda: None)
        return replace(state, image=1.5 * state.image)

    monkeypatch.setattr(finish, "choose_prior", choose)
    monkeypatch.setattr(finish, "rate_at_end", found_rate)
    monkeypatch.setattr(finish, "descend", descend)
    monkeypatch.setattr(finish, "recalibrate", lambda objective, state, power, **more: state)
    monkeypatch.setattr(finish, "settle", lambda objective, state, n_iterations: state)
    begun = replace(state, image=state.image * rate_of_slopes(state.image) / 0.05)
    schedule = Schedule(segment=1, last_segments=2, last_gain=0.0, lost=math.inf, comparing=7)
    setting = Setting.of(objective, finer=lambda: basis_of(five_holes, 8))
    found, _ = ended(objective, begun, setting, schedule)
    peak = float(begun.image.max())
    assert asked == [(pytest.approx(peak * 1.5**number), 7 + number, 7, 8) for number in range(3)]
    assert found.prior.weight == pytest.approx(0.25)
    monkeypatch.setattr(finish, "choose_prior", None)
    monkeypatch.setattr(finish, "_chi_square", lambda *given: 1.0)
    of_a_full_pupil, _ = ended(objective, begun, setting, schedule, traits=FULL_PUPIL, end=End.FULL_PUPIL)
    assert of_a_full_pupil.prior.weight == 1.0
    monkeypatch.setattr(finish, "integrate_aberrations", lambda given, state, *rest, **more: (state, 0))
    ended(objective, begun, setting, schedule, end=End.BOTH)


@pytest.mark.parametrize(("end", "expected"), [(End.LAST_DESCENT, 6 * [0.9]), (End.BOTH, 3 * [0.5])])
def test_the_last_descent_has_the_prior_of_the_object_that_the_search_has_found(end, expected, explained, monkeypatch):
    """It is heavier than that of its slopes, whatever these become under it; an integration has that of its own.

    Where the descent's is adapted, to an object that is settled under it, each segment and the end begin with that.
    """
    objective, state = explained
    weights = []

    def descend(objective, state, *rest):
        weights.append(objective.prior.weight)
        for cost in (3.0, 2.0, 1.0):
            rest[2](cost, 1, lambda: None)
        return replace(state, image=state.image / 1.5)

    def settle(objective, state, n_iterations):
        weights.append(objective.prior.weight)
        return state

    monkeypatch.setattr(finish, "descend", descend)
    monkeypatch.setattr(finish, "settle", settle)
    monkeypatch.setattr(finish, "recalibrate", lambda objective, state, power, **more: state)
    monkeypatch.setattr(finish, "rate_at_end", found_rate)
    objective = objective.with_changes(prior=TotalVariation(0.5))
    begun = replace(state, image=state.image * rate_of_slopes(state.image) / 0.6)  # and 0.9 and 1.35 later
    schedule = Schedule(segment=1, last_segments=2, last_gain=0.0, lost=math.inf)
    integrated = []

    def integrate(given, state, *rest, **more):
        integrated.append(given.prior)
        return state, 100

    monkeypatch.setattr(finish, "integrate_aberrations", integrate)
    found, progress = ended(objective, begun, Setting.of(objective), schedule, end=end)
    assert weights == pytest.approx(expected, rel=1e-9)
    assert integrated == ([found.prior] if end.integrates else [])
    assert found.prior.weight == pytest.approx(0.675 if end.integrates else 0.9, rel=1e-9)
    assert isinstance(found.prior, SmoothVariation)
    assert progress.n_evaluations == 6 + 100 * end.integrates
    weights.clear()
    interrupted = replace(begun, image=begun.image / 2)
    ended(objective, begun, Setting.of(objective), schedule, end=end, finer=interrupted)
    assert weights == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("end", [End.INTEGRATION, End.BOTH])
@pytest.mark.parametrize(("squares", "expected"), [(0.99, 2.0), (1.01, 0.8)])
def test_gentle_slopes_are_held_in_an_integration(squares, expected, end, explained, monkeypatch):
    """In as much light as `ended` says, unless the frames tell a rate below 0.5 by two errors, whatever is found."""
    objective, state = explained
    monkeypatch.setattr(finish, "descend", lambda objective, state, *rest: state)
    monkeypatch.setattr(finish, "settle", lambda objective, state, n_iterations: state)
    monkeypatch.setattr(finish, "recalibrate", lambda objective, state, power, **more: state)
    monkeypatch.setattr(finish, "integrate_aberrations", lambda given, state, *rest, **more: (state, 0))
    begun = replace(state, image=state.image * rate_of_slopes(state.image) / 0.8)
    total = float(torch.hypot(*gradient(begun.image)).sum())
    power = Power(squares * 3 * total / 0.5 * math.exp(2 * 0.3), 0.3)
    monkeypatch.setattr(spectrum, "power_of_slopes", lambda objective, state: power)
    found, _ = ended(objective, begun, Setting.of(objective), Schedule(lost=math.inf), end=end)
    assert found.prior.weight == pytest.approx(expected * objective.prior.weight, rel=1e-9)


def test_a_result_holds_the_modes_of_the_search(observe, five_holes):
    """By default, and it can be continued."""
    seen = observe(n_frames=2, shape=(32, 32))
    options = {"start_iterations": 20, "segment": 10, "last_segments": 1, "last_modes": 8, "chance": math.inf}
    schedule = Schedule(**options, **BRIEF, faint=0.0)
    method = MyopicDeconvolution(five_holes, seen.grid, readout_noise=1.5, schedule=schedule)
    stages = []
    result = method.restore(seen.frames, callback=lambda record: stages.append(record.stage))
    assert stages == 20 * ["restoration"] + 10 * ["last descent"]
    assert result.coefficients.shape == (2, 5, method.n_modes) == (2, 5, 6)
    assert "AdaptedVariation" in result.prior
    assert method.restore(seen.frames, start=result).coefficients.shape == (2, 5, 6)
    known = method.restore(seen.frames, coefficients=result.coefficients)
    assert "AdaptedVariation" in known.prior


@pytest.mark.parametrize("traits", [TRAITS, FULL_PUPIL])
def test_known_aberrations_keep_one_prior_that_the_frames_choose(traits, explained, monkeypatch):
    """It is chosen of the whole family for the object of the search, and no phases are retrieved."""
    objective, state = explained
    asked, used = [], []
    monkeypatch.setattr(finish, "retrieve_lost_frames", None)
    monkeypatch.setattr(finish, "recalibrate", lambda objective, state, power, **more: state)

    def choose(objective, state, priors, n_iterations):
        asked.append((state, [prior.weight for prior in priors], n_iterations))
        return priors[0]

    def descend(objective, state, *rest):
        used.append(objective.prior.weight)
        for cost in (3.0, 2.0, 1.0):
            rest[2](cost, 1, lambda: None)
        return replace(state, image=0.5 * state.image)

    monkeypatch.setattr(finish, "choose_prior", choose)
    monkeypatch.setattr(finish, "descend", descend)
    objective = objective.with_changes(prior=TotalVariation(0.5), free=Free.OBJECT)
    schedule = Schedule(segment=1, last_segments=3, last_gain=0.0, last_gain_full=0.0, last_settling=7, comparing=3)
    found, progress = ended(objective, state, Setting.of(objective), schedule, end=End.OBJECT, traits=traits)
    rate = rate_of_descent(rate_of_slopes(state.image), full=traits.many_minima)
    assert asked == [(state, [prior.weight for prior in objective.prior.family(rate)], 7)]
    assert used == 3 * [found.prior.weight] == 3 * [asked[0][1][0]]
    assert torch.equal(progress.state.z, state.z)
    assert not torch.equal(progress.state.image, state.image)


def test_one_frame_of_known_aberrations_keeps_the_weight_as_given(explain, monkeypatch):
    objective, state = explain(n_frames=1)
    monkeypatch.setattr(finish, "choose_prior", None)
    objective = objective.with_changes(prior=TotalVariation(0.5), free=Free.OBJECT)
    found, _ = ended(objective, state, Setting.of(objective), Schedule(segment=2, last_segments=1), end=End.OBJECT)
    assert isinstance(found.prior, SmoothVariation)
    assert found.prior.weight == 0.5


def test_an_interrupted_descent_of_known_aberrations_goes_on(observe, five_holes, tmp_path):
    seen = observe(n_frames=4, shape=(32, 32))
    schedule = Schedule(start_iterations=10, segment=5, last_segments=3, last_gain=0.0, **BRIEF)
    method = MyopicDeconvolution(five_holes, seen.grid, 3, readout_noise=1.5, schedule=schedule)
    told = {"coefficients": torch.zeros(4, 5, 3, dtype=torch.float64)}
    whole = method.restore(seen.frames, **told)
    interrupt_last_descent(method, seen.frames, path := tmp_path / "known.npz", 7, **told)
    again = method.restore(seen.frames, checkpoint=path, **told)
    assert again.prior == whole.prior
    assert torch.equal(again.object, whole.object)
    assert torch.equal(again.coefficients, told["coefficients"])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the fringes of the frames are not those")  # few frames of a large object
@pytest.mark.parametrize(("what", "sky"), [("ball", 0.0), ("satellite", 0.5)])
def test_the_prior_that_frames_choose_is_better_than_the_given_one_for_known_aberrations(what, sky, five_holes):
    """In four cases each the errors are 0.70 to 0.81 and 0.55 to 0.76 of those under the given one.

    The second has a sky, and a part of its pixels is dead.
    """
    rows, columns = torch.meshgrid(torch.arange(-16.0, 16.0), torch.arange(-16.0, 16.0), indexing="ij")
    ball = (1 - (rows**2 + columns**2) / 64).clamp(min=0).sqrt().double()
    scene, photons = (ball, 1e6) if what == "ball" else (make_scene(GRID.shape, 1.0, SceneOptions(size=0.5)), 2e3)
    light = photons * scene / scene.sum()
    model = ExposureModel(five_holes, GRID, basis_of(five_holes, 3))
    generator = torch.Generator().manual_seed(0)
    z = torch.randn(6, model.aberrations.n_parameters, generator=generator, dtype=torch.float64)
    coefficients = model.aberrations.coefficients(z)
    frames = torch.poisson(sky + model(model.window.embed(light), z).clamp(min=0), generator=generator)
    valid = torch.ones(GRID.shape, dtype=torch.bool)
    if sky:
        valid[10:14, 12:18], valid[::7, ::5] = False, False

    def error(schedule):
        method = MyopicDeconvolution(five_holes, GRID, 3, readout_noise=0.0, schedule=schedule)
        found = method.restore(frames, coefficients=coefficients, valid=valid)
        return relative_error(found.object, light, GRID.cutoff(1.0))

    assert error(Schedule()) < 0.9 * error(Schedule(last_segments=0))


def interrupt_last_descent(method, frames, path, step, **told):
    """Leave the checkpoint of a restoration that is interrupted at this step of its last descent."""

    def interrupt(record):
        if (record.stage, record.step) == ("last descent", step):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.restore(frames, checkpoint=path, callback=interrupt, **told)


def test_an_interrupted_last_descent_goes_on(observe, five_holes, tmp_path):
    """After its first segment; what has ended is not done again."""
    seen = observe(n_frames=2, shape=(32, 32))
    options = {"start_iterations": 20, "segment": 10, "last_modes": 8, "chance": math.inf, "faint": 0.0}
    schedule = Schedule(**options, **BRIEF, last_segments=3, last_gain=0.0)
    method = MyopicDeconvolution(five_holes, seen.grid, readout_noise=1.5, schedule=schedule)
    whole = method.restore(seen.frames)
    interrupt_last_descent(method, seen.frames, path := tmp_path / "state.npz", 15)
    records = []
    for n_left in (20, 0):
        resumed = method.restore(seen.frames, checkpoint=path, callback=records.append)
        assert [(record.stage, record.step) for record in records] == [
            ("last descent", 30 - n_left + 1 + i) for i in range(n_left)
        ]
        assert torch.equal(resumed.object, whole.object)
        assert torch.equal(resumed.coefficients, whole.coefficients)
        assert resumed.n_evaluations == whole.n_evaluations
        records.clear()


@pytest.mark.parametrize(
    ("change", "calls"),
    [
        ({}, [4, 8, 12]),  # after each segment until none are found
        ({"last_segments": 3}, [4, 8]),  # or none follows
        ({"found": 0}, [4]),
        ({"found": 0, "last_gain": 0.0}, [4]),  # not again either
        ({"aperture": FullAperture(1.0)}, []),  # which has rounds of its own
        ({"wavelengths": (550e-9, 600e-9)}, []),  # a field of one wavelength is no start for two
        ({"n_frames": 1}, []),  # the object of one frame is no help for its phases
    ],
)
def test_lost_frames_are_looked_for_between_segments(change, calls, observe, five_holes, tmp_path, monkeypatch):
    """What is found is worth another segment, the object is moved and settled for it, and the message says so.

    An interrupted restoration goes on as if it had not been interrupted.
    """
    seen = observe(change.get("aperture", five_holes), n_frames=change.get("n_frames", 2), shape=(32, 32))
    records, tried, calls_of, n_found = [], [], [], change.get("found", 2)

    def stand_in(objective, state, seed, schedule, minimizer):
        tried.append(sum(record.stage == "last descent" for record in records))
        return (replace(state, z=1.01 * state.z) if seed < n_found else state), 1000  # seeds count up from 0

    def look(objective, *given, name, made):
        calls_of.append(name)
        under.setdefault(name, set()).add(type(objective.prior))
        return made(objective, *given)

    under = {}
    for name in ("centre_on_pixels", "settle"):
        monkeypatch.setattr(finish, name, functools.partial(look, name=name, made=getattr(finish, name)))
    monkeypatch.setattr(finish, "retrieve_lost_frames", stand_in)
    monkeypatch.setattr(myopic, "FULL_MODES", 10)
    options = {"start_iterations": 8, "segment": 4, "last_modes": 8, "chance": math.inf, "faint": 0.0, "retrievals": 0}
    options |= {
        "last_segments": change.get("last_segments", 4),
        "last_gain": change.get("last_gain", 1.0),
        "last_gain_full": 1.0,
        "last_modes_full": 15,
    }
    options |= {"averaged": 1, "candidates": (), **BRIEF}
    given = {"wavelengths": change["wavelengths"]} if "wavelengths" in change else {}
    method = MyopicDeconvolution(
        seen.aperture, seen.grid, readout_noise=1.5, schedule=Schedule(**options), tolerance=0.0, **given
    )
    whole = method.restore(seen.frames, callback=records.append)
    assert tried == calls
    assert 1000 * len(calls) < whole.n_evaluations < 1000 * len(calls) + 1000
    n_segments = sum(record.stage == "last descent" for record in records) // 4
    if not seen.aperture.is_full:  # its prior is adapted to an object settled before each segment, and at the end
        moved = [["centre_on_pixels", "settle"]] * (n_found * bool(calls)) + [[]] * n_segments
        adapted = [name for number in range(n_segments) for name in ["settle", *moved[number]]]
        integrated = "integrated" in whole.message  # one frame counts as noisy, whose descent has no adapted prior
        assert integrated is (seen.frames.shape[0] == 1)
        assert calls_of == (["settle"] if integrated else [*adapted, "settle", "settle"])
    # a prior that is adapted to an object would keep it from moving
    assert under.get("centre_on_pixels", set()) <= {SmoothVariation}
    assert ("phases were retrieved" in whole.message) is (len(calls) > 1)
    if sum(record.stage == "last descent" for record in records) > 6:
        interrupt_last_descent(method, seen.frames, path := tmp_path / "state.npz", 6)
        resumed = method.restore(seen.frames, checkpoint=path)
        assert torch.equal(resumed.object, whole.object)
        assert (resumed.n_evaluations, resumed.message) == (whole.n_evaluations, whole.message)


@pytest.mark.parametrize(("traits", "calls"), [(TRAITS, 1), (replace(TRAITS, estimated=True), 0)])
def test_what_a_sensor_has_measured_is_not_retrieved(traits, calls, explained, monkeypatch):
    """Random phases would be drawn around zero."""
    seen = []
    monkeypatch.setattr(
        finish, "retrieve_lost_frames", lambda objective, state, *given: seen.append(state) or (state, 0)
    )
    objective, state = explained
    schedule = Schedule(segment=2, last_segments=2, last_gain=0.0, **BRIEF)
    ended(objective, state, Setting.of(objective), schedule, traits=traits)
    assert len(seen) == calls


def test_a_search_that_is_cut_short_has_an_end_once_a_start_was_whole(observe, five_holes, tmp_path):
    """And leaves a file from which the search goes on if it may have more iterations."""
    seen = observe(n_frames=2, shape=(32, 32))
    missed = {"chance": -1e9, "starts": 3, "faint": 0.0, "glance": 10**6, "escapes": 0}
    brief = {"start_iterations": 20, "segment": 10, "sharp_after": 15, "last_segments": 1, "last_modes": 8} | BRIEF
    schedule = Schedule(**brief, **missed)

    def restore(max_iterations, checkpoint=None):
        stages = []
        method = MyopicDeconvolution(
            five_holes, seen.grid, readout_noise=1.5, max_iterations=max_iterations, schedule=schedule
        )
        result = method.restore(seen.frames, checkpoint=checkpoint, callback=lambda record: stages.append(record.stage))
        return result, stages

    result, stages = restore(10)
    assert stages == 10 * ["restoration"]  # what is asked for, and no more
    assert "max_iterations = 10" in result.message
    path = tmp_path / "state.npz"
    result, stages = restore(30, path)
    assert stages == 30 * ["restoration"] + 10 * ["last descent"]
    assert "best of 2 starts" in result.message
    again, stages = restore(30, path)
    assert stages == 10 * ["last descent"]
    assert torch.equal(again.object, result.object)
    longer, stages = restore(60, path)
    assert stages == 30 * ["restoration"] + 10 * ["last descent"]
    assert torch.equal(longer.cost[:30], result.cost)
    start = longer.cost[20:40]  # the second, cut in two
    assert float(start[10]) < float(start[9])


def test_a_search_need_not_come_to_rest_if_a_last_descent_follows(observe, five_holes):
    """If it explains the frames; without a last descent, or with the limit at 0, it goes on."""
    seen = observe(n_frames=2, shape=(32, 32))
    options = {"start_iterations": 40, "segment": 10, "sharp_after": 10, "escapes": 0, "last_modes": 8, "faint": 0.0}
    options |= BRIEF

    def iterations(**changes):
        schedule = Schedule(**options, **changes, chance=math.inf)
        method = MyopicDeconvolution(five_holes, seen.grid, readout_noise=1.5, tolerance=0.0, schedule=schedule)
        return len(method.restore(seen.frames).cost)

    assert iterations(nearly_at_rest=math.inf, last_segments=1) == 10
    assert iterations(nearly_at_rest=0.0, last_segments=1) > 10
    assert iterations(nearly_at_rest=math.inf, last_segments=0) > 10


# --- what follows the search of a full pupil


@pytest.mark.parametrize(
    ("change", "end"),
    [
        ({}, End.FULL_PUPIL),
        ({"schedule": Schedule(retrievals=0)}, End.FULL_PUPIL),
        ({"schedule": Schedule(last_segments=0)}, End.NONE),
        ({"schedule": Schedule.plain()}, End.NONE),
        ({"free": Free.OBJECT}, End.OBJECT),
        ({"free": Free.OBJECT, "schedule": Schedule.plain()}, End.NONE),
        ({"free": Free.ABERRATIONS}, End.NONE),
        ({"band": Band.of([500e-9, 600e-9])}, End.FULL_PUPIL),
        ({"prior_on_aberrations": False}, End.NONE),
        ({"estimated": True}, End.NONE),
    ],
)
def test_more_follows_the_search_of_a_full_pupil_where_its_aberrations_are_sought(change, end):
    """With the prior of turbulence."""
    grid = Grid.nyquist(1.0, 500e-9, 16)
    model = ExposureModel(FullAperture(1.0), grid, 3, change.get("band"))
    frames = 8 * torch.randn(2, 16, 16, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    frames[:, 6:10, 6:10] += 1000
    free = change.get("free", Free.OBJECT | Free.ABERRATIONS)
    stack = FrameStack.of(frames, None, grid, FullAperture(1.0), None, Background.NONE)
    objective = MyopicObjective(model, stack.frames, stack.precision, TotalVariation(), free=free)
    said = {name: change[name] for name in ("prior_on_aberrations", "estimated") if name in change}
    traits = replace(FULL_PUPIL, **said)
    assert Solver(objective, stack, traits, change.get("schedule", Schedule()), ProjectedLBFGS()).end is end


def frames_of_a_full_pupil(explain, n_modes=6, band=None, **given):
    model = ExposureModel(FullAperture(1.0), GRID, basis_of(FullAperture(1.0), n_modes), band)
    return explain(model, **given)


def test_a_full_pupil_has_as_many_modes_in_its_last_descent_as_the_schedule_says(five_holes):
    schedule = Schedule(last_modes=8, last_modes_full=300)
    for aperture, n_modes, most in ((FullAperture(1.0), None, 300), (five_holes, None, 8), (FullAperture(1.0), 231, 0)):
        method = MyopicDeconvolution(aperture, GRID, n_modes, schedule=schedule)
        assert method.recipe.last_modes == most


@pytest.mark.parametrize(("traits", "power"), [(TRAITS, 1), (FULL_PUPIL, 2)])
def test_frames_of_a_full_pupil_that_fit_badly_count_less(traits, power, explained, monkeypatch):
    """More so than those of a mask, unless the aberrations are known; then they do as the prior is chosen too."""
    objective, state = explained
    given, schedule = [], Schedule(segment=2, last_segments=1, **BRIEF)
    monkeypatch.setattr(finish, "recalibrate", lambda objective, state, power, **more: given.append(power) or state)
    ended(objective, state, Setting.of(objective), schedule, traits=traits)
    assert given == [power]
    known = objective.with_changes(free=Free.OBJECT)
    ended(known, state, Setting.of(known), schedule, traits=traits, end=End.OBJECT)
    assert given == [power, 1, 1]


@pytest.mark.parametrize(
    ("traits", "end", "kept"),
    [(TRAITS, End.LAST_DESCENT, True), (FULL_PUPIL, End.FULL_PUPIL, False), (FULL_PUPIL, End.OBJECT, True)],
)
def test_a_last_descent_that_loses_frames_of_a_full_pupil_is_not_kept(traits, end, kept, explained):
    """Unless its aberrations are known, so that none can be lost."""
    objective, state = explained

    def loses(cost, start, lower, *, max_iterations, callback):
        """A minimiser that brings object and aberrations to zero."""
        return Minimum(torch.zeros_like(start), 1.0, 1, 1, False, "says so")

    schedule = Schedule(segment=2, last_segments=1, **BRIEF)
    found, progress = ended(objective, state, Setting.of(objective), schedule, minimizer=loses, traits=traits, end=end)
    assert (progress.state is state) is not kept
    assert (found is objective) is not kept


@pytest.mark.parametrize(("rise", "kept"), [(0.9, True), (1.1, False)])
def test_a_last_descent_of_a_full_pupil_may_leave_more_noise_by_chance(rise, kept, explained, monkeypatch):
    """A mean of n squares of unit normal deviates has the standard error (2 / n)^0.5; two of them may be chance."""
    objective, state = explained
    change = Change(each=100.0, n_frames=4, n_pixels=800.0)
    found = iter([1.5 + rise * 2 * math.sqrt(2 / 3200), 1.5])
    monkeypatch.setattr(finish, "_chi_square", lambda *given: next(found))
    schedule = Schedule(segment=2, last_segments=1)
    setting = Setting.of(objective)
    _, progress = ended(objective, state, setting, schedule, traits=FULL_PUPIL, end=End.FULL_PUPIL, change=change)
    assert (progress.state is not state) is kept


def test_the_object_of_a_full_pupil_is_settled_before_each_segment(explain):
    """A descent in object and aberrations leaves what the pupil hardly passes, which makes most of the error.

    Of an object whose finest structure is missing, a segment of a few iterations returns less than a settled one.
    """
    objective, state = frames_of_a_full_pupil(explain, noise=1e-4)
    fine = torch.fft.rfft2(state.image)
    rows, columns = torch.fft.fftfreq(len(fine)), torch.fft.rfftfreq(state.image.shape[1])
    fine *= torch.hypot(rows[:, None], columns) < 0.7 * objective.model.cutoff
    begun = replace(state, image=torch.fft.irfft2(fine, s=state.image.shape).clamp(min=0))
    schedule, setting = Schedule(segment=4, last_segments=1, last_settling=200, retrievals=0), Setting.of(objective)

    def lost(traits):
        """Error before the object is settled once more at the end."""
        _, progress = ended(objective, begun, setting, schedule, end=End.FULL_PUPIL, traits=traits)
        return relative_error(progress.finer.image, state.image, objective.model.cutoff)

    assert lost(FULL_PUPIL) < 0.5 * lost(TRAITS)


@pytest.mark.parametrize(("retrievals", "said"), [(0, "the mean object of 3 starts"), (1, "phases were retrieved")])
def test_an_interrupted_last_descent_of_a_full_pupil_goes_on(retrievals, said, observe, tmp_path, monkeypatch):
    """Neither are starts averaged again, nor phases retrieved, and the message tells what was done."""
    seen = observe(FullAperture(1.0), n_frames=3, r0=0.5)
    monkeypatch.setattr(myopic, "FULL_MODES", 10)
    options = {"candidates": ((2, 4),), "segment": 4, "sharp_after": 4, "escapes": 0, "start_iterations": 8}
    options |= {"chance": 1e9, "last_segments": 3, "last_gain_full": 0.0, "reflections_full": 2, "retrieved_from": 0.0}
    options |= {"retrievals": retrievals, "retrieved_gain": math.inf, "retrieved_iterations": 4}
    schedule = Schedule(**options, **BRIEF, last_modes_full=15)
    method = MyopicDeconvolution(FullAperture(1.0), seen.grid, readout_noise=1.5, tolerance=0, schedule=schedule)
    whole = method.restore(seen.frames)
    assert said in whole.message
    interrupt_last_descent(method, seen.frames, path := tmp_path / "state.npz", 6)
    records = []
    resumed = method.restore(seen.frames, checkpoint=path, callback=records.append)
    assert [(record.stage, record.step) for record in records] == [("last descent", 5 + i) for i in range(8)]
    assert torch.equal(resumed.object, whole.object)
    assert torch.equal(resumed.coefficients, whole.coefficients)
    assert (resumed.n_evaluations, resumed.message) == (whole.n_evaluations, whole.message)
