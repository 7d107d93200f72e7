"""The memory of the descent, both ways to keep it, against the BFGS matrix by its own recursion."""

import math
from functools import partial

import pytest
import torch

from torchmask.restoration.corrections import GraphedCorrections, UpdatedCorrections, make_corrections

WAYS = [partial(UpdatedCorrections, dtype=torch.float64), GraphedCorrections]


def curved(n):
    """A Hessian of condition number 1e3."""
    basis = torch.linalg.qr(draw(n, n, seed=1)).Q
    return basis * torch.logspace(0, 3, n, dtype=torch.float64) @ basis.T


def draw(*shape, seed):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def is_free(n, seed, share=0.7):
    return torch.rand(n, generator=torch.Generator().manual_seed(seed)) < share


def bfgs_matrix(pairs, n):
    """B by its recursion (Nocedal & Wright 2006, eq. 6.19), from the last pair's curvature on."""
    b = torch.eye(n, dtype=torch.float64)
    if pairs:
        b = b * (pairs[-1][1] @ pairs[-1][1]) / (pairs[-1][0] @ pairs[-1][1])
    for s, y in pairs:
        b = b - torch.outer(b @ s, b @ s) / (s @ b @ s) + torch.outer(y, y) / (y @ s)
    return b


def feed(memory, hessian, n_pairs, first=0):
    """Add pairs as in a descent, where steps move what was free at the last solution."""
    n, pairs = len(hessian), []
    for number in range(first, first + n_pairs):
        free = is_free(n, number)
        memory.solve(draw(n, seed=number).to(hessian), free)
        step = draw(n, seed=100 + number).to(hessian) * free
        memory.add(step, hessian @ step)
        pairs.append((step, hessian @ step))
    return pairs


def require_solutions(memory, pairs, n):
    """Twice: the second time only some variables have changed sides."""
    b = bfgs_matrix(pairs, n)
    gradient = draw(n, seed=1000)
    for seed in (1, 2):
        free = is_free(n, seed, 0.6)
        expected = torch.zeros(n, dtype=torch.float64)
        expected[free] = torch.linalg.solve(b[free][:, free], gradient[free])
        torch.testing.assert_close(memory.solve(gradient, free), expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("n_pairs", [0, 1, 3, 5, 9])
def test_inverse_hessian_is_that_of_the_bfgs_matrix(way, n_pairs):
    n, size = 12, 5
    memory = way(size, torch.zeros(n, dtype=torch.float64))
    pairs = feed(memory, curved(n), n_pairs)
    assert len(memory) == min(n_pairs, size)
    require_solutions(memory, pairs[-size:], n)


@pytest.mark.parametrize("way", WAYS)
def test_pairs_that_were_forgotten_leave_no_trace(way):
    n, size = 12, 5
    memory = way(size, torch.zeros(n, dtype=torch.float64))
    feed(memory, curved(n), 7)
    memory.forget()
    assert len(memory) == 0
    require_solutions(memory, [], n)
    require_solutions(memory, feed(memory, curved(n), 2, first=50), n)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("factor", [-1.0, 0.0, 1e-17, math.nan])
def test_pairs_without_curvature_are_not_kept(way, factor):
    memory = way(3, torch.zeros(2, dtype=torch.float64))
    memory.add(torch.tensor([1.0, 0.0]).double(), torch.tensor([factor, 1.0]).double())
    assert len(memory) == 0
    require_solutions(memory, [], 2)


@pytest.mark.parametrize("vectors", [torch.float32, torch.float64])
def test_pairs_in_float32(vectors):
    """Solutions differ by the rounding of sums over 500 variables, times the condition of a Hessian of 1e3."""
    n = 500
    solutions = []
    for memory in (
        UpdatedCorrections(4, torch.zeros(n, dtype=vectors), torch.float32),
        GraphedCorrections(4, torch.zeros(n, dtype=vectors)),
    ):
        feed(memory, curved(n).to(vectors), 6)
        solutions.append(memory.solve(draw(n, seed=6).to(vectors), is_free(n, 1)))
    assert solutions[0].dtype == vectors
    error = (solutions[1] - solutions[0]).norm() / solutions[0].norm()
    assert float(error) < 1e3 * n**0.5 * torch.finfo(torch.float32).eps


def test_a_processor_has_its_products_updated():
    memory = make_corrections(3, torch.zeros(2, dtype=torch.float64))
    assert isinstance(memory, UpdatedCorrections)
    assert memory.solve(torch.ones(2).double(), torch.ones(2) > 0).dtype == torch.float64
    assert isinstance(make_corrections(3, torch.zeros(2, device="meta")), GraphedCorrections)
