"""Local slopes of an image, and the metric that evens them out, against images whose slopes are known."""

import math

import pytest
import torch

from torchmask.restoration.slopes import gradient
from torchmask.restoration.structure import even_metric, smooth


def rough(rows=24, columns=31, dtype=torch.float64):
    return torch.rand(rows, columns, dtype=dtype, generator=torch.Generator().manual_seed(3))


def halves(steep, gentle=1.0, side=64):
    """Zigzags along x: their slopes are all `gentle` in the left half, all `steep` in the right one."""
    x = torch.arange(side)
    height = torch.where(x < side // 2, torch.tensor(gentle).double(), torch.tensor(steep).double())
    return (height * (x % 2)).expand(side, side)


def test_smooth_is_a_gaussian_of_that_width():
    point = torch.zeros(64, 48, dtype=torch.float64)
    point[20, 30] = 1
    y, x = torch.meshgrid(torch.arange(64.0) - 20, torch.arange(48.0) - 30, indexing="ij")
    expected = torch.exp(-(y**2 + x**2) / (2 * 3.0**2)) / (2 * math.pi * 3.0**2)
    torch.testing.assert_close(smooth(point, 3.0), expected.double(), rtol=0, atol=1e-8)  # float32 distances


def test_an_image_without_slopes_has_no_metric():
    assert even_metric(torch.full((8, 9), 3.0), 1.0) is None


@pytest.mark.parametrize("reach", [0.5, 1.0, 3.0])
def test_all_slopes_together_cost_what_they_did(reach):
    image = rough()
    metric = even_metric(image, reach)
    length = torch.hypot(*gradient(image))
    assert float(torch.hypot(*metric.of(*gradient(image))).sum()) == pytest.approx(float(length.sum()), rel=1e-12)
    assert float((metric.size * length).sum()) == pytest.approx(float(length.sum()), rel=1e-12)


@pytest.mark.parametrize("steep", [1.0, 3.0, 10.0])
def test_slopes_count_by_the_power_of_the_local_slope(steep):
    """Far from where the halves meet, at eight deviations of the local mean, whose ripples are below 1e-8."""
    metric = even_metric(halves(steep), 2.0)
    for counts in (metric.xx, metric.size):
        assert float(counts[32, 48] / counts[32, 16]) == pytest.approx(steep**-0.7, rel=1e-6)
    assert float(metric.xy.abs().max()) < 1e-12 * float(metric.xx.max())


def test_slopes_along_an_edge_count_as_those_of_an_even_image():
    """A zigzag along x has none along y: they count as slopes of a twentieth of its own, the smallest that is told."""
    metric = even_metric(halves(1.0), 1.0)
    across, size = metric.xx[32, 16], metric.size[32, 16]
    assert float(across) == pytest.approx(1.0, rel=1e-9)
    assert float(size) == pytest.approx(1.0, rel=1e-9)
    # its mean over both directions has half the square of its slope, which is the unit
    assert float(metric.yy[32, 16] / across) == pytest.approx((0.05 / math.sqrt(2)) ** -0.7, rel=1e-9)


def test_where_an_image_is_even_slopes_count_the_more_but_not_without_end():
    image = halves(1.0, gentle=0.0)
    metric = even_metric(image, 1.0)
    ratio = float(metric.size[32, 16] / metric.size[32, 48])
    length = torch.hypot(*gradient(image))
    unit = smooth(length**2, 1.0) / 2
    mean = float((unit * length).sum() / length.sum())
    assert ratio == pytest.approx((0.05 / math.sqrt(float(unit[32, 48]) / mean)) ** -0.7, rel=1e-9)


def test_a_diagonal_edge_has_a_diagonal_metric():
    """Across it, along (1, 1), slopes count little; along it, (1, -1), much."""
    y, x = torch.meshgrid(torch.arange(32), torch.arange(32), indexing="ij")
    metric = even_metric(torch.sin(2 * math.pi * (x + y).double() / 8), 1.5)
    across, along = (metric.of(*pair) for pair in ((torch.ones(()), torch.full((), sign)) for sign in (1.0, -1.0)))
    assert float(torch.hypot(*across).max()) < 0.2 * float(torch.hypot(*along).min())
    torch.testing.assert_close(across[0], across[1], rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(along[0], -along[1], rtol=1e-9, atol=1e-12)


def test_the_metric_turns_with_the_image():
    image = rough()
    metric, turned = even_metric(image, 1.2), even_metric(image.T, 1.2)
    torch.testing.assert_close(turned.yy, metric.xx.T, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(turned.xy, metric.xy.T, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(turned.size, metric.size.T, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("scale", [2.0**-80, 2.0**80])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_metric_knows_no_unit(scale, dtype):
    """Squares of such slopes are beyond single precision; a power of two rounds nothing."""
    for one, other in zip(
        even_metric(rough(dtype=dtype), 1.0), even_metric(scale * rough(dtype=dtype), 1.0), strict=True
    ):
        assert torch.equal(one, other)


def test_single_precision():
    """Eigenvalues of the tensor are good to a few roundings of its largest one, which the smallest ones told feel."""
    single, double = even_metric(rough(dtype=torch.float32), 1.0), even_metric(rough(dtype=torch.float32).double(), 1.0)
    for one, other in zip(single, double, strict=True):
        assert one.dtype == torch.float32
        torch.testing.assert_close(one.double(), other, rtol=2e-4, atol=2e-4)
