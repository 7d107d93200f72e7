"""The mean object of several starts: registered, with aberrations that fit it."""

from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.metrics import shift
from torchmask.optics.aperture import FullAperture
from torchmask.record import Record
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Ending, Progress, Status
from torchmask.restoration.consensus import average_starts, registered_mean
from torchmask.restoration.escapes import tilt
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation

PUPIL, FRAMES, NOISE = FullAperture(1.0), 3, 0.03
GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.2)


@pytest.fixture(scope="module")
def explained():
    """A smooth object, the frames of random aberrations, and the state that explains them."""
    generator = torch.Generator().manual_seed(1)
    model = ExposureModel(PUPIL, GRID, 6)
    side = torch.arange(model.window.field.shape[0], dtype=torch.float64) - model.window.field.shape[0] / 2
    row, column = side[:, None], side[None]
    image = 20 * torch.exp(-((row - 2) ** 2 + column**2) / 18) + 10 * torch.exp(
        -((row + 5) ** 2 + (column - 4) ** 2) / 12
    )
    z = 0.7 * torch.randn(FRAMES, model.aberrations.n_parameters, generator=generator, dtype=torch.float64)
    frames = model(image, z)
    frames = frames + NOISE * torch.randn(frames.shape, generator=generator, dtype=torch.float64)
    objective = MyopicObjective(model, frames, torch.full((1, 1, 1), NOISE**-2, dtype=torch.float64), TotalVariation())
    calibration = Calibration(torch.ones(FRAMES).double(), torch.ones(FRAMES).double(), 1.0)
    return objective, State(image, z, calibration)


def moved(objective, state, offset):
    """The same frames, from an object that lies elsewhere."""
    return replace(state, image=shift(state.image, offset), z=state.z - tilt(objective.model, offset))


def averaged(objective, states, n_iterations):
    """The state and evaluations after the average of several starts."""
    explained = tuple(Ending(state, Status.CONVERGED) for state in states)
    ended = Progress(Candidates(states[0], 1), explained=explained)
    average_starts(objective, ended, Schedule(segment=n_iterations), ProjectedLBFGS(), None)
    return ended.state, ended.n_evaluations


def test_the_mean_of_what_differs_by_its_place_is_itself(explained):
    """An object within the field and far below the limit of sampling is shifted without an error."""
    objective, state = explained
    mean = registered_mean(
        objective, [state, moved(objective, state, (0.3, -1.4)), moved(objective, state, (-2.0, 0.6))]
    )
    assert float((mean.image - state.image).abs().max()) < 1e-5 * float(state.image.max())
    for part in mean.z.split(FRAMES):
        torch.testing.assert_close(part, state.z, rtol=0, atol=1e-5)


def test_errors_that_differ_between_starts_average_out(explained):
    objective, state = explained
    error = torch.randn(state.image.shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    both = [replace(state, image=state.image + 0.2 + sign * 0.02 * error) for sign in (1, -1)]
    mean = registered_mean(objective, both)
    # Opposite errors vanish, but for what they do to the registration, which is of second order in them.
    left = (mean.image - state.image - 0.2).norm() / (0.02 * error).norm()
    assert float(left) < 0.05


def test_each_frame_takes_the_aberrations_that_fit_best(explained):
    """Of two states, each of which is right about some of the frames; the mean of the objects is the object."""
    objective, state = explained
    wrong = torch.tensor([[1.0], [0.0], [1.0]]).double()
    one, other = replace(state, z=state.z + wrong), replace(state, z=state.z + (1 - wrong))
    found, evaluations = averaged(objective, [one, other], 1)
    # One iteration moves them by about their standard deviation, far less than by what is wrong.
    assert float((found.z - state.z).abs().max()) < 0.5
    assert 4 < evaluations <= 4 + 4  # two for each state, and those of one iteration


def test_aberrations_are_fitted_to_the_mean_object(explained):
    objective, state = explained
    away = replace(state, z=state.z + 0.1)
    found, _ = averaged(objective, [away, away], 30)
    before, after = (objective.frame_costs(state.image, now.z, state.calibration).sum() for now in (away, found))
    assert float(after) < 0.5 * float(before)
    torch.testing.assert_close(found.image / found.image.sum(), state.image / state.image.sum())


def test_the_mean_is_light_and_has_the_mean_weight_of_the_prior(explained):
    """A sharp object between the pixels rings when it is shifted, by less than nothing."""
    objective, state = explained
    point = torch.zeros_like(state.image)
    point[12, 14] = 100.0
    between = shift(point, (0.5, 0.5)).clamp(min=0)
    assert float(shift(between, (-0.5, -0.5)).min()) < -1
    sharp = [replace(state, image=image) for image in (point, between)]
    weighed = [one.calibrated(aberration_weight=weight) for one, weight in zip(sharp, (0.5, 2.0), strict=True)]
    mean = registered_mean(objective, weighed)
    assert float(mean.image.min()) == 0
    assert mean.calibration.aberration_weight == pytest.approx(1.25, rel=1e-12)


# --- whole restorations

STAGES = ("restoration", "fit to the mean")
BRISK = {"candidates": ((2, 4),), "segment": 4, "sharp_after": 4, "escapes": 0, "start_iterations": 8}
BRISK |= {"retrievals": 0, "last_segments": 0}


def restore(explained, schedule, **given):
    frames = 3000 * (explained[0].frames + 1)  # electrons whose noise of 90 is a little above that of their photons
    method = MyopicDeconvolution(PUPIL, GRID, 6, r0=0.5, tolerance=0, schedule=schedule)
    return method.restore(frames, **given)


@pytest.mark.parametrize(
    ("chance", "averaged", "message", "iterations"),
    [
        (1e9, 3, "the mean object of 3 starts", 24),  # all explain the frames
        (1e9, 1, None, 8),
        (-1e9, 3, "the best of 9 starts", 72),  # none does
    ],
)
def test_starts_that_explain_the_frames_are_averaged(chance, averaged, message, iterations, explained):
    schedule = Schedule(chance=chance, averaged=averaged, alike=-1.0, **BRISK)
    records: list[Record] = []
    result = restore(explained, schedule, callback=records.append)
    assert message is None or message in result.message
    assert len(result.cost) == iterations
    steps = {stage: [record.step for record in records if record.stage == stage] for stage in STAGES}
    assert steps["restoration"] == list(range(1, iterations + 1))
    last = steps["fit to the mean"]
    assert last == list(range(1, len(last) + 1))
    assert bool(last) == ("mean" in (message or ""))
    assert len(records) == iterations + len(last)
    assert bool((result.object >= 0).all())


def test_interrupted_among_the_starts_and_resumed_is_the_same(explained, tmp_path):
    schedule = Schedule(chance=1e9, **BRISK)
    whole = restore(explained, schedule)
    path = tmp_path / "state.npz"

    def interrupt(record: Record) -> None:
        if record.step == 22:  # two starts are behind it
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        restore(explained, schedule, callback=interrupt, checkpoint=path)
    for _ in range(2):  # and once more from its end
        resumed = restore(explained, schedule, checkpoint=path)
        assert torch.equal(resumed.object, whole.object)
        assert torch.equal(resumed.coefficients, whole.coefficients)
        assert torch.equal(resumed.cost, whole.cost)
        assert (resumed.n_evaluations, resumed.message) == (whole.n_evaluations, whole.message)
