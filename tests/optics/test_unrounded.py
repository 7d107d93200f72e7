"""Products that autocast does not round, forwards and backwards."""

import pytest
import torch

from torchmask.optics.unrounded import product


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_product_and_its_gradients_keep_their_precision(dtype):
    generator = torch.Generator().manual_seed(0)
    left, right = (torch.randn(30, 30, dtype=dtype, generator=generator).requires_grad_() for _ in range(2))
    expected = left @ right
    slopes = torch.autograd.grad((expected**2).sum(), (left, right))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = product(left, right)
        again = torch.autograd.grad((found**2).sum(), (left, right))
    assert found.dtype == dtype
    for one, other in zip((found, *again), (expected, *slopes), strict=True):
        assert float((one - other).detach().abs().max()) < 8 * torch.finfo(dtype).eps * float(other.detach().norm())


def test_without_autocast_it_is_the_product_itself_on_any_device():
    left, right = torch.rand(5, 7), torch.rand(7, 3)
    assert torch.equal(product(left, right), left @ right)
    assert product(left.to("meta"), right.to("meta")).shape == (5, 3)
