"""Many descents at once, on functions whose minima, steps and ends are known in closed form."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.design.descent import BatchedBFGS

ROUNDS = 2000  # more than any descent below takes


def evaluate(function, x):
    """Values (P,) and gradients (P, F) of a function of (P, F)."""
    x = x.detach().requires_grad_()
    values = function(x)
    (gradient,) = torch.autograd.grad(values.sum(), x)
    return values.detach(), gradient


def follow(descent, function, rounds=ROUNDS):
    """Values at every round (R, P), until all problems rest."""
    seen = []
    while not bool(descent.finished.all()) and len(seen) < rounds:
        values, gradients = evaluate(function, descent.ask())
        descent.tell(values, gradients)
        seen.append(descent.values.clone())
    return torch.stack(seen)


def rosenbrock(x):
    """Minimum 0 at (1, 1), at the end of a bent valley."""
    return 100 * (x[:, 1] - x[:, 0] ** 2) ** 2 + (1 - x[:, 0]) ** 2


def bowls(curvatures, minima):
    """One quadratic for each problem: curvatures (P, F), minima (P, F)."""
    return lambda x: (curvatures * (x - minima) ** 2).sum(-1) / 2


def column(*values, dtype=torch.float64):
    return torch.tensor(values, dtype=dtype)[:, None]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_bent_valley_is_followed_to_its_end(dtype):
    start = torch.tensor([[-1.2, 1.0], [0.0, 0.0], [3.0, -2.0]], dtype=dtype)
    # Values of the function are rounded to eps around 1e-1 to 1; a promise below that is none.
    tolerance = 1e-12 if dtype == torch.float64 else 1e-8
    descent = BatchedBFGS(start, first_step=0.5, tolerance=tolerance)
    values = follow(descent, rosenbrock)
    assert descent.points.dtype == dtype
    # f is at least 0.2 |x - 1|^2 near the minimum (the smaller eigenvalue of half its Hessian), and the promised
    # decrease is of the order of f itself.
    assert float(descent.values.max()) < 100 * tolerance
    assert float((descent.points - 1).abs().max()) < math.sqrt(500 * tolerance)
    assert len(values) < 150  # textbooks: 20 to 50 iterations, each with one or two evaluations


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.integers(1, 6), st.integers(1, 5), st.integers(0, 10_000))
def test_every_convex_quadratic_ends_in_its_minimum(size, n, seed):
    rng = np.random.default_rng(seed)
    turn = torch.from_numpy(np.linalg.qr(rng.normal(size=(n, size, size)))[0])
    hessian = turn @ torch.diag_embed(torch.from_numpy(10 ** rng.uniform(-1, 2, (n, size)))) @ turn.mT
    minimum = torch.from_numpy(rng.normal(size=(n, size)))

    def function(x):
        away = x - minimum
        return 7 + (away[:, None] @ hessian @ away[..., None])[:, 0, 0] / 2

    descent = BatchedBFGS(torch.zeros(n, size, dtype=torch.float64), first_step=1.0, tolerance=1e-13)
    values = follow(descent, function)
    assert len(values) < ROUNDS
    # Half the promise g' H g is the height above the minimum, as far as H is the inverse Hessian.
    assert float((descent.values - 7).max()) < 1e-10
    assert float((descent.values - 7).min()) > -1e-14
    assert torch.allclose(descent.points, minimum, rtol=0, atol=math.sqrt(2 * 1e-10 / 0.1))


def test_problems_of_a_batch_know_nothing_of_each_other():
    minima = torch.tensor([[0.3, -0.2], [4.0, 1.0], [-2.0, 5.0]], dtype=torch.float64)
    curvatures = torch.tensor([[1.0, 30.0], [5.0, 0.2], [2.0, 2.0]], dtype=torch.float64)
    start = torch.zeros(3, 2, dtype=torch.float64)
    together = BatchedBFGS(start, first_step=0.7, tolerance=1e-12)
    seen = follow(together, bowls(curvatures, minima))
    for k in range(3):
        alone = BatchedBFGS(start[k : k + 1], first_step=0.7, tolerance=1e-12)
        own = follow(alone, bowls(curvatures[k : k + 1], minima[k : k + 1]))
        assert len(own) <= len(seen)
        assert torch.allclose(own[:, 0], seen[: len(own), k], rtol=1e-9, atol=1e-18)
        assert torch.allclose(seen[len(own) :, k], own[-1, 0], rtol=1e-9, atol=1e-18)  # at rest while others go on
        assert torch.allclose(alone.points[0], together.points[k], rtol=0, atol=1e-9)


def test_one_evaluation_a_round_and_all_of_the_points_that_were_asked():
    descent = BatchedBFGS(torch.ones(4, 3, dtype=torch.float64), first_step=0.1, tolerance=1e-9)
    for _ in range(5):
        points = descent.ask()
        assert points.shape == (4, 3)
        assert torch.equal(points, descent.ask())  # asking changes nothing
        descent.tell(*evaluate(bowls(torch.ones(4, 3), torch.zeros(4, 3)), points))


def test_the_first_step_is_as_long_as_it_was_told_and_none_is_longer():
    start = torch.tensor([[-1.2, 1.0], [5.0, 5.0]], dtype=torch.float64)
    descent = BatchedBFGS(start, first_step=0.05, tolerance=1e-12)
    assert torch.equal(descent.ask(), start)
    descent.tell(*evaluate(rosenbrock, descent.ask()))
    before, longest = descent.points.clone(), 0.0
    assert torch.allclose((descent.ask() - start).norm(dim=-1), torch.full((2,), 0.05, dtype=torch.float64), rtol=1e-12)
    while not bool(descent.finished.all()):
        descent.tell(*evaluate(rosenbrock, descent.ask()))
        longest = max(longest, float((descent.points - before).norm(dim=-1).max()))
        before = descent.points.clone()
    assert 0.0499 < longest < 0.05 * (1 + 1e-12)


def test_values_never_rise_and_every_step_keeps_its_promise():
    start = torch.tensor([[-1.2, 1.0], [2.0, 2.0], [0.0, 3.0]], dtype=torch.float64)
    descent = BatchedBFGS(start, first_step=1.0, tolerance=1e-12)
    descent.tell(*evaluate(rosenbrock, descent.ask()))
    accepted = 0
    while not bool(descent.finished.all()):
        asked, before, values = descent.ask(), descent.points.clone(), descent.values.clone()
        slope = (descent.gradients * (asked - before)).sum(-1)  # of the whole step
        descent.tell(*evaluate(rosenbrock, asked))
        moved = (descent.points != before).any(-1)
        accepted += int(moved.sum())
        assert bool((descent.values[moved] <= values[moved] + 1e-4 * slope[moved]).all())
        assert torch.equal(descent.values[~moved], values[~moved])
    assert accepted > 30


@pytest.mark.parametrize(
    ("first_step", "second"),
    [
        (4.0, 0.0),  # the parabola through both values and the slope is the function: its minimum, 1 / 4 of the step
        (20.0, -1.0),  # 1 / 20 of the step would be less than a tenth
    ],
)
def test_a_step_too_long_is_shortened_by_the_parabola_within_a_tenth_and_a_half(first_step, second):
    descent = BatchedBFGS(column(1.0), first_step=first_step, tolerance=1e-12)
    function = bowls(column(1.0), column(0.0))
    descent.tell(*evaluate(function, descent.ask()))
    assert float(descent.ask()) == pytest.approx(1 - first_step, rel=1e-12)
    descent.tell(*evaluate(function, descent.ask()))
    assert float(descent.points) == 1.0
    assert float(descent.ask()) == pytest.approx(second, abs=1e-12)


def test_a_step_that_hardly_gains_is_halved_at_least():
    """From 1 by 2 - 1e-4 down x^2 / 2 gains half of what the rule of Armijo asks for; the parabola would say 1."""
    descent = BatchedBFGS(column(1.0), first_step=2 - 1e-4, tolerance=1e-12)
    for _ in range(2):
        descent.tell(*evaluate(bowls(column(1.0), column(0.0)), descent.ask()))
    assert float(descent.points) == 1.0
    assert float(descent.ask()) == pytest.approx(5e-5, rel=1e-9)


def test_where_there_is_no_value_the_step_is_a_tenth():
    """A wall at 0, behind which the logarithm is NaN; the minimum of x - log x is 1 at 1."""

    def walled(x):
        return (x - x.log())[:, 0]

    descent = BatchedBFGS(column(3.0), first_step=8.0, tolerance=1e-13)
    descent.tell(*evaluate(walled, descent.ask()))
    assert float(descent.ask()) == pytest.approx(-5.0)
    descent.tell(*evaluate(walled, descent.ask()))
    assert float(descent.ask()) == pytest.approx(2.2)
    follow(descent, walled)
    assert float(descent.points) == pytest.approx(1.0, abs=1e-6)
    assert float(descent.values) == pytest.approx(1.0, abs=1e-12)


def test_a_start_without_a_value_is_left_as_soon_as_one_is_found_or_given_up():
    descent = BatchedBFGS(column(1.0), first_step=1.0, tolerance=1e-12)
    rounds = follow(descent, lambda x: x[:, 0] * math.nan)
    assert bool(descent.finished)
    assert math.isinf(float(descent.values))
    assert float(descent.points) == 1.0
    assert len(rounds) == 11  # tenth by tenth, from 1 to below 1e-10


def test_a_minimum_is_known_where_it_is():
    descent = BatchedBFGS(column(2.0, 2.5), first_step=1.0, tolerance=1e-12)
    descent.tell(*evaluate(bowls(column(3.0, 3.0), column(2.0, 2.0)), descent.ask()))
    assert descent.finished.tolist() == [True, False]
    assert float(descent.ask()[0]) == 2.0


@pytest.mark.parametrize("patience", [1, 7])
def test_patience_counts_steps(patience):
    """Down an endless slope every step is accepted, and as long as the first."""
    descent = BatchedBFGS(column(0.0), first_step=0.25, tolerance=1e-12, patience=patience)
    rounds = follow(descent, lambda x: -x[:, 0])
    assert len(rounds) == patience + 1  # and the start
    assert float(descent.points) == pytest.approx(0.25 * patience, rel=1e-12)


def test_a_gradient_that_leads_uphill_ends_where_it_began():
    descent = BatchedBFGS(column(1.0), first_step=1.0, tolerance=1e-12)

    def told(x):
        return x[:, 0].clone(), -torch.ones_like(x)

    rounds = 0
    while not bool(descent.finished):
        descent.tell(*told(descent.ask()))
        rounds += 1
    assert float(descent.points) == 1.0
    assert float(descent.values) == 1.0
    # Ten steps where each is a tenth of the one before, 34 where it is a half.
    assert 10 < rounds <= 35


def test_the_tolerance_is_the_promise_that_ends_a_descent():
    """On x^2 / 2 the first step from 1, of length 1/2, promises 1/2: a tolerance above it ends there."""
    for tolerance, finished in ((0.49, False), (0.51, True)):
        descent = BatchedBFGS(column(1.0), first_step=0.5, tolerance=tolerance)
        descent.tell(*evaluate(bowls(column(1.0), column(0.0)), descent.ask()))
        assert bool(descent.finished) is finished


def test_what_rests_stays_whatever_it_is_told():
    descent = BatchedBFGS(column(2.0), first_step=1.0, tolerance=1e-12)
    descent.tell(*evaluate(bowls(column(1.0), column(2.0)), descent.ask()))
    assert bool(descent.finished)
    descent.tell(column(-5.0)[0], column(1.0))
    assert float(descent.points) == 2.0
    assert float(descent.values) == 0.0
    assert bool(descent.finished)


@pytest.mark.parametrize("members", [torch.tensor([1]), torch.tensor([False, True, False]), slice(1, 2)])
def test_a_restarted_problem_is_as_new_and_the_others_go_on(members):
    start, anew = torch.tensor([[-1.2, 1.0], [2.0, 2.0], [0.0, 3.0]]).double(), torch.tensor([[-1.0, -1.0]]).double()
    descent, untouched = (BatchedBFGS(start, first_step=0.5, tolerance=1e-12) for _ in range(2))
    for _ in range(9):
        for each in (descent, untouched):
            each.tell(*evaluate(rosenbrock, each.ask()))
    descent.restart(members, anew)
    fresh = BatchedBFGS(anew, first_step=0.5, tolerance=1e-12)
    for _ in range(12):
        assert torch.allclose(descent.ask()[1], fresh.ask()[0], rtol=1e-9)
        assert torch.allclose(descent.ask()[[0, 2]], untouched.ask()[[0, 2]], rtol=1e-9)
        for each in (descent, untouched, fresh):
            each.tell(*evaluate(rosenbrock, each.ask()))


def test_directions_are_those_of_the_textbook():
    """Nocedal & Wright, Numerical Optimization, eqs. 6.17 and 6.20, with their matrices written out."""
    start = torch.tensor([[-1.2, 1.0]], dtype=torch.float64)
    descent = BatchedBFGS(start, first_step=0.5, tolerance=1e-12)
    descent.tell(*evaluate(rosenbrock, descent.ask()))
    inverse, updates = np.eye(2), 0
    while updates < 6:
        point, gradient = descent.points[0].numpy().copy(), descent.gradients[0].numpy().copy()
        descent.tell(*evaluate(rosenbrock, descent.ask()))
        s, y = descent.points[0].numpy() - point, descent.gradients[0].numpy() - gradient
        if not s.any():
            continue
        assert s @ y > 0  # a pair of positive curvature
        scaled = inverse * (s @ y) / (y @ y) if updates == 0 else inverse
        left = np.eye(2) - np.outer(s, y) / (s @ y)
        inverse = left @ scaled @ left.T + np.outer(s, s) / (s @ y)
        expected = -inverse @ descent.gradients[0].numpy()
        step = (descent.ask() - descent.points)[0].numpy()
        np.testing.assert_allclose(step, expected * min(1, 0.5 / np.linalg.norm(expected)), rtol=1e-9)
        updates += 1


def test_a_finished_problem_works_again_after_a_restart():
    descent = BatchedBFGS(column(2.0), first_step=1.0, tolerance=1e-12)
    function = bowls(column(1.0), column(2.0))
    follow(descent, function)
    descent.restart(slice(None), column(-4.0))
    assert not bool(descent.finished)
    assert float(descent.ask()) == -4.0
    follow(descent, function)
    assert float(descent.points) == pytest.approx(2.0, abs=1e-6)
