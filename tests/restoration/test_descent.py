"""One descent: its scales, its bounds, its budget and what it tells its listener."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.restoration.aberrations import AberrationBasis
from torchmask.restoration.descent import descend, place_scale, scales
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.objective import Free
from torchmask.restoration.placement import placed_as, smallest_magnification
from torchmask.restoration.projected_lbfgs import Minimum, ProjectedLBFGS


def test_the_hessian_is_about_one_in_the_scaled_variables(explained):
    """Of the aberrations: its diagonal by the Jacobian, estimated with 4 probes a frame; the object's step is 0.3."""
    objective, state = explained
    image_scale, z_scale = scales(objective, state)
    exact = torch.stack(
        [
            (torch.autograd.functional.jacobian(lambda a: objective.model(state.image, a[None])[0], z) ** 2).sum((0, 1))
            for z in state.z
        ]
    )
    exact = exact * objective.precision.item()
    scatter = (2 / 4 * (exact**2).sum(0)).sqrt() / len(state.z)
    assert bool(((1 / z_scale**2 - 1 - exact.mean(0)).abs() < 4.5 * scatter).all())  # 1: that of the prior
    energy = float((objective.model.psf(state.z) ** 2).sum()) * objective.precision.item()
    expected = 0.3 / (energy + objective.prior.curvature(state.image)).sqrt()
    torch.testing.assert_close(image_scale, expected)


def test_what_nothing_holds_has_a_finite_scale(five_holes, five_hole_basis, explain):
    """A parameter that does nothing, without a prior on it."""
    mixing = torch.nn.functional.pad(five_hole_basis.mixing, (0, 1))
    grid = explain()[0].model.window.grid
    objective, state = explain(ExposureModel(five_holes, grid, AberrationBasis(mixing, 3)))
    z_scale = scales(objective, state.calibrated(aberration_weight=0.0))[1]
    assert float(z_scale[-1]) == pytest.approx(1e3 * float(z_scale.min()), rel=1e-9)


def test_a_descent_lowers_the_cost_within_its_bounds_and_budget(explained):
    objective, state = explained
    begun = replace(state, image=objective.frames.mean() * torch.ones_like(state.image), z=0 * state.z)
    evaluate, told = objective.evaluator(begun.calibration), []

    def listen(cost, evaluations, variables):
        told.append((cost, evaluations, *variables()))

    found = descend(objective, begun, 12, ProjectedLBFGS(), listen)
    assert len(told) == 12
    costs = [cost for cost, *_ in told]
    assert costs == sorted(costs, reverse=True)
    assert costs[0] < float(evaluate(begun.image, begun.z).value)
    assert all(evaluations >= 1 for _, evaluations, *_ in told)
    for cost, _, image, z in told:
        assert cost == pytest.approx(float(evaluate(image, z).value), rel=1e-12)
    assert torch.equal(found.image, told[-1][2])
    assert torch.equal(found.z, told[-1][3])
    assert bool((found.image >= 0).all())
    assert bool((found.image == 0).any())  # the bound holds somewhere
    assert found.calibration is begun.calibration


@pytest.mark.parametrize("free", [Free.OBJECT, Free.ABERRATIONS])
def test_what_is_known_stays(free, explained):
    objective, state = explained
    begun = replace(state, image=state.image + 0.5, z=state.z + 0.1)
    found = descend(objective.with_changes(free=free), begun, 3, ProjectedLBFGS(), lambda *_: None)
    kept, moved = ("z", "image") if free is Free.OBJECT else ("image", "z")
    torch.testing.assert_close(getattr(found, kept), getattr(begun, kept), rtol=1e-13, atol=0)
    assert not torch.allclose(getattr(found, moved), getattr(begun, moved))


@pytest.mark.parametrize("shrinkage", [0.01, 5.0])
def test_a_mask_shrinks_no_further_than_its_holes_can_be_sampled(shrinkage, explained):
    """The minimiser has no upper bounds; where it goes beyond, the descent ends at the limit."""
    objective, state = explained
    objective = objective.with_changes(free=objective.free | Free.PLACE)
    unit = place_scale(objective, state)

    def beyond(cost, start, lower, **_):
        end = torch.cat([start[:-2], torch.tensor([0.02, shrinkage], dtype=start.dtype) / unit])
        return Minimum(end, cost(start)[0], 1, 1, True, "far away")

    found = descend(objective, state, 1, beyond, lambda *_: None)
    least = smallest_magnification(objective.model)
    assert found.geometry.rotation == pytest.approx(0.02, rel=1e-9)
    assert found.geometry.magnification == pytest.approx(max(math.exp(-shrinkage), least), rel=1e-12)
    placed_as(objective, objective.model.pupil.aperture, found.geometry)  # its holes can be sampled


def test_a_minimizer_sees_one_vector_with_the_object_above_zero(explained):
    objective, state = explained
    n, seen = state.image.numel(), {}

    def look(cost, start, lower, *, max_iterations, callback):
        seen.update(start=start, lower=lower, max_iterations=max_iterations, slope=cost(start)[1])
        return Minimum(start, cost(start)[0], 0, 1, True, "seen enough")

    found = descend(objective, state, 9, look, lambda *_: None)
    torch.testing.assert_close(found.image, state.image)
    assert seen["max_iterations"] == 9
    assert seen["start"].shape == seen["lower"].shape == seen["slope"].shape == (n + state.z.numel(),)
    assert bool((seen["lower"][:n] == 0).all())
    assert bool((seen["lower"][n:] == -torch.inf).all())
    image_scale, z_scale = scales(objective, state)
    gradients = objective.value_and_gradients(state.image, state.z, state.calibration)
    expected = torch.cat(
        [(gradients.object_gradient * image_scale).flatten(), (gradients.aberration_gradient * z_scale).flatten()]
    )
    torch.testing.assert_close(seen["slope"], expected)
