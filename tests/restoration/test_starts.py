"""Where a restoration begins: what is known, the first state, random candidates, an earlier result and new frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmask.restoration.aberrations import AberrationBasis
from torchmask.restoration.assembly import assemble_result
from torchmask.restoration.candidates import Candidates
from torchmask.restoration.checkpoint import Progress
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.frames import FrameStack
from torchmask.restoration.objective import Free
from torchmask.restoration.projected_lbfgs import Minimum, ProjectedLBFGS
from torchmask.restoration.schedule import Schedule
from torchmask.restoration.starts import (
    Known,
    expected_parameters,
    first_state,
    fit_new_frames,
    random_candidates,
    start_from_result,
)

UNIT = 500.0  # electrons
SOMETHING = torch.ones(2)


@pytest.mark.parametrize(
    ("known", "free"),
    [
        (Known(), Free.OBJECT | Free.ABERRATIONS | Free.COMMON),
        (Known(coefficients=SOMETHING), Free.OBJECT),
        (Known(coefficients=SOMETHING, covariance=SOMETHING), Free.OBJECT | Free.ABERRATIONS | Free.COMMON),
        (Known(object=SOMETHING), Free.ABERRATIONS | Free.COMMON),
        (Known(SOMETHING, SOMETHING, SOMETHING), Free.ABERRATIONS | Free.COMMON),
    ],
)
def test_what_is_known_exactly_is_not_free(known, free):
    known.check()
    assert known.free == free
    assert known.nothing == (known == Known())


def test_what_is_known_must_leave_something_open():
    with pytest.raises(ValueError, match="nothing is left to restore"):
        Known(coefficients=SOMETHING, object=SOMETHING).check()
    with pytest.raises(ValueError, match="covariance is given without coefficients"):
        Known(covariance=SOMETHING).check()


def test_what_is_known_may_be_arrays_and_lists_too():
    known = Known.of([[[1.0, 2.0]]], np.eye(2, dtype=">f4")[::-1], None)
    assert known.coefficients.tolist() == [[[1.0, 2.0]]]
    assert known.covariance.tolist() == [[0.0, 1.0], [1.0, 0.0]]
    assert {known.coefficients.dtype, known.covariance.dtype} == {torch.float64}
    assert known.object is None
    with pytest.raises(ValueError, match=r"known_object is torch\.complex128: it must be real"):
        Known.of(None, None, np.ones((2, 2), complex))
    with pytest.raises(ValueError, match="covariance is given without coefficients"):
        Known.of(None, np.eye(2), None)


def test_expected_parameters_are_those_of_the_coefficients(explained):
    objective, state = explained
    basis = objective.model.aberrations
    assert float(expected_parameters(objective, None).abs().max()) == 0
    found = expected_parameters(objective, basis.coefficients(state.z))
    torch.testing.assert_close(found, state.z, rtol=0, atol=1e-9)
    with pytest.raises(ValueError, match=r"coefficients has shape \(3, 5, 3\): it must be \(4, 5, 3\)"):
        expected_parameters(objective, basis.coefficients(state.z[:3]))
    with pytest.raises(ValueError, match="coefficients hold values that are not finite: leave out the frames"):
        expected_parameters(objective, basis.coefficients(state.z) / 0)


def test_the_first_object_is_the_clipped_mean_frame(explained, traits):
    objective, state = explained
    begun = first_state(objective, state.z, None, 30.0, replace(traits, prior_on_aberrations=False))
    mean = objective.frames.mean(0)
    assert float(mean.min()) < 0
    assert torch.equal(objective.model.window.crop(begun.image), mean.clamp(min=0))
    assert float(begun.image[32:].abs().sum() + begun.image[:, 32:].abs().sum()) == 0
    assert begun.z is state.z
    assert begun.calibration.noise_inflation.tolist() == [30.0] * 4
    assert begun.calibration.aberration_weight == 0
    assert first_state(objective, state.z, None, 30.0, traits).calibration.aberration_weight == 1
    brightness = objective.frames.mean((1, 2))
    torch.testing.assert_close(begun.calibration.transmission, brightness / brightness.mean())


def test_around_a_wide_object_there_is_light_at_first(explained, traits):
    """As much as in a mean pixel, whether the object is known or not."""
    objective, state = explained
    window, wide = objective.model.window, replace(traits, fills_field=True)
    for known in (None, window.crop(state.image)):
        image = first_state(objective, state.z, known, 30.0, wide).image
        inside = window.crop(image)
        around = torch.cat([image[32:].flatten(), image[:32, 32:].flatten()])
        torch.testing.assert_close(around, torch.full_like(around, float(inside.mean())))
        dark = window.crop(first_state(objective, state.z, known, 30.0, traits).image)
        torch.testing.assert_close(inside / inside.mean(), dark / dark.mean())


def test_a_known_object_is_scaled_to_the_frames(explained, traits):
    """Its own flux is in any units; negative pixels count as dark."""
    objective, state = explained
    window = objective.model.window
    known = 1e5 * window.crop(state.image)
    known[0, 0] = -3.0
    image = first_state(objective, state.z, known, 30.0, traits).image
    assert float(objective.model(image, state.z).mean()) == pytest.approx(1, rel=1e-12)
    torch.testing.assert_close(image / image.sum(), state.image / state.image.sum())
    with pytest.raises(ValueError, match=r"known_object has shape \(31, 32\): it must be \(32, 32\)"):
        first_state(objective, state.z, known[1:], 30.0, traits)
    for nothing in (0 * known, known / 0):
        with pytest.raises(ValueError, match=r"known_object holds .* not finite, or no light: give the light"):
            first_state(objective, state.z, nothing, 30.0, traits)


def test_candidates_are_those_of_the_seed(explained):
    objective, state = explained
    one, again, other = (random_candidates(objective, state, 3, 0.7, seed) for seed in (0, 0, 1))
    assert one.n_each == 3
    assert one.state.z.shape == (12, state.z.shape[1])
    assert torch.equal(one.state.z, again.state.z)
    assert not bool((one.state.z == other.state.z).any())
    rms = float(one.state.z.square().mean().sqrt())
    assert rms == pytest.approx(0.7, rel=4 / math.sqrt(2 * one.state.z.numel()))
    assert one.state.image is state.image


# --- an earlier result


def result_of(objective, state, r0=0.25):
    """As if a restoration had ended in this state."""
    frames = objective.frames
    variance = UNIT**2 / float(objective.precision.mean())
    stack = FrameStack(frames, torch.ones_like(frames, dtype=torch.bool), UNIT, variance)
    return assemble_result(objective, stack, Progress(Candidates(state, 1)), r0)


@pytest.fixture(scope="module")
def begin(traits):
    return lambda objective: first_state(objective, torch.zeros_like(objective.centre), None, 30.0, traits)


def test_an_earlier_result_gives_object_and_aberrations(explained, begin):
    objective, state = explained
    warm, n_known = start_from_result(objective, begin(objective), result_of(objective, state), 2 * UNIT)
    assert n_known == 4
    torch.testing.assert_close(warm.image, state.image / 2)  # the frames are twice as bright now
    torch.testing.assert_close(warm.z, state.z, rtol=0, atol=1e-9)
    assert warm.calibration.noise_inflation.tolist() == [30.0] * 4


def test_an_earlier_result_of_another_margin_gives_its_object_within_the_field(explained, begin):
    objective, state = explained
    begun, earlier = begin(objective), result_of(objective, state)
    narrow = replace(earlier, extended_object=earlier.extended_object[:33, :32])
    warm, _ = start_from_result(objective, begun, narrow, UNIT)
    expected = begun.image.clone()
    expected[:32, :32] = state.image[:32, :32]
    torch.testing.assert_close(warm.image, expected)


def test_what_is_known_now_is_not_taken_from_an_earlier_result(explained, begin):
    objective, state = explained
    begun = begin(objective)
    warm, _ = start_from_result(objective.with_changes(free=Free.OBJECT), begun, result_of(objective, state), UNIT)
    assert torch.equal(warm.z, begun.z)
    aberrations = objective.with_changes(free=Free.ABERRATIONS)
    warm, _ = start_from_result(aberrations, begun, result_of(objective, state), UNIT)
    assert torch.equal(warm.image, begun.image)


def test_frames_that_are_new_keep_their_own_and_take_what_is_common(five_holes, five_hole_basis, explain, begin):
    shared = AberrationBasis(five_hole_basis.mixing, 3, n_common=6)
    objective, state = explain(ExposureModel(five_holes, explain()[0].model.window.grid, shared))
    few = slice(0, 3)
    # The mean of what is each frame's own is common too, as far as that reaches: it is none.
    centred = shared.with_common_of(state.z - state.z[few].mean(0), state.z)
    earlier = result_of(objective.of_frames(few), replace(state, z=centred).of_frames(few))
    warm, n_known = start_from_result(objective, begin(objective), earlier, UNIT)
    assert n_known == 3
    torch.testing.assert_close(warm.z[few], centred[few], rtol=0, atol=1e-9)
    assert float(warm.z[3, : shared.n_own].abs().max()) == 0
    assert torch.equal(warm.z[3, shared.n_own :], warm.z[0, shared.n_own :])


def test_refuses_results_of_something_else(explained, begin):
    objective, state = explained
    result = result_of(objective, state)
    begun = begin(objective)
    for other, given in (
        (replace(result, coefficients=result.coefficients[:, :4]), r"4 holes and 3 modes: .* 5 holes and 3 modes"),
        (replace(result, coefficients=result.coefficients[..., :2]), r"5 holes and 2 modes: .* 5 holes and 3 modes"),
        (
            replace(result, extended_object=result.object, object=result.object[:30]),
            r"frames of 30 x 32 pixels: those .* have 32 x 32",
        ),
    ):
        with pytest.raises(ValueError, match=f"start is of .*{given}"):
            start_from_result(objective, begun, other, UNIT)
    with pytest.raises(ValueError, match=r"start is of 4 frames .*: at most 3 frames, 5 holes and 3 modes are needed"):
        start_from_result(objective.of_frames(slice(0, 3)), begun.of_frames(slice(0, 3)), result, UNIT)


@pytest.mark.parametrize("rms", [None, 0.7])
def test_new_frames_are_fitted_to_the_object(rms, explained):
    """From zero aberrations, or from random candidates, of which the best finds them, by about every other seed."""
    objective, state = explained
    schedule = Schedule(candidates=((4, 30), (2, 30)))
    z = state.z.clone()
    z[3] = 0
    begun = replace(state, z=z)
    evaluations = []

    def counting(cost, start, lower, *, max_iterations, callback):
        n_each = len(start) // state.z.shape[1]  # the object is known, and no part of what is sought
        found = ProjectedLBFGS()(cost, start, lower, max_iterations=max_iterations, callback=callback)
        evaluations.append(n_each * found.n_evaluations)
        return found

    fitted, spent = fit_new_frames(objective, begun, 3, rms, schedule, counting, seed=1)
    assert torch.equal(fitted.z[:3], state.z[:3])
    assert torch.equal(fitted.image, state.image)
    assert len(evaluations) == (1 if rms is None else 3)
    assert spent == pytest.approx(sum(evaluations) / 4, abs=2)  # of the whole stack; a last one in vain is not reported
    before, after = (objective.frame_costs(one.image, one.z, one.calibration)[3] for one in (begun, fitted))
    least = objective.frame_costs(state.image, state.z, state.calibration)[3]
    assert after < 0.3 * before
    if rms is not None:
        assert after < 1.001 * least


@pytest.mark.parametrize("n_new", [1, 2, 3])
def test_new_frames_cost_their_share_of_evaluations(n_new, explained):
    """Each evaluation of theirs is that of so many of the four frames, whatever it takes."""
    objective, state = explained

    def idle(cost, start, lower, *, max_iterations, callback):
        callback(start, cost(start)[0], 12)
        return Minimum(start, cost(start)[0], 1, 12, False, "idle")

    fitted, spent = fit_new_frames(objective, state, 4 - n_new, None, Schedule(), idle, seed=0)
    torch.testing.assert_close(fitted.z, state.z, rtol=1e-12, atol=0)
    assert spent == 12 * n_new // 4
