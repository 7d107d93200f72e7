"""Progress on disk: all of it comes back, nothing foreign or damaged is taken, and what goes on ends in the same."""

from dataclasses import fields, replace
from functools import partial
from types import FunctionType

import numpy as np
import pytest
import torch
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.geometry import MaskGeometry
from torchmask.record import Record
from torchmask.restoration.candidates import several
from torchmask.restoration.checkpoint import Checkpoint, Ending, Progress, Status
from torchmask.restoration.fingerprint import fingerprint_of
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.given_prior import as_prior
from torchmask.restoration.minimizers import TorchMinimizer
from torchmask.restoration.myopic import MyopicDeconvolution
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import EdgePreserving
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.solver import Solver
from torchmask.restoration.state import Calibration, Modes, State
from torchmask.restoration.traits import Refinement
from torchmask.restoration.variation import TotalVariation

CPU = torch.device("cpu")


def random_state(seed, n_frames=3):
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, dtype=torch.float64, generator=generator)

    calibration = Calibration(uniform(n_frames), 1 + uniform(n_frames), 0.3 + seed)
    image, z, numbers = uniform(4, 5), uniform(n_frames, 2), uniform(4).tolist()
    geometry = MaskGeometry(
        numbers[0] - 0.5, 0.9 + numbers[1], 0.9 + numbers[2], 0.5 * numbers[3], mirrored=seed % 2 == 0
    )
    return State(image, z, calibration, geometry, list(Modes)[seed % 3])


def progress_with(**changes):
    """Nothing of it as it is by default."""
    given = {
        "costs": [9.0, 7.5, 7.25],
        "n_evaluations": 17,
        "status": Status.CONVERGED,
        "decrease": 3e-5,
        "escapes": 4,
        "starts": 2,
        "began": 1,
        "rival": Ending(random_state(1), Status.START_LIMIT),
        "explained": (Ending(random_state(3), Status.START_LIMIT), Ending(random_state(4), Status.CONVERGED, 2e-5)),
        "alike": True,
        "finer": random_state(5),
        "last_segments": 2,
        "refinement": Refinement.ON,
        "averaged": 3,
        "retrieved": True,
        "seeks_no_more": True,
        "in_vain": 1,
        "tempered": True,
        "rate": 0.4,
    }
    return Progress(several(random_state(0), 4), **given | changes)


def same_state(one, other):
    assert torch.equal(one.image, other.image)
    assert torch.equal(one.z, other.z)
    for item in fields(Calibration):
        a, b = getattr(one.calibration, item.name), getattr(other.calibration, item.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, item.name
    assert (one.geometry, one.modes) == (other.geometry, other.modes)  # to the last digit


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"rival": None, "explained": (), "finer": None},
        {"rival": Ending(random_state(2), Status.CONVERGED, 1e-6), "status": Status.ITERATION_LIMIT},
        {"status": Status.RUNNING, "decrease": None, "alike": False, "costs": [], "began": 0},
        {"costs": [1.0]},
    ],
)
def test_everything_comes_back(changes, tmp_path):
    """Several candidates and a rival among it."""
    saved = progress_with(**changes)
    file = Checkpoint(tmp_path / "state.npz", "mine")
    file.save(saved)
    back = file.load(CPU)
    same_state(back.state, saved.state)
    assert back.candidates.n_each == 4
    for item in fields(Progress):
        if item.name not in ("candidates", "rival", "explained", "finer"):
            assert getattr(back, item.name) == getattr(saved, item.name), item.name
    for one, other in zip(back.explained, saved.explained, strict=True):
        same_state(one.state, other.state)
        assert (one.status, one.decrease) == (other.status, other.decrease)
    assert [back.rival is None, back.finer is None] == [saved.rival is None, saved.finer is None]
    if saved.finer is not None:
        same_state(back.finer, saved.finer)
    if saved.rival is not None:
        same_state(back.rival.state, saved.rival.state)
        assert (back.rival.status, back.rival.decrease) == (saved.rival.status, saved.rival.decrease)


def test_a_later_checkpoint_replaces_the_earlier(tmp_path):
    file = Checkpoint(tmp_path / "state.npz", "mine")
    file.save(progress_with())
    file.save(progress_with(rival=None, n_evaluations=99))
    assert file.load(CPU).n_evaluations == 99
    assert file.load(CPU).rival is None
    assert [path.name for path in tmp_path.iterdir()] == ["state.npz"]


def test_no_file_is_no_progress(tmp_path):
    assert Checkpoint(tmp_path / "state.npz", "mine").load(CPU) is None


def test_a_foreign_checkpoint_is_refused(tmp_path):
    Checkpoint(tmp_path / "state.npz", "mine").save(progress_with())
    with pytest.raises(ValueError, match=r"state\.npz is the checkpoint of other frames or settings, or of another"):
        Checkpoint(tmp_path / "state.npz", "yours").load(CPU)


def test_a_damaged_checkpoint_is_refused(tmp_path):
    """Cut short, overwritten, or without any one of its parts."""
    file = Checkpoint(tmp_path / "state.npz", "mine")
    file.save(progress_with(rival=Ending(random_state(1), Status.CONVERGED, 1e-6)))
    whole, parts = file.path.read_bytes(), dict(np.load(file.path))
    for damaged in (whole[: len(whole) // 2], b"", b"not at all"):
        file.path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"state\.npz"):
            file.load(CPU)
    optional = {"decrease", "rival_decrease", "explained1_decrease"}  # where a start is not at its end
    for name in parts.keys() - optional:
        np.savez(file.path, **{key: value for key, value in parts.items() if key != name})
        with pytest.raises(ValueError, match=rf"state\.npz has no '?{name}\b"):
            file.load(CPU)


def test_a_checkpoint_of_version_0_1_is_refused(tmp_path):
    """The arrays that 0.1.0 wrote."""
    old = {"image": np.ones((4, 5)), "z": np.zeros((3, 2)), "gains": np.ones(3), "prior": 1.0, "excess": np.ones(3)}
    old |= {"costs": [2.0, 1.0], "n_evaluations": 3, "relocations": 0, "starts": 1, "began": 0}
    old |= {"rival_message": "", "message": "", "fingerprint": "0" * 64}
    np.savez(tmp_path / "old.npz", **old)
    with pytest.raises(ValueError, match=r"or of another version: give another name or delete it"):
        Checkpoint(tmp_path / "old.npz", "1" * 64).load(CPU)


# --- to what a checkpoint belongs

GRID = Grid((25, 25), 550e-9 / 2, 550e-9)  # with a field of 32 pixels: samples of the pupil are 1/16 m apart
CENTRES = [[0.0, 0.3125], [0.3125, -0.1875], [-0.3125, -0.1875]]


class Scaled(nn.Module):
    def __init__(self, scale):
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(scale))

    def forward(self, image):
        return self.scale * (image**2).sum()


class Hidden(nn.Module):
    """Its parameter stands neither in its repr nor anywhere else but in its state."""

    def __init__(self, scale):
        super().__init__()
        self.register_buffer("scale", torch.tensor(scale))

    def forward(self, image):
        return self.scale * (image**2).sum()


def fingerprint(centers=CENTRES, frames=None, prior=None, free=Free.OBJECT, settings=(True, False), known=(None,)):
    model = ExposureModel(SparseAperture(centers, 0.25, 1.0), GRID, 3)
    frames = torch.ones(2, 25, 25, dtype=torch.float64) if frames is None else frames
    precision = torch.ones(1, 1, 1, dtype=torch.float64)
    objective = MyopicObjective(
        model, frames, precision, as_prior(TotalVariation() if prior is None else prior), free=free
    )
    return fingerprint_of(objective, settings, known)


def test_a_fingerprint_is_the_same_for_the_same():
    assert fingerprint() == fingerprint()
    assert fingerprint(prior=Hidden(2.0)) == fingerprint(prior=Hidden(2.0))


def test_a_fingerprint_tells_frames_priors_settings_and_masks_apart():
    moved = [[0.0, 0.3125], [0.3125, -0.125], [-0.3125, -0.1875]]  # by one sample: by itself each hole looks the same
    frames = torch.ones(2, 25, 25, dtype=torch.float64)
    frames[1, 3, 4] = 1.5
    prints = [
        fingerprint(),
        fingerprint(moved),
        fingerprint(frames=frames),
        fingerprint(prior=TotalVariation(2.0)),
        fingerprint(prior=TotalVariation(1.0, 0.02)),
        fingerprint(prior=EdgePreserving(1.0, 0.01)),
        fingerprint(prior=Hidden(2.0)),
        fingerprint(prior=Hidden(3.0)),
        fingerprint(prior=Scaled(2.0)),
        fingerprint(prior=torch.sum),
        fingerprint(prior=torch.mean),
        fingerprint(free=Free.OBJECT | Free.ABERRATIONS),
        fingerprint(settings=(True, True)),
        fingerprint(settings=(True, Schedule())),
        fingerprint(settings=(True, Schedule(segment=99))),
        fingerprint(settings=(True, ProjectedLBFGS())),
        fingerprint(settings=(True, ProjectedLBFGS(5))),
        fingerprint(known=(torch.ones(3),)),
        fingerprint(known=(torch.zeros(3),)),
        fingerprint(known=(None, None)),
    ]
    assert len(set(prints)) == len(prints)


class Anonymous:
    """A prior without a repr of its own."""

    def __call__(self, image):
        return (image**2).sum()


def adam(parameters):
    return torch.optim.Adam(parameters, lr=0.1)


def penalty(image, weight):
    return weight * (image**2).sum()


def elsewhere(function):
    """The same function at another address, as in another process."""
    return FunctionType(function.__code__, globals(), function.__name__)


def test_a_function_is_known_by_its_name_and_not_by_where_it_lies():
    assert fingerprint(settings=(TorchMinimizer(adam),)) == fingerprint(settings=(TorchMinimizer(elsewhere(adam)),))
    twice = fingerprint(prior=partial(penalty, weight=2.0))
    assert fingerprint(prior=partial(elsewhere(penalty), weight=2.0)) == twice
    assert fingerprint(prior=partial(penalty, weight=3.0)) != twice


def entropy(weight):
    return lambda image: weight * (image.clamp(min=1e-6) * image.clamp(min=1e-6).log()).sum()


def network(weight):
    made = nn.Linear(25, 1, bias=False)
    nn.init.constant_(made.weight, weight)
    return made


def with_default(weight):
    def prior(image, *, weight=weight):
        return weight * image.sum()

    return prior


def descending(rate):
    return TorchMinimizer(lambda z: torch.optim.SGD(z, lr=rate))


class Plain(nn.Module):
    """Its number is no tensor and stands in no repr."""

    def __init__(self, weight):
        super().__init__()
        self.weight = weight

    def forward(self, image):
        return self.weight * image.sum()


def around(made):
    return lambda image: made(image).square().mean()


ENCLOSING = {
    "a number": entropy,
    "a network": lambda weight: around(network(weight)),
    "a function": lambda weight: around(entropy(weight)),
    "a method of a network": lambda weight: network(weight).forward,
    "a network in a partial": lambda weight: partial(penalty, weight=network(weight)),
    "an array in a dictionary": lambda weight: (lambda held: lambda image: held["of it"])(
        {"of it": np.ones(3) * weight}
    ),
    "a default": with_default,
    "a constant": lambda weight: (lambda image: 0.1 * image.sum()) if weight == 0.1 else (lambda image: image.sum()),
    "an attribute": Plain,
    "a compiled function": lambda weight: torch.compile(entropy(weight), backend="eager"),
    "a compiled network": lambda weight: torch.compile(network(weight), backend="eager"),
    "a traced network": lambda weight: torch.fx.symbolic_trace(network(weight)),
}


@pytest.mark.parametrize("make", ENCLOSING.values(), ids=ENCLOSING)
def test_a_function_is_known_by_what_it_holds(make):
    assert fingerprint(prior=make(0.1)) == fingerprint(prior=make(0.1))
    assert fingerprint(prior=make(0.1)) != fingerprint(prior=make(50.0))


WEIGHT = 0.1


def of_this_file(image):
    return own_weight() * image.sum()


def own_weight():
    return WEIGHT


def endless(image):
    return endless(image) if image is None else image.sum()


def test_a_function_is_known_by_what_it_reads_in_its_file(monkeypatch):
    """Through another function of the file too; one that calls itself comes to an end."""
    before = fingerprint(prior=of_this_file)
    monkeypatch.setitem(globals(), "WEIGHT", 50.0)
    assert fingerprint(prior=of_this_file) != before
    assert fingerprint(prior=endless) == fingerprint(prior=endless)


def test_an_optimiser_is_known_by_what_its_function_holds():
    assert fingerprint(settings=(descending(1.0),)) == fingerprint(settings=(descending(1.0),))
    assert fingerprint(settings=(descending(1.0),)) != fingerprint(settings=(descending(2.0),))


@pytest.mark.parametrize(
    "options",
    [
        {"prior": Anonymous()},
        {"prior": partial(penalty, weight=Anonymous())},
        {"prior": around(Anonymous())},
        {"prior": Plain(Anonymous())},
        {"settings": (partial(adam, Anonymous()),)},
    ],
)
def test_what_has_only_an_address_in_memory_has_no_checkpoint(options):
    with pytest.raises(ValueError, match=r"cannot know <\S*Anonymous object at 0x\w+> again, which has no name"):
        fingerprint(**options)


# --- whole restorations


@pytest.mark.parametrize(
    ("name", "words"),
    [("state", r"state, which does not end in \.npz: give"), ("none/state.npz", "there is no folder .*none: create")],
)
def test_what_cannot_be_written_is_told_before_any_work(name, words, observation, restoring, tmp_path):
    steps = []
    with pytest.raises(ValueError, match=words):
        restoring(3, max_iterations=2).restore(observation.frames, checkpoint=tmp_path / name, callback=steps.append)
    assert not steps


def test_a_checkpoint_belongs_to_what_its_prior_encloses(observation, restoring, tmp_path):
    path = tmp_path / "state.npz"
    restoring(3, max_iterations=2, prior=entropy(0.1)).restore(observation.frames, checkpoint=path)
    restoring(3, max_iterations=2, prior=entropy(0.1)).restore(observation.frames, checkpoint=path)
    with pytest.raises(ValueError, match="other frames or settings"):
        restoring(3, max_iterations=2, prior=entropy(50.0)).restore(observation.frames, checkpoint=path)


def test_interrupted_and_resumed_is_the_same(observation, restoring, tmp_path):
    method = restoring(max_iterations=50, tolerance=0, schedule=Schedule(segment=20))
    whole = method.restore(observation.frames)

    def interrupt(record: Record) -> None:
        if record.step == 30:
            raise KeyboardInterrupt

    path = tmp_path / "state.npz"
    with pytest.raises(KeyboardInterrupt):
        method.restore(observation.frames, checkpoint=path, callback=interrupt)
    steps = []
    resumed = method.restore(observation.frames, checkpoint=path, callback=lambda record: steps.append(record.step))
    assert steps[0] == 21
    assert torch.equal(resumed.object, whole.object)
    assert torch.equal(resumed.coefficients, whole.coefficients)
    assert torch.equal(resumed.cost, whole.cost)
    assert resumed.n_evaluations == whole.n_evaluations
    assert resumed.message == whole.message
    with pytest.raises(ValueError, match="other frames or settings"):
        method.restore(observation.frames * 1.1, checkpoint=path)
    spread = method.restore(observation.frames, checkpoint=path, n_samples=2)  # of what is there, without a step more
    assert torch.equal(spread.object, whole.object)
    assert torch.equal(spread.object_std, method.restore(observation.frames, checkpoint=path, n_samples=2).object_std)


@pytest.mark.parametrize("begun_from", ["an earlier result", "estimated aberrations"])
def test_a_resumed_restoration_does_not_begin_again(
    begun_from, observation, restored, restoring, tmp_path, monkeypatch
):
    """Neither pays for the fit of new frames a second time, nor forgets where its prior is centred."""
    frames, path, begun = observation.frames, tmp_path / "state.npz", []
    method = restoring(3, max_iterations=60, tolerance=0, schedule=Schedule(segment=20))
    known = {"start": method.restore(frames[:6])}
    if begun_from == "estimated aberrations":
        known = {"coefficients": restored.coefficients[..., :3], "covariance": 0.01 * torch.eye(15)}
    whole = method.restore(frames, **known)
    begin = Solver.begin
    monkeypatch.setattr(Solver, "begin", lambda self, *told: begun.append(told) or begin(self, *told))

    def interrupt(record: Record) -> None:
        if record.step == 30:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        method.restore(frames, checkpoint=path, callback=interrupt, **known)
    resumed = method.restore(frames, checkpoint=path, **known)
    assert len(begun) == 1
    assert torch.equal(resumed.object, whole.object)
    assert torch.equal(resumed.coefficients, whole.coefficients)
    assert torch.equal(resumed.cost, whole.cost)
    assert resumed.n_evaluations == whole.n_evaluations


def test_a_checkpoint_belongs_to_what_was_known(observation, restored, restoring, tmp_path):
    method = restoring(max_iterations=2)
    for number, name in enumerate(("known_object", "coefficients")):
        given = {"known_object": observation.object, "coefficients": restored.coefficients}[name]
        path = tmp_path / f"{number}.npz"
        result = method.restore(observation.frames, checkpoint=path, **{name: given})
        assert torch.equal(method.restore(observation.frames, checkpoint=path, **{name: given}).object, result.object)
        with pytest.raises(ValueError, match="other frames or settings"):
            method.restore(observation.frames, checkpoint=path, **{name: given.flip(1)})
    path = tmp_path / "open.npz"
    instrument = (observation.aperture, observation.grid)
    MyopicDeconvolution(*instrument, r0=None, max_iterations=2).restore(observation.frames, checkpoint=path)
    with pytest.raises(ValueError, match="other frames or settings"):  # the first guess, taken for known now
        MyopicDeconvolution(*instrument, r0=0.22, max_iterations=2).restore(observation.frames, checkpoint=path)


def test_a_checkpoint_belongs_to_the_modes_of_the_last_descent(observation, restoring, tmp_path):
    """With a number of modes given there are no more after the search, which six are without one as well."""
    path = tmp_path / "state.npz"
    restoring(None, max_iterations=2).restore(observation.frames, checkpoint=path)
    with pytest.raises(ValueError, match="other frames or settings"):
        restoring(6, max_iterations=2).restore(observation.frames, checkpoint=path)


def test_a_checkpoint_belongs_to_its_start(observation, restored, restoring, tmp_path):
    """One of a blind restoration is not that of one which goes on from a result, nor from another result."""
    method, path, blind = restoring(max_iterations=2), tmp_path / "state.npz", tmp_path / "blind.npz"
    method.restore(observation.frames, checkpoint=blind)
    with pytest.raises(ValueError, match="other frames or settings"):
        method.restore(observation.frames, start=restored, checkpoint=blind)
    first = method.restore(observation.frames, start=restored, checkpoint=path)
    assert torch.equal(method.restore(observation.frames, start=restored, checkpoint=path).object, first.object)
    other = replace(restored, coefficients=2 * restored.coefficients)
    with pytest.raises(ValueError, match="other frames or settings"):
        method.restore(observation.frames, start=other, checkpoint=path)


def test_a_checkpoint_belongs_to_its_settings(observation, restoring, tmp_path):
    path = tmp_path / "state.npz"
    frames, mine = observation.frames, {"prior": Hidden(2.0)}
    first = restoring(3, max_iterations=2, **mine).restore(frames, checkpoint=path)
    for change in (
        {"prior": Hidden(3.0)},
        {"prior": TotalVariation()},
        {"schedule": Schedule(segment=50)},
        {"minimizer": ProjectedLBFGS(5)},
        {"minimizer": TorchMinimizer(partial(torch.optim.Adam, lr=0.1))},
        {"r0": 0.3},
        {"aberration_prior": False},
        {"exposure_tau0": 0.5},
    ):
        with pytest.raises(ValueError, match="other frames or settings"):
            restoring(3, max_iterations=2, **mine | change).restore(frames, checkpoint=path)
    with pytest.raises(ValueError, match="other frames or settings"):
        restoring(3, max_iterations=2, **mine).restore(frames, checkpoint=path, seed=1)
    again = restoring(3, max_iterations=2, **mine).restore(frames, checkpoint=path)
    assert torch.equal(again.object, first.object)


def test_more_iterations_than_before_go_on(observation, restoring, tmp_path):
    path = tmp_path / "state.npz"
    schedule = Schedule(segment=5)  # limits that lie between two segments leave no trace
    whole = restoring(3, max_iterations=10, schedule=schedule).restore(observation.frames)
    restoring(3, max_iterations=5, schedule=schedule).restore(observation.frames, checkpoint=path)
    longer = restoring(3, max_iterations=10, schedule=schedule).restore(observation.frames, checkpoint=path)
    assert len(longer.cost) == 10
    assert torch.equal(longer.cost[:5], whole.cost[:5])
    assert "max_iterations = 10" in longer.message
    shorter = restoring(3, max_iterations=5, schedule=schedule).restore(observation.frames, checkpoint=path)
    assert torch.equal(shorter.cost, longer.cost)  # what is done is done
