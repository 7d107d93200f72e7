"""Functions by CUDA graphs: the same numbers as without, whatever was captured; on a GPU where there is one."""

import gc

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.aperture import SparseAperture
from torchmask.restoration import cuda_graphs
from torchmask.restoration.cuda_graphs import Captured, Graphed, graphed, shared_graph_memory
from torchmask.restoration.descent import descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS, minimize_bounded
from torchmask.restoration.state import State
from torchmask.restoration.variation import SmoothVariation, TotalVariation

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


class Rerun:
    """In place of a graph: a replay computes once more, from and into the tensors of the capture."""

    def __init__(self, function, given, made):
        self.function, self.given, self.made, self.replays = function, given, made, 0

    def replay(self):
        self.replays += 1
        new = self.function(*self.given)
        pairs = [(self.made, new)] if isinstance(new, torch.Tensor) else zip(self.made, new, strict=True)
        for old, values in pairs:
            old.copy_(values)


@pytest.fixture
def captures(monkeypatch):
    """Capture on the processor, by `Rerun`; holds what was captured."""
    held = []

    def capture(function, given):
        given = tuple(values.clone() for values in given)
        made = function(*given)
        held.append(Captured(Rerun(function, given, made), given, made))
        return held[-1]

    monkeypatch.setattr(cuda_graphs, "capture", capture)
    return held


def product_and_sum(x, y):
    return x * y, x + y


def test_a_processor_calls_the_function_itself():
    assert graphed(product_and_sum, torch.device("cpu")) is product_and_sum
    with shared_graph_memory(torch.device("cpu")):
        assert cuda_graphs._here.memory is None


def test_a_graph_takes_every_call_from_the_third_on(captures):
    function = Graphed(product_and_sum)
    made = []
    for number in range(6):
        x, y = (torch.full((3,), value) for value in (float(number), 2.0))
        made.append(function(x, y))
        assert len(captures) == (number >= 2)
    assert captures[0].graph.replays == 4
    for number, (product, total) in enumerate(made):  # none is overwritten by the calls after it
        assert product.tolist() == [2.0 * number] * 3
        assert total.tolist() == [2.0 + number] * 3


def test_a_single_tensor_is_made_as_well(captures):
    function = Graphed(lambda x: x + 1)
    made = [function(torch.tensor(float(number))) for number in range(5)]
    assert [float(value) for value in made] == [1, 2, 3, 4, 5]
    assert len(captures) == 1


def test_what_a_graph_cannot_hold_is_called_as_it_is(monkeypatch):
    tried = []

    def refuse(function, given):
        tried.append(given)
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(cuda_graphs, "capture", refuse)
    monkeypatch.setattr(cuda_graphs._here, "memory", object(), raising=False)
    function = Graphed(product_and_sum)
    for number in range(5):
        assert float(function(torch.tensor(float(number)), torch.tensor(3.0))[0]) == 3 * number
    assert len(tried) == 1
    assert cuda_graphs._here.memory is None  # the pool of a capture that broke off


def test_an_error_of_the_function_itself_is_told(captures):
    fails_from_now = [False, False, True]
    function = Graphed(lambda x: x / (1 - int(fails_from_now.pop(0))) if not fails_from_now[0] else x[:, 5])
    function(torch.zeros(1))
    function(torch.zeros(1))
    with pytest.raises(IndexError):
        function(torch.zeros(1))


# On a GPU


def exposures(dtype=torch.float64, shape="disc", prior=None):
    """An objective on the GPU with eight frames of a square, and the state to begin with."""
    mask = SparseAperture([[0.0, 0.35], [-0.35, -0.2], [0.3, -0.25], [0.1, 0.05]], 0.2, 1.0, shape)
    model = ExposureModel(mask.cuda(), Grid.nyquist(1.1, 550e-9, 48), 6, dtype=dtype, device="cuda")
    image = torch.zeros(model.window.field.shape, dtype=torch.float64, device="cuda")
    image[15:30, 10:35] = 3.0
    z = torch.randn(8, model.aberrations.n_parameters, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    frames = model(image, 0.3 * z.cuda()).detach().to(dtype)
    precision = torch.full((1, 1, 1), 1e3, dtype=dtype, device="cuda")
    objective = MyopicObjective(model, frames, precision, prior or TotalVariation())
    blurred = (image + image.roll(3, 0) + image.roll(3, 1)) / 3  # it shows where the mask lies, as an even one does not
    state = State(blurred, 0 * z.cuda(), objective.neutral_calibration())
    return objective, state


def told(objective, state, n_iterations):
    costs = []
    descend(objective, state, n_iterations, ProjectedLBFGS(), lambda cost, *_: costs.append(cost))
    return costs


@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize(("moves", "adapts"), [(False, False), (True, False), (False, True)])
def test_a_descent_by_graphs_is_that_without(dtype, moves, adapts, monkeypatch):
    objective, state = exposures(dtype)
    if adapts:
        objective = objective.with_changes(prior=SmoothVariation().adapted_to(state.image, 1.0))
    if moves:
        objective = objective.with_changes(free=objective.free | Free.PLACE)
    with shared_graph_memory(torch.device("cuda")):
        by_graph = told(objective, state, 12)
    monkeypatch.setattr("torchmask.restoration.descent.graphed", lambda function, device: function)
    monkeypatch.setattr("torchmask.restoration.corrections.graphed", lambda function, device: function)
    expected = told(objective, state, 12)
    # the same kernels in the same order; only sums that run in no fixed order differ
    rounding = torch.finfo(dtype).eps
    assert by_graph == pytest.approx(expected, rel=1e4 * rounding)


class Peeking(ObjectPrior):
    """A prior that looks at values, which a graph cannot hold."""

    def forward(self, image):
        return 1e-3 * image.square().sum() if float(image.detach().sum()) > 0 else image.sum()


@needs_gpu
def test_a_prior_that_looks_at_values_works_on_a_gpu_and_does_no_harm():
    objective, state = exposures(prior=Peeking())
    with shared_graph_memory(torch.device("cuda")):
        costs = told(objective, state, 12)
        assert costs[-1] < costs[0]
        other = Graphed(product_and_sum)
        for number in range(5):
            x = torch.full((3,), float(number), device="cuda")
            assert other(x, x + 1)[0].tolist() == [number * (number + 1.0)] * 3
        assert other._captured is not None


@needs_gpu
def test_a_hexagon_that_moves_is_evaluated_without_a_graph():
    objective, state = exposures(shape="hexagon")
    costs = told(objective.with_changes(free=objective.free | Free.PLACE), state, 8)
    assert costs[-1] < costs[0]


@needs_gpu
def test_graphs_of_one_restoration_share_their_memory():
    """Each needs 8 MB, and 40 of them no more than a few of them."""

    def capture_one():
        function = Graphed(lambda x: x * 2 + 1)
        for _ in range(4):
            function(torch.zeros(2**20, device="cuda", dtype=torch.float64))

    with shared_graph_memory(torch.device("cuda")):
        for _ in range(3):
            capture_one()
        gc.collect()
        before = torch.cuda.memory_reserved()
        for _ in range(40):
            capture_one()
        assert torch.cuda.memory_reserved() <= before + 2**25
    assert cuda_graphs._here.memory is None


@needs_gpu
def test_the_minimiser_is_the_same_on_both_devices():
    weight = torch.linspace(1, 100, 50, dtype=torch.float64)

    def found_on(device):
        weights = weight.to(device)

        def cost(x):
            return float((weights * (x - 1) ** 2).sum() + x[::2].sum()), 2 * weights * (x - 1) + stripes.to(device)

        stripes = torch.zeros(50, dtype=torch.float64)
        stripes[::2] = 1
        start = torch.full((50,), 3.0, dtype=torch.float64, device=device)
        return minimize_bounded(cost, start, 0.999 * torch.ones_like(start), max_iterations=100).x.cpu()

    torch.testing.assert_close(found_on("cuda"), found_on("cpu"), rtol=1e-6, atol=0)
