"""What is handed back, from a state whose frames are known."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.optics.geometry import MaskGeometry
from torchmask.restoration import assembly
from torchmask.restoration.assembly import add_deviations, assemble_result
from torchmask.restoration.background import Background
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Progress, Status
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.objective import Free
from torchmask.restoration.posterior import evenness
from torchmask.restoration.traits import Refinement

UNIT, NOISE = 500.0, 0.03  # electrons, and the noise of `explained` in units of the mean


@pytest.fixture
def ended(explained):
    """Objective, stack and progress of a restoration that has found the truth, in frames of unequal brightness."""
    objective, state = explained
    transmission = torch.tensor([0.8, 1.0, 1.0, 1.2], dtype=torch.float64)
    frames = objective.frames * transmission[:, None, None]
    valid = torch.ones_like(frames, dtype=torch.bool)
    valid[1, 4:8] = False
    variance = (UNIT * NOISE) ** 2
    stack = FrameStack(frames, valid, UNIT, variance, slope=variance / UNIT)  # of photons alone
    objective = type(objective)(objective.model, frames, stack.precision, objective.prior)
    state = state.calibrated(transmission=transmission, aberration_weight=1.7)
    return objective, stack, Progress(Candidates(state, 1), [5.0, 4.0], n_evaluations=9, status=Status.CONVERGED)


def test_a_result_is_in_electrons_and_rad(ended):
    objective, stack, progress = ended
    state = progress.state
    result = assemble_result(objective, stack, progress, r0=0.2)
    torch.testing.assert_close(result.extended_object * (1 - result.light_beyond), UNIT * state.image)
    assert 0 < result.light_beyond < 0.3
    assert torch.equal(result.object, result.extended_object[:32, :32])
    assert torch.equal(result.coefficients, objective.model.aberrations.coefficients(state.z))
    assert torch.equal(result.transmission, state.calibration.transmission)
    made = objective.model(state.image, state.z) * state.calibration.transmission[:, None, None]
    torch.testing.assert_close(result.model, UNIT * made)
    expected = torch.where(stack.valid, (stack.frames - made) / NOISE, 0.0)
    torch.testing.assert_close(result.residuals, expected)
    torch.testing.assert_close(result.chi_square, expected.square().sum((1, 2)) / stack.valid.sum((1, 2)))
    assert int(stack.valid[1].sum()) == 28 * 32
    assert float(result.chi_square[[1, 2]].sub(1).abs().max()) < 4 * math.sqrt(2 / (28 * 32))
    assert result.noise == pytest.approx(UNIT * NOISE)
    assert result.r0 == pytest.approx(0.2 * 1.7 ** (3 / 5))  # (r0 / 0.2)^(-5/3) is the strength, 1 / 1.7
    assert result.prior == "TotalVariation(weight=1, epsilon=0.01)"
    assert result.cost.tolist() == [5.0, 4.0]
    assert result.n_evaluations == 9
    assert math.isnan(assemble_result(objective, stack, progress, r0=None).r0)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"decrease": 3.2e-5}, "converged: the last segment lowered the cost by a fraction 3.2e-05"),
        ({"status": Status.ITERATION_LIMIT}, "stopped at max_iterations = 2"),
        ({"status": Status.START_LIMIT, "began": 1}, "stopped at the limit of iterations for a start"),
        ({"status": Status.ITERATION_LIMIT, "starts": 3}, "stopped at max_iterations = 2; the best of 3 starts"),
        (
            {"status": Status.START_LIMIT, "starts": 4, "averaged": 3, "retrieved": True},
            "stopped at the limit of iterations for a start; the mean object of 3 starts, of 4 made; then phases were "
            "retrieved for the object found",
        ),
        (
            {"decrease": 0.0, "starts": 2, "alike": True},
            "converged: the last segment lowered the cost by a fraction 0.0e+00; the best of 2 starts, two of which "
            "ended alike",
        ),
    ],
)
def test_the_message_says_why_it_ended(changes, message, ended):
    objective, stack, progress = ended
    result = assemble_result(objective, stack, replace(progress, **changes), r0=None)
    assert result.message == message
    assert result.converged == message.startswith("converged")


def test_deviations_are_of_what_is_free(ended):
    objective, stack, progress = ended
    result = assemble_result(objective, stack, progress, r0=None)
    assert result.object_std is None
    whole = add_deviations(result, objective, stack, progress, 2)
    assert whole.object_std.shape == (32, 32)
    assert whole.coefficients_std.shape == (5, 3)
    assert float(whole.object_std.mean()) > 0
    of_object = add_deviations(result, objective.with_changes(free=Free.OBJECT), stack, progress, 2)
    assert float(of_object.coefficients_std.abs().max()) == 0
    brighter = replace(stack, unit=2 * UNIT, variance=4 * stack.variance, slope=2 * stack.slope)
    twice = add_deviations(result, objective.with_changes(free=Free.OBJECT), brighter, progress, 2)
    assert bool((stack.photon_share[stack.valid] == 1).all())
    torch.testing.assert_close(brighter.photon_share, stack.photon_share)
    torch.testing.assert_close(twice.object_std, 2 * of_object.object_std)


def test_deviations_of_an_even_object_are_smaller_unless_light_was_faint(ended):
    objective, stack, progress = ended
    result = assemble_result(objective, stack, progress, r0=0.2)
    bright, faint = (
        add_deviations(result, objective, stack, replace(progress, integrated=integrated), 2).object_std
        for integrated in (False, True)
    )
    assert evenness(progress.state.image) < 0.8
    torch.testing.assert_close(bright, faint * evenness(progress.state.image))


def test_a_result_includes_the_sky_that_was_told_and_the_one_that_was_found(explained):
    """In electrons: the told one as given, and of the found one, which the frames hold in units of a mean pixel."""
    objective, state = explained
    found = torch.tensor([0.5, 0.2, 0.0, 1.0], dtype=torch.float64)
    told = torch.tensor([0.0, 100.0, 50.0, 25.0], dtype=torch.float64)[:, None, None] * torch.linspace(0, 2, 32)
    frames = objective.model(state.image, state.z) + found[:, None, None]
    valid, precision = torch.ones_like(frames, dtype=torch.bool), torch.ones(1, 1, 1, dtype=torch.float64)
    stack = FrameStack(frames, valid, UNIT, 1.0, told, Background.PER_FRAME)
    model = objective.model.beside(Background.PER_FRAME)
    objective = type(objective)(model, frames, precision, objective.prior)
    result = assemble_result(objective, stack, Progress(Candidates(state, 1), [1.0]), r0=None)
    torch.testing.assert_close(result.background, UNIT * found + told.mean((1, 2)), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(result.model, UNIT * frames + told, rtol=1e-9, atol=1e-9)
    assert float(result.residuals.abs().max()) < 1e-9


def test_the_deviation_of_a_magnification_is_that_of_a_shrinkage_times_it(ended, monkeypatch):
    """A shrinkage is minus the logarithm of a magnification; the rotation is an angle already."""
    objective, stack, progress = ended
    monkeypatch.setattr(assembly, "place_deviations", lambda *_: torch.tensor([0.01, 0.02], dtype=torch.float64))
    state = replace(progress.state, geometry=MaskGeometry(0.1, 1.5, 1.5))
    progress = Progress(Candidates(state, 1), [1.0], refinement=Refinement.ON)
    result = assemble_result(objective, stack, progress, r0=None)
    assert result.geometry_std is not None
    assert result.geometry_std.tolist() == pytest.approx([0.01, 0.03])


def test_the_deviation_of_a_coefficient_is_its_rms_over_samples_and_frames(ended, monkeypatch):
    """Of coefficients, not of parameters, which the basis mixes; that of the object is in electrons."""
    objective, stack, progress = ended
    state, basis = replace(progress, integrated=True).state, objective.model.aberrations
    z = torch.randn(5, *state.z.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    monkeypatch.setattr(assembly, "standard_deviations", lambda *_: (2 * state.image, z))
    result = assemble_result(objective, stack, progress, r0=None, n_modes=2)
    found = add_deviations(result, objective, stack, replace(progress, integrated=True), 5)
    scatter = torch.zeros(5, 3, dtype=torch.float64)
    for sample, frame in ((sample, frame) for sample in range(5) for frame in range(4)):
        scatter += (basis.mixing @ z[sample, frame]).view(5, 3) ** 2 / 20
    torch.testing.assert_close(found.coefficients_std, scatter.sqrt()[:, :2], rtol=1e-9, atol=0)
    torch.testing.assert_close(found.object_std, 2 * result.object, rtol=1e-12, atol=0)
