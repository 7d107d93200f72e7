"""Phases of frames, retrieved for a sharp object where descents end in poor minima."""

import math
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.band import Band
from torchmask.restoration import frame_retrieval, reflections, retrieval, solver
from torchmask.restoration.aberrations import AberrationBasis, turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.calibration import calibrate, unwrap_pistons
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.descent import descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frame_retrieval import Trial, parameters_of_fields, retrieve_frames
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.reflections import LAST, STEPS, Retrieved, retrieve_fields
from torchmask.restoration.retrieval import retrieve_lost_frames, retrieve_phases
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.traits import Refinement, Traits
from torchmask.restoration.variation import TotalVariation

PUPIL, GRID, MODES, NOISE = FullAperture(1.0), Grid.nyquist(1.0, 550e-9, 32), 21, 0.01


def problem(n_frames, rms=0.4, seed=0, background=Background.NONE, noise=NOISE):
    """An objective without a prior on the aberrations, and the state that made its frames of a resolved object."""
    generator = torch.Generator().manual_seed(seed)
    model = ExposureModel(PUPIL, GRID, MODES, background=background)
    image = torch.zeros(model.window.field.shape, dtype=torch.float64)
    image[12:20, 10:14], image[8:11, 18:22] = 1, 2
    image *= 1024 / image.sum()
    z = rms * torch.randn(n_frames, MODES, generator=generator, dtype=torch.float64)
    z[:, 0] = 0
    frames = model(image, z)
    frames = frames + noise * torch.randn(frames.shape, generator=generator, dtype=torch.float64)
    precision = torch.full((1, 1, 1), noise**-2, dtype=torch.float64)
    ones = torch.ones(n_frames, dtype=torch.float64)
    return MyopicObjective(model, frames, precision, TotalVariation()), State(image, z, Calibration(ones, ones, 0.0))


def fit_modes(objective, state, n_iterations):
    """The aberrations alone descend."""
    known_object = objective.with_changes(free=Free.ABERRATIONS)
    return descend(known_object, state, n_iterations, ProjectedLBFGS(), lambda *said: None)


def chi_squares(objective, state):
    return 2 * objective.frame_costs(state.image, state.z, state.calibration) / objective.frames[0].numel()


def lost(truth):
    """The state with two frames whose aberrations are those of others."""
    z = truth.z.clone()
    z[[0, 1]] = z[[1, 0]]
    return replace(truth, z=z)


class Script:
    """Stands in for the trials of frames: says what is found in each round, and keeps who was tried.

    `results` has for each round what becomes of all frames, of which only those that are tried count.
    """

    def __init__(self, monkeypatch, results):
        self.results, self.tried, self.seeds = results, [], []
        monkeypatch.setattr(retrieval, "retrieve_frames", self.try_frames)
        monkeypatch.setattr(retrieval, "_descend_together", lambda objective, state, *given, **more: state)

    def try_frames(self, objective, state, tried, n_reflections, seed, *given):
        self.seeds.append(seed)
        found = self.results[len(self.tried)]
        self.tried.append(tried.tolist())
        said = [found[number] for number in self.tried[-1]]
        spent = round(n_reflections * (STEPS + 2) / 2 * len(said) / len(state.z))
        state = replace(state) if YES in said else state
        return Trial(state, said.count(YES), torch.tensor([word == NO for word in said]), spent)


def left(truth, *excess):
    """The state whose frames leave this excess chi-square, whatever their aberrations."""
    return truth.calibrated(noise_inflation=1 + torch.tensor(excess, dtype=torch.float64))


NO, YES, AGAIN = "", "found", "again"


class Fitted(NamedTuple):
    """Random aberrations of 48 frames, how many reflections each was given, and the state fitted to its fields."""

    objective: MyopicObjective
    start: State
    spent: Tensor
    fitted: State

    @classmethod
    def after(cls, objective, start):
        """After 200 reflections at most."""
        fields, spent = retrieve_fields(objective, start, 200)
        z = parameters_of_fields(objective, fields, start.z)
        return cls(objective, start, spent, fit_modes(objective, replace(start, z=z), 100))

    @property
    def found(self):
        """Which frames are found: they have the chi-square of noise, 1 +- 0.05."""
        return chi_squares(self.objective, self.fitted) < 1.25


@pytest.fixture(scope="module")
def retrieved():
    objective, truth = problem(48)
    generator = torch.Generator().manual_seed(7)
    z = 0.4 * torch.randn(truth.z.shape, generator=generator, dtype=torch.float64)
    return Fitted.after(objective, replace(truth, z=z))


def test_reflections_find_most_frames_where_descents_stop(retrieved):
    """From the same random aberrations.

    Over other seeds more than half were found, and a quarter by descents. Of 48 frames, the difference of two numbers
    of equal chance has a standard deviation of at most sqrt(2 * 48 / 4) = 4.9, so twice that tells the two apart.
    """
    descended = fit_modes(retrieved.objective, retrieved.start, 400)
    number_before = int((chi_squares(retrieved.objective, descended) < 1.25).sum())
    assert int(retrieved.found.sum()) > number_before + 2 * 4.9


def test_reflections_of_a_frame_end_once_its_phases_are_found(retrieved, monkeypatch):
    """Those that end before are found as if they had gone on: of 13 frames one is found by one of the two ways only.

    Chance decides which, so the numbers of frames that one way finds and the other does not are alike: a difference of
    three standard deviations of their sum is none.
    """
    objective, start, spent, _ = retrieved
    fields, _ = retrieve_fields(objective, start, 104)
    monkeypatch.setattr(reflections, "_FALLEN", 0.0)
    without_end = Fitted.after(objective, start)
    fields_too, _ = retrieve_fields(objective, start, 104)
    found, found_too, whole = retrieved.found, without_end.found, without_end.spent
    assert whole.tolist() == [200] * 48
    ended = spent < 200
    assert int(ended.sum()) >= 5
    assert int(spent.min()) > 10 * (2 + 3 + 5)  # looks that it takes to tell
    gained, missed = (int((one & ~other & ended).sum()) for one, other in ((found, found_too), (found_too, found)))
    assert missed - gained <= 3 * math.sqrt(missed + gained)
    assert missed < 0.25 * int(ended.sum())
    # others go on as they would without them, but for rounding; fields of unlike frames differ by 1.4 of their size
    others = spent > 101
    assert 0 < int(others.sum()) < 48
    apart = (fields - fields_too).norm(dim=1) / fields_too.norm(dim=1)
    assert float(apart[others].max()) < 0.3


def test_a_single_frame_that_ends_leaves_none():
    """Its chi-square is that of noise, to four of its standard deviations."""
    objective, truth = problem(1, rms=0.3, seed=1)
    generator = torch.Generator().manual_seed(3)
    start = replace(truth, z=0.3 * torch.randn(truth.z.shape, generator=generator, dtype=torch.float64))
    fields, spent = retrieve_fields(objective, start, 400)
    assert 100 < int(spent) < 400
    fitted = fit_modes(objective, replace(start, z=parameters_of_fields(objective, fields, start.z)), 100)
    assert float(chi_squares(objective, fitted)) < 1 + 4 * math.sqrt(2 / objective.frames[0].numel())


def test_a_gap_has_fallen_if_it_is_far_below_what_it_was_and_falls_no_more():
    up, low = [1.0, 1.2, 0.9, 1.1], [0.5, 0.6, 0.6, 0.7, 0.6, 0.6]

    def has_fallen(*looks):
        return bool(reflections._has_fallen(torch.tensor([[3.0], [2.0], *([look] for look in looks)]))[0])

    assert has_fallen(*up, *low)
    assert not has_fallen(*up, *low[:-1])  # it may fall further
    assert not has_fallen(*up, *low[:3], 0.4, *low[3:])  # and does
    assert not has_fallen(*up, *(look + 0.2 for look in low))  # not far enough, by the median
    assert not has_fallen(*up[:2], *low, *low)  # too early to tell
    assert not has_fallen(*up, *up, *up)
    looks = torch.tensor([[3.0, 3.0], [2.0, 2.0], *([one, 1.0] for one in up + low)])
    assert reflections._has_fallen(looks).tolist() == [True, False]  # each frame by itself


@pytest.mark.parametrize("background", [Background.NONE, Background.PER_FRAME])
def test_the_true_field_stays(background):
    """Up to what noise does to a phase: a frame of 32^2 pixels with 1e4 of its deviations fixes 20 modes to 1e-2."""
    objective, truth = problem(3, rms=0.15, background=background)
    sky = 0.7 if background is Background.PER_FRAME else 0.0
    objective = MyopicObjective(objective.model, objective.frames + sky, objective.precision, TotalVariation())
    found = parameters_of_fields(objective, retrieve_fields(objective, truth, 5).fields, truth.z)
    fitted = fit_modes(objective, replace(truth, z=found), 20)
    torch.testing.assert_close(found[:, 1:], truth.z[:, 1:], rtol=0, atol=0.1)
    torch.testing.assert_close(chi_squares(objective, fitted), torch.ones(3).double(), rtol=0, atol=0.2)


def test_phases_of_several_waves_are_unwrapped_exactly():
    objective, state = problem(6, rms=0.12)
    samples = objective.model.pupil.samples()
    phase = samples.phase(state.z)
    assert float(phase.abs().max()) > 3.5  # wrapped: beyond pi
    found = parameters_of_fields(objective, samples.field(phase), torch.zeros_like(state.z))
    torch.testing.assert_close(found[:, 1:], state.z[:, 1:], rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_pistons_of_holes_are_found_but_for_whole_waves(dtype, noise, five_holes):
    """Differences of the phase do not show them. Under a prior that makes them large, rounding must not either.

    What is below 1e-5 of the largest singular value may be left, so the phase is known to that part of the largest.
    Noise of 0.3 rad on 20 or more samples of a hole moves six modes by 0.16 rad rms, so that fields agree to 0.01.
    """
    basis = turbulent_basis(five_holes, 6, 0, 0.15, 20.0)
    samples = (model := ExposureModel(five_holes, Grid.nyquist(1.0, 550e-9, 48), basis, dtype=dtype)).pupil.samples()
    generator = torch.Generator().manual_seed(5)
    z = torch.randn(40, basis.n_parameters, dtype=torch.float64, generator=generator)
    coefficients = basis.coefficients(z)
    largest = float(coefficients.abs().max())
    assert float(coefficients[..., 0].abs().max()) > 2 * math.pi  # whole waves
    frames, precision = torch.zeros(40, 48, 48, dtype=dtype), torch.ones(1, 1, 1, dtype=dtype)
    objective = MyopicObjective(model, frames, precision, TotalVariation())
    phase = samples.phase(z)
    rough = phase + noise * torch.randn(phase.shape, dtype=torch.float64, generator=generator).to(phase)
    found = parameters_of_fields(objective, samples.field(rough), torch.zeros_like(z))
    agreement = (samples.field(samples.phase(found)) * samples.field(phase).conj()).sum(1).abs()
    agreement = agreement / samples.weights.square().sum()
    assert float(agreement.min()) > 1 - 2e-5 * largest - noise**2 / 3
    if not noise:
        off = basis.coefficients(found) - coefficients
        torch.testing.assert_close(off[..., 1:], torch.zeros_like(off[..., 1:]), rtol=0, atol=1e-5 * largest)
        assert float(found.abs().max()) < 10 * float(z.abs().max())


def test_common_aberrations_stay_and_are_taken_off():
    objective, state = problem(4, rms=0.12)
    own = torch.eye(MODES, dtype=torch.float64)
    basis = AberrationBasis(torch.cat([own[:, 1:], own[:, 3:6]], dim=1), MODES, n_common=3)
    model = ExposureModel(PUPIL, GRID, basis)
    shared = torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)
    z = torch.cat([state.z[:, 1:], shared.expand(4, -1)], dim=1)
    objective = MyopicObjective(model, objective.frames, objective.precision, TotalVariation())
    samples = model.pupil.samples()
    start = torch.cat([torch.zeros_like(z[:, :20]), z[:, 20:]], dim=1)
    found = parameters_of_fields(objective, samples.field(samples.phase(z)), start)
    torch.testing.assert_close(found, z, rtol=0, atol=1e-10)


def test_the_phase_itself_is_fitted_in_the_end():
    """What no mode describes moves the modes as in a least-squares fit to the phase without its wraps."""
    objective, state = problem(4, rms=0.12)
    samples = objective.model.pupil.samples()
    noise = 0.3 * torch.randn(4, len(samples.index), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    found = parameters_of_fields(objective, samples.field(samples.phase(state.z) + noise), torch.zeros_like(state.z))
    weights = samples.weights[:, None]
    error = torch.linalg.lstsq(weights * samples.basis, weights * noise.T).solution.T
    torch.testing.assert_close((found - state.z)[:, 1:], error[:, 1:], rtol=0, atol=1e-6)


def test_the_intensity_fits_the_frame_and_stays_where_the_object_hides_it(monkeypatch):
    """Equation eq-intensity by dense linear algebra, in float64, for a field that is not the true one."""
    grid = Grid.nyquist(1.0, 550e-9, 12)
    model = ExposureModel(PUPIL, grid, 6)
    side, shape = model.window.field.shape[0], model.window.field.shape
    generator = torch.Generator().manual_seed(2)
    image = torch.rand(shape, generator=generator, dtype=torch.float64) * 144 / side**2
    frames = torch.rand(1, 12, 12, generator=generator, dtype=torch.float64) / 144
    precision = 1e4 * (1 + torch.rand(1, 12, 12, generator=generator, dtype=torch.float64))
    samples = model.pupil.samples()
    chunk = reflections._Frames(model, samples, model.spectrum(image), frames, precision)
    raster = model.raster(
        samples, samples.field(samples.phase(torch.randn(1, 6, generator=generator, dtype=torch.float64)))
    )
    monkeypatch.setattr(reflections, "STEPS", 2 * side**2)
    before = torch.rand(1, *shape, generator=generator, dtype=torch.float64)  # where it starts from makes no difference
    fitted, pull_found = chunk._fit_frames(raster, before)
    found = torch.fft.fft2(fitted).abs().square().flatten()

    focal = torch.fft.fft2(raster)
    q = focal.abs().square().flatten()
    shifts = torch.eye(side**2, dtype=torch.float64).unflatten(1, shape)
    imaged = chunk._imaged(shifts).flatten(1).T  # (pixels, samples of the PSF)
    weight = precision.flatten()[:, None]
    held = reflections._STIFFNESS / (2 * (q + reflections._DARK))
    pull = imaged.T @ (weight[:, 0] * (frames.flatten() - imaged @ q))
    change = torch.linalg.solve(imaged.T @ (weight * imaged) + held.diag(), pull)
    expected = (q + change).clamp(min=0)
    assert float((expected - q).norm()) > 0.01 * float(q.norm())  # it moves
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(pull_found.flatten(), held * change, rtol=1e-6, atol=1e-6 * float(pull.abs().max()))
    angle = torch.fft.fft2(fitted) / focal
    bright = expected.view_as(angle) > 1e-6
    torch.testing.assert_close(angle[bright].imag, torch.zeros_like(angle[bright].imag), rtol=0, atol=1e-9)


def test_a_field_is_that_at_the_wavelength_of_the_light(monkeypatch):
    """Aberrations are in rad at the wavelength of the grid. No correction is needed for exact fields."""
    monkeypatch.setattr(frame_retrieval, "_CORRECTIONS", 0)
    mask = SparseAperture([[0.12, 0.0], [0.4, 0.0], [-0.3, 0.2], [-0.25, -0.3]], 0.18, 1.0)
    basis = turbulent_basis(mask, 6, 0, 0.2, 20.0)
    model = ExposureModel(mask, Grid.nyquist(1.0, 550e-9, 48), basis, Band.of((900e-9,)))
    z = 0.5 * torch.randn(10, basis.n_parameters, dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    samples = model.pupil.samples()
    objective = MyopicObjective(model, torch.zeros(10, 48, 48).double(), torch.ones(1, 1, 1), TotalVariation())
    found = parameters_of_fields(objective, samples.field(samples.phase(z)), torch.zeros_like(z))
    agreement = (samples.field(samples.phase(found)) * samples.field(samples.phase(z)).conj()).sum(1).abs()
    torch.testing.assert_close(agreement / samples.weights.square().sum(), torch.ones(10).double(), rtol=0, atol=1e-6)


def test_pistons_come_near_to_their_prior_before_frames_are_compared(monkeypatch, explain):
    """A wave that no frame shows costs nothing, though the prior would count it, and no descent takes it off."""
    objective, truth = explain(n_frames=4, noise=0.1)
    begun, basis = calibrate(objective, lost(truth)), objective.model.aberrations
    waves = 2 * math.pi * torch.tensor([3.0, -3.0, 3.0, -3.0, 0.0], dtype=torch.float64)
    far = truth.z + basis.parameters_of_pistons(waves)
    monkeypatch.setattr(frame_retrieval, "parameters_of_fields", lambda part, fields, now: far)
    schedule = Schedule(retrieved_iterations=0)
    trial = retrieve_frames(objective, begun, torch.arange(4), 1, 0, schedule, ProjectedLBFGS())
    near = unwrap_pistons(objective, replace(truth, z=far)).z
    assert float(near.norm()) < 0.5 * float(far.norm())
    torch.testing.assert_close(trial.state.z[:2], near[:2], rtol=0, atol=1e-9)
    assert trial.n_found == 2


# --- frames that a descent through a mask has lost


def test_lost_frames_of_a_mask_are_found_at_once(explain):
    """All of them, by a hundred reflections; frames at the noise are not touched.

    The noise was taken to be as large in all frames, so a descent at the true one follows.
    """
    objective, truth = explain(n_frames=6, noise=0.1)
    begun = lost(truth)
    before = chi_squares(objective, begun)
    assert float(before[:2].min()) > 2
    state, n_evaluations = retrieve_lost_frames(objective, begun, 0, Schedule(), ProjectedLBFGS())
    after = calibrate(objective, fit_modes(objective, replace(state, calibration=truth.calibration), 60))
    assert float(after.calibration.noise_inflation.max()) < 1 + 4 * math.sqrt(2 / objective.frames[0].numel())
    assert torch.equal(state.z[2:], begun.z[2:])
    assert not bool((state.z[:2] == begun.z[:2]).any())
    assert state.calibration is begun.calibration  # which is nobody else's business
    reflections, descents = 2 / 6 * (100 + LAST) * (STEPS + 2) / 2, 2 / 6 * 60
    assert reflections + 2 / 6 <= n_evaluations <= reflections + 2 * descents


@pytest.mark.parametrize(
    ("results", "tried", "found"),
    [
        # the worst three first, and then the rest of those that leave more than noise
        ([(YES,) * 6, (YES,) * 6], [[4, 1, 2], [5, 0]], True),
        ([(NO, NO, NO, NO, NO, YES), (YES,) * 6], [[4, 1, 2]], False),
        ([(NO, YES, NO, NO, NO, NO), (NO,) * 6], [[4, 1, 2], [5, 0]], True),  # one may hold what no phases explain
        ([(AGAIN,) * 6], [[4, 1, 2]], False),
    ],
)
def test_the_worst_frames_are_tried_first(results, tried, found, monkeypatch, explain):
    """Where none of them is found the model lacks what the frames hold, so the others are spared."""
    objective, truth = explain(n_frames=6)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, results)
    begun = left(truth, 0.5, 3.0, 1.0, 0.0, 4.0, 0.9)
    state, n_evaluations = retrieve_lost_frames(objective, begun, 3, Schedule(reflections=60), ProjectedLBFGS())
    assert script.tried == tried
    assert script.seeds == [3] * len(tried)
    assert (state is begun) is not found
    assert n_evaluations == sum(map(len, tried)) / 6 * 60 * (STEPS + 2) / 2


def test_of_many_lost_frames_a_quarter_is_tried_first(monkeypatch, explain):
    objective, truth = explain(n_frames=16)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, [(NO,) * 16])
    retrieve_lost_frames(objective, left(truth, *range(1, 17)), 0, Schedule(), ProjectedLBFGS())
    assert script.tried == [[15, 14, 13, 12]]


@pytest.mark.parametrize(("limit", "tried"), [(0.05, [[1]]), (0.5, [])])
def test_frames_at_the_noise_are_not_lost(limit, tried, monkeypatch, explain):
    """Of 32 x 32 pixels three standard deviations are 0.13."""
    objective, truth = explain(n_frames=3)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, [(YES, YES, YES)] * 2)
    begun = left(truth, 0.12, 0.14, 0.0)
    retrieve_lost_frames(objective, begun, 0, Schedule(lost=limit), ProjectedLBFGS())
    assert script.tried == tried


# --- rounds

BRISK = {"reflections_full": 60, "retrieved_segments": 1, "segment": 40}
TRAITS = Traits(True, False, True, False, 0.2, 20.0, 1000, 0.0, 0, Refinement.OFF)


def retrieve(objective, state, **numbers):
    ended = Progress(Candidates(state, 1))
    retrieve_phases(objective, ended, TRAITS, Schedule(**BRISK | numbers), ProjectedLBFGS(), None)
    return ended


def test_lost_frames_are_found_and_the_others_stay():
    objective, truth = problem(5, rms=0.2, noise=0.1)
    before = chi_squares(objective, lost(truth)) - 1
    ended = retrieve(objective, lost(truth), reflections_full=200)
    after = chi_squares(objective, replace(ended.state, calibration=truth.calibration)) - 1
    assert ended.retrieved
    assert bool((after[:2] < 0.25 * before[:2]).all())
    assert float(after[2:].max()) < 0.2  # four deviations of 32^2 pixels
    assert ended.n_evaluations >= 2 / 5 * 100 * (STEPS + 2) / 2  # those of the reflections of two frames count


def test_what_does_not_gain_enough_is_not_kept():
    """The least fraction that is asked for cannot be reached."""
    objective, truth = problem(5, rms=0.2)
    start = lost(truth)
    ended = retrieve(objective, start, retrieved_gain=0.0, retrievals=2)
    assert not ended.retrieved
    assert ended.state is start


def test_frames_that_are_explained_are_left_alone(monkeypatch):
    objective, truth = problem(5, rms=0.2)
    monkeypatch.setattr(frame_retrieval, "retrieve_fields", lambda *given: pytest.fail("it was called"))
    ended = retrieve(objective, truth)
    assert not ended.retrieved
    assert ended.n_evaluations == 0


@pytest.mark.parametrize(
    ("results", "tried"),
    [
        # what is found, for the first time or again, is not tried any more
        ([(YES, NO, AGAIN, NO), (NO, YES, NO, NO), (NO, NO, NO, YES)], [[0, 1, 2, 3], [1, 3], [3]]),
        # rounds end once as many tries as there are frames were in vain since the last success
        ([(NO, NO, NO, NO)], [[0, 1, 2, 3]]),
        ([(YES, AGAIN, NO, NO), *2 * [(NO, NO, NO, NO)]], [[0, 1, 2, 3], [2, 3], [2, 3]]),
        ([(YES, AGAIN, NO, NO), (NO, NO, NO, NO), (NO, NO, NO, YES)], [[0, 1, 2, 3], [2, 3], [2, 3], *4 * [[2]]]),
        # frames that random phases lead back to where they were are no success, but need not be tried again
        ([(AGAIN, AGAIN, AGAIN, AGAIN)], [[0, 1, 2, 3]]),
    ],
)
def test_rounds_try_the_frames_that_have_not_been_found(results, tried, monkeypatch):
    objective, truth = problem(4, rms=0.2)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, [*results, *6 * [(NO, NO, NO, NO)]])
    retrieve(objective, left(truth, 3.0, 3.0, 3.0, 3.0), retrievals=8)
    assert script.tried == tried


def test_frames_that_fit_much_worse_than_most_are_tried_again(monkeypatch):
    """Though they have been found: what was found for them is another poor minimum."""
    objective, truth = problem(4, rms=0.2)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, [(YES, YES, YES, YES), (NO, YES, NO, NO), (NO, NO, NO, NO)])
    retrieve(objective, left(truth, 3.0, 7.5, 3.2, 3.1), retrievals=3)
    assert script.tried == [[0, 1, 2, 3], [1], [1]]


def test_a_frame_is_found_where_clearly_less_is_left_and_again_where_as_much_is(monkeypatch):
    """Frames at the truth come back to it; lost ones are found; ones whose trial fails are neither, and stay."""
    objective, truth = problem(4, rms=0.2, noise=0.1)
    start = calibrate(objective, lost(truth))
    z = truth.z.clone()
    z[3] = 3 * z[0]
    monkeypatch.setattr(frame_retrieval, "parameters_of_fields", lambda part, fields, now: z)
    every = torch.arange(4)
    trial = retrieve_frames(objective, start, every, 1, 0, Schedule(retrieved_iterations=0), ProjectedLBFGS())
    assert trial.n_found == 2
    assert trial.n_evaluations == (1 + LAST) * (STEPS + 2) / 2
    assert trial.missing.tolist() == [False, False, False, True]
    torch.testing.assert_close(trial.state.z, truth.z, rtol=1e-12, atol=1e-12)


def test_a_trial_counts_the_reflections_that_each_frame_took(monkeypatch):
    """Two frames of four; a reflection has the FFTs of STEPS / 2 + 1 evaluations of a frame."""
    objective, truth = problem(4, rms=0.2, noise=0.1)
    start = calibrate(objective, lost(truth))
    taken = Retrieved(torch.ones(2, len(objective.model.pupil.basis)).cdouble(), torch.tensor([100, 400]))
    monkeypatch.setattr(frame_retrieval, "retrieve_fields", lambda *given: taken)
    schedule = Schedule(retrieved_iterations=0)
    trial = retrieve_frames(objective, start, torch.arange(2), 600, 0, schedule, ProjectedLBFGS())
    assert trial.n_evaluations == (250 + LAST) * (STEPS + 2) / 2 / 2


def test_a_frame_that_is_hardly_better_has_not_been_found(monkeypatch):
    """It keeps what it gains: a step of a twentieth towards the truth leaves 0.9 of the excess, to second order."""
    objective, truth = problem(4, rms=0.1, noise=0.1)
    start = calibrate(objective, lost(truth))
    z = start.z + 0.05 * (truth.z - start.z)
    monkeypatch.setattr(frame_retrieval, "parameters_of_fields", lambda part, fields, now: z)
    schedule = Schedule(retrieved_iterations=0)
    trial = retrieve_frames(objective, start, torch.arange(4), 1, 0, schedule, ProjectedLBFGS())
    assert trial.n_found == 0
    torch.testing.assert_close(trial.state.z, z, rtol=1e-12, atol=1e-12)


def test_a_frame_that_fits_as_badly_with_other_phases_is_missing_still(monkeypatch):
    """Only the fields tell that from one which comes back to where it was."""
    objective, truth = problem(3, rms=0.2, noise=0.1)
    start = calibrate(objective, truth)
    turned = torch.tensor([0.0, 0.1, 3.0], dtype=torch.float64)[:, None]  # a constant phase shows in no field
    other = truth.z + turned * torch.eye(MODES, dtype=torch.float64)[3]
    monkeypatch.setattr(frame_retrieval, "parameters_of_fields", lambda part, fields, now: other)
    monkeypatch.setattr(
        frame_retrieval, "calibrate", lambda objective, state: start
    )  # which leaves as much of all frames
    schedule = Schedule(retrieved_iterations=0)
    trial = retrieve_frames(objective, start, torch.arange(3), 1, 0, schedule, ProjectedLBFGS())
    assert trial.missing.tolist() == [False, False, True]
    piston = torch.eye(MODES, dtype=torch.float64)[:1]
    torch.testing.assert_close(frame_retrieval._agreement(objective, 2.0 * piston), torch.ones(1).double())


def test_frames_at_the_noise_are_not_tried(monkeypatch):
    objective, truth = problem(4, rms=0.2)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    script = Script(monkeypatch, [(NO, NO, NO, NO)] * 9)
    ended = retrieve(objective, left(truth, 0.4, 3.0, 0.1, 0.45), retrievals=9, reflections_full=60)
    assert script.tried == [[1]] * 4
    assert script.seeds == [0, 1, 2, 3]  # other phases each time
    assert ended.n_evaluations == 4 * 60 * (STEPS + 2) / 2 / 4  # of one frame of four


def test_the_best_of_all_rounds_is_kept(monkeypatch):
    objective, truth = problem(4, rms=0.2)
    monkeypatch.setattr(retrieval, "calibrate", lambda objective, state: state)
    Script(monkeypatch, [(YES, NO, NO, NO)] * 3)
    states = [left(truth, *4 * [excess]) for excess in (1.0, 0.8, 2.0)]
    monkeypatch.setattr(retrieval, "_descend_together", lambda *given: states.pop(0))
    kept = states[1]
    assert retrieve(objective, left(truth, 3.0, 3.0, 3.0, 3.0), retrievals=3).state is kept


def test_trials_begin_at_random_phases_that_the_seed_gives(monkeypatch):
    objective, truth = problem(3, rms=0.2, noise=0.1)
    start, given = calibrate(objective, lost(truth)), []

    def watch(part, state, n_reflections):
        given.append(state.z)
        return retrieve_fields(part, state, n_reflections)

    monkeypatch.setattr(frame_retrieval, "retrieve_fields", watch)
    schedule = Schedule(retrieved_iterations=1)
    for seed in (0, 0, 1):
        retrieve_frames(objective, start, torch.tensor([0, 2]), 1, seed, schedule, ProjectedLBFGS())
    assert torch.equal(given[0], given[1])
    assert not bool((given[0] == given[2]).any())
    assert float((given[0] - start.z[[0, 2]]).abs().min()) > 0


def test_objects_are_moved_to_where_they_fit_best_between_rounds(monkeypatch):
    """Once in a round, and settled before each segment."""
    objective, truth = problem(3, rms=0.2)
    calls = []
    for name in ("centre_on_pixels", "settle"):
        monkeypatch.setattr(retrieval, name, lambda objective, state, numbers, name=name: calls.append(name) or state)
    schedule = Schedule(retrieved_segments=2, segment=1)
    retrieval._descend_together(objective, truth, TRAITS, schedule, ProjectedLBFGS(), lambda *said: None)
    assert calls == ["centre_on_pixels", "settle", "settle"]


# --- whole restorations


@pytest.mark.parametrize(
    ("change", "finds", "calls", "iterations"),
    [
        ({}, True, [8], 8),  # what is found ends the search
        ({}, False, [8, 16], 24),  # else other starts follow, whose mean is wanted, and there is one more chance
        ({"retrieved_starts": 1}, False, [8], 24),
        ({"max_iterations": 7}, True, [], 7),  # a start that was cut short may go on
        ({"wavelengths": (550e-9, 600e-9)}, True, [], 24),  # a field of one wavelength is no start for two
        ({"retrievals": 0}, True, [], 24),
        ({"n_frames": 1}, True, [], 8),  # the object of one frame is no help for its phases
        ({"known": True}, True, [], 8),
        ({"aperture": SparseAperture([[0.0, 0.3], [0.3, -0.2], [-0.3, -0.2]], 0.2, 1.0)}, True, [], 8),
    ],
)
def test_phases_are_retrieved_after_the_first_starts_of_a_full_pupil(change, finds, calls, iterations, monkeypatch):
    seen = []

    def stand_in(objective, ended, *given):
        seen.append(len(ended.costs))
        ended.retrieved = finds

    monkeypatch.setattr(solver, "retrieve_phases", stand_in)
    objective, truth = problem(change.get("n_frames", 3), rms=0.2)
    options = {"candidates": ((2, 4),), "segment": 4, "sharp_after": 4, "escapes": 0, "start_iterations": 8}
    options |= {"chance": 1e9, "alike": -1.0, "last_segments": 0, "retrievals": change.get("retrievals", 8)}
    options |= {"retrieved_starts": change.get("retrieved_starts", 2)}
    given = {name: change[name] for name in ("max_iterations", "wavelengths") if name in change}
    method = MyopicDeconvolution(
        change.get("aperture", PUPIL), GRID, MODES, r0=0.5, tolerance=0, schedule=Schedule(**options), **given
    )
    known = {"coefficients": truth.z[:, None]} if "known" in change else {}
    frames = 20_000 * (objective.frames + 1)  # electrons whose noise is a little above that of their photons
    result = method.restore(frames, **known)
    assert seen == calls
    assert len(result.cost) == iterations
    assert ("phases were retrieved" in result.message) == bool(finds and calls)
