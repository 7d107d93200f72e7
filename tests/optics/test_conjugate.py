"""Conjugate gradients against direct linear algebra."""

import torch

from torchmask.optics.conjugate import conjugate_gradients


def test_conjugate_gradients_solve():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(12, 12, dtype=torch.float64, generator=generator)
    matrix = root @ root.T + torch.eye(12, dtype=torch.float64)
    right = torch.randn(4, 12, dtype=torch.float64, generator=generator)
    found = conjugate_gradients(lambda x: x @ matrix, right, lambda x: x / matrix.diagonal(), 50)
    torch.testing.assert_close(found, torch.linalg.solve(matrix, right.T).T, rtol=1e-9, atol=1e-9)


def test_what_is_zero_stays_zero_and_what_is_solved_stays_solved():
    """A right side of zeros beside another, and more iterations than unknowns: nothing divides by zero."""
    right = torch.tensor([[1.0, 2.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    found = conjugate_gradients(lambda x: 4 * x, right, lambda x: x, 10)
    torch.testing.assert_close(found, right / 4, rtol=0, atol=1e-15)
