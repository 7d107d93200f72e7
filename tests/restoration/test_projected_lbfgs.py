"""Bounded descent against SciPy's L-BFGS-B, against the conditions of a minimum, and against direct linear algebra."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import Bounds, minimize

from torchmask.restoration.corrections import UpdatedCorrections
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS, minimize_bounded
from torchmask.restoration.variation import TotalVariation


def bowl(seed, n, dtype=torch.float64):
    """A quadratic of condition number about 1e3: (cost, Hessian, linear term)."""
    generator = torch.Generator().manual_seed(seed)
    basis = torch.linalg.qr(torch.randn(n, n, generator=generator, dtype=torch.float64)).Q
    hessian = (basis * torch.logspace(0, 3, n, dtype=torch.float64) @ basis.T).to(dtype)
    linear = (30 * torch.randn(n, generator=generator, dtype=torch.float64)).to(dtype)

    def cost(x):
        gradient = hessian @ x - linear
        return float(0.5 * x @ (gradient - linear)), gradient

    return cost, hessian, linear


def blurred(n=24):
    """Deconvolution of a star field with total variation, as the restoration has it for known PSFs."""
    generator = torch.Generator().manual_seed(3)
    transfer = torch.fft.rfft2(torch.rand(5, n, n, generator=generator, dtype=torch.float64) ** 8)
    truth = torch.zeros(n, n, dtype=torch.float64)
    truth[8:14, 5:16] = 1
    data = torch.fft.irfft2(transfer * torch.fft.rfft2(truth), s=truth.shape)
    data = data + 0.1 * torch.randn(data.shape, generator=generator, dtype=data.dtype)

    def cost(x):
        image = x.view(n, n)
        error = torch.fft.irfft2(transfer * torch.fft.rfft2(image), s=image.shape) - data
        slope = torch.fft.irfft2((transfer.conj() * torch.fft.rfft2(error)).sum(0), s=image.shape)
        variation, by_variation = TotalVariation().value_and_gradient(image)
        return float(0.5 * (error**2).sum() + variation), (slope + by_variation).flatten()

    return cost, torch.zeros(n * n, dtype=torch.float64)


def scipy_minimum(cost, start, lower):
    def of_array(x):
        value, gradient = cost(torch.from_numpy(x))
        return value, gradient.numpy()

    bounds = Bounds(lower.numpy(), np.full(len(lower), np.inf))
    options = {"maxiter": 5000, "maxfun": 20000, "maxcor": 20, "ftol": 1e-15, "gtol": 1e-9}
    return minimize(of_array, start.numpy(), jac=True, method="L-BFGS-B", bounds=bounds, options=options)


@given(seed=st.integers(0, 10**6), n=st.integers(1, 30))
@settings(max_examples=25, derandomize=True, deadline=None)
def test_a_convex_minimum_obeys_its_conditions(seed, n):
    cost, _, _ = bowl(seed, n)
    lower = torch.where(torch.rand(n, generator=torch.Generator().manual_seed(seed)) < 0.5, 0.0, -math.inf).double()
    found = minimize_bounded(
        cost, torch.ones(n).double(), lower, max_iterations=2000, cost_tolerance=0, gradient_tolerance=1e-7
    )
    gradient = cost(found.x)[1]
    assert bool((found.x >= lower).all())
    inside = found.x > lower
    assert float(gradient[inside].abs().sum()) < 1e-5 * n
    assert bool((gradient[~inside] >= 0).all())


def test_agrees_with_scipy_on_a_deconvolution():
    cost, start = blurred()
    theirs = scipy_minimum(cost, start, torch.zeros_like(start))
    found = minimize_bounded(cost, start, torch.zeros_like(start), max_iterations=5000, cost_tolerance=1e-15)
    assert found.converged
    assert found.value == pytest.approx(theirs.fun, rel=1e-9)
    # the misfit's curvature holds the pixels: a difference of 1e-9 in the cost is one of 1e-4 in them at most
    np.testing.assert_allclose(found.x.numpy(), theirs.x, atol=1e-4)
    assert found.n_evaluations < 1.5 * theirs.nfev


def test_as_few_evaluations_as_scipy_where_the_valley_bends():
    def rosenbrock(x):
        x = x.detach().requires_grad_()
        value = (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()
        (gradient,) = torch.autograd.grad(value, x)
        return value.item(), gradient

    start = torch.full((20,), -1.2, dtype=torch.float64)
    lower = torch.full_like(start, -math.inf)
    lower[::3] = -0.5
    start[::3] = 0.3
    theirs = scipy_minimum(rosenbrock, start, lower)
    found = minimize_bounded(rosenbrock, start, lower, max_iterations=1000, cost_tolerance=0, gradient_tolerance=1e-7)
    assert found.converged
    torch.testing.assert_close(found.x, torch.ones_like(start), rtol=0, atol=1e-6)
    assert found.n_evaluations < 2 * theirs.nfev


def test_float32_and_a_start_outside_the_bounds():
    cost, _, _ = bowl(5, 10, torch.float32)
    exact, _, _ = bowl(5, 10)
    lower = torch.zeros(10)
    found = minimize_bounded(cost, torch.full((10,), -3.0), lower, max_iterations=300)
    assert found.x.dtype == torch.float32
    assert bool((found.x >= 0).all())
    best = scipy_minimum(exact, torch.zeros(10).double(), lower.double()).fun
    assert exact(found.x.double())[0] == pytest.approx(best, rel=1e-5)  # rounding of the cost at its minimum


def test_says_why_it_stopped_and_keeps_to_its_budgets():
    cost, _, _ = bowl(7, 20)
    start, lower = torch.ones(20).double(), torch.zeros(20).double()
    seen = []
    found = minimize_bounded(
        cost, start, lower, max_iterations=5, callback=lambda x, value, evaluations: seen.append((value, evaluations))
    )
    assert found.message == "5 iterations"
    assert not found.converged
    assert found.n_iterations == len(seen) == 5
    assert seen[-1] == (found.value, found.n_evaluations)
    assert all(later[0] < earlier[0] for earlier, later in itertools.pairwise(seen))
    assert minimize_bounded(cost, start, lower, max_iterations=50, max_evaluations=7).n_evaluations == 7
    assert minimize_bounded(cost, start, lower, max_iterations=50, max_evaluations=0).n_evaluations == 1  # at the start
    # every variable pushed on its bound
    at_rest = minimize_bounded(lambda x: (float(x.sum()), torch.ones_like(x)), lower, lower, max_iterations=5)
    assert at_rest.converged
    assert at_rest.n_iterations == 0


def test_bad_input_is_refused():
    cost, _, _ = bowl(0, 3)
    with pytest.raises(ValueError, match="shapes"):
        minimize_bounded(cost, torch.ones(3).double(), torch.zeros(2).double(), max_iterations=1)
    with pytest.raises(ValueError, match="finite"):
        minimize_bounded(lambda x: (math.nan, x), torch.ones(3), torch.zeros(3), max_iterations=1)
    with pytest.raises(ValueError, match="finite"):
        minimize_bounded(lambda x: (-math.inf, x), torch.ones(3), torch.zeros(3), max_iterations=1)


@pytest.mark.parametrize("number", [math.nan, math.inf])
def test_a_gradient_that_is_no_number_is_no_minimum(number):
    start = torch.ones(3).double()
    found = minimize_bounded(lambda x: (1.0, x * number), start, torch.zeros(3).double(), max_iterations=5)
    assert not found.converged
    assert found.message == f"the gradient is {number}"
    assert torch.equal(found.x, start)


def test_the_number_of_corrections_is_passed_on():
    """With none kept it is steepest descent, which needs more iterations than it is given here."""
    cost, _, _ = bowl(7, 20)
    start, lower = torch.ones(20).double(), torch.full((20,), -math.inf).double()
    few, many = (ProjectedLBFGS(n)(cost, start, lower, max_iterations=60) for n in (1, 20))
    assert torch.equal(many.x, minimize_bounded(cost, start, lower, max_iterations=60, n_corrections=20).x)
    assert torch.equal(few.x, minimize_bounded(cost, start, lower, max_iterations=60, n_corrections=1).x)
    assert many.value < few.value


def test_pairs_without_a_solution_are_forgotten(monkeypatch):
    """Where their equations are singular, the direction is NaN: the cost is not asked there."""
    cost, hessian, linear = bowl(seed=0, n=8)
    solve, failures, seen = UpdatedCorrections.solve, [], []

    def fails_once(memory, gradient, free):
        if len(memory) == 3 and not failures:
            failures.append(True)
            return gradient * math.nan
        return solve(memory, gradient, free)

    def watched(x):
        seen.append(bool(torch.isfinite(x).all()))
        return cost(x)

    monkeypatch.setattr(UpdatedCorrections, "solve", fails_once)
    start = torch.zeros(8, dtype=torch.float64)
    found = minimize_bounded(watched, start, torch.full_like(start, -math.inf), max_iterations=200)
    assert failures
    assert all(seen)
    torch.testing.assert_close(found.x, torch.linalg.solve(hessian, linear), rtol=1e-5, atol=1e-6)
