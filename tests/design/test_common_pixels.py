"""The pixels that lenses have in common and what they share there, against products of whole planes."""

import pytest
import torch

from torchmask.design.common_pixels import CommonPixels, SharedLight
from torchmask.design.lens_patches import LensPatches
from torchmask.design.overlap import Geometry
from torchmask.optics.band import Band
from torchmask.optics.shapes import Disc

GEOMETRY = Geometry((20, 24), 2.0, Disc(), 0.4, 0.4)
CENTERS = [
    [[0.1, 0.3], [-0.35, 0.05], [0.3, -0.25]],
    [[0.31, 0.12], [-0.22, 0.28], [0.05, -0.33]],
]
# mask, first and second of four lenses (the holes with themselves, and three pairs), sign of the second
PAIRS = [(0, 0, 1, 1), (0, 1, 3, -1), (0, 2, 3, 1), (1, 0, 2, 1), (1, 1, 2, -1), (1, 1, 3, 1)]


def case(most=0.0):
    """Lenses of two masks, pairs of them, and coefficients of the logarithm up to about `most` on their rows."""
    patches = LensPatches(GEOMETRY, Band.of([550e-9]), 550e-9, None, None, torch.float64, torch.device("cpu"))
    lenses = patches(torch.tensor(CENTERS, dtype=torch.float64))
    mask, first, second, sign = torch.tensor(PAIRS).T
    pixels = CommonPixels.of(lenses, patches.plane, mask, 4 * mask + first, 4 * mask + second, sign)
    lines = torch.randn(len(pixels.pair), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return patches, lenses, pixels, lines * torch.tensor([1.0, 0.1, 0.01]) + most


def plane_of(patches, lenses, mask, lens, sign):
    """T of one lens on a plane with the rows and columns of frequencies, turned by half a turn if `sign` is -1.

    It vanishes from one hole on, the splines that it is made of three steps of their lattice further out.
    """
    plane, beyond = patches.plane, 3 / patches.colours[0].splines.parts
    whole = torch.zeros(plane.n_pixels, dtype=torch.float64)
    whole[lenses.index[mask, lens].flatten()] = lenses.values[0, mask, lens].flatten()
    (rows, columns), (column, row) = GEOMETRY.grid, lenses.baseline[mask, lens]
    y = (torch.arange(plane.size[0]) - plane.origin[0] - row) / (GEOMETRY.reach / GEOMETRY.period * rows + beyond)
    x = (torch.arange(plane.size[1]) - plane.origin[1] - column) / (GEOMETRY.reach / GEOMETRY.period * columns + beyond)
    whole = whole.view(plane.size) * (torch.hypot(y[:, None], x) <= 1)
    if sign < 0:
        y, x = (2 * middle - torch.arange(n) for middle, n in zip(plane.origin, plane.size, strict=True))
        whole = whole[y.clamp(0, plane.size[0] - 1)][:, x.clamp(0, plane.size[1] - 1)]
    return whole


def test_what_lenses_share_is_the_product_of_their_planes():
    patches, lenses, pixels, lines = case()
    plane = patches.plane
    found = SharedLight.apply(lenses.values.flatten(1), lines, pixels, 2 * plane.n_pixels).view(2, *plane.size)
    expected = torch.zeros_like(found)
    for number, (mask, first, second, sign) in enumerate(PAIRS):
        product = plane_of(patches, lenses, mask, first, 1) * plane_of(patches, lenses, mask, second, sign)
        assert product.max() > 1e-3
        corner = pixels.corner[number].long()
        for line in (pixels.pair == number).nonzero()[:, 0]:
            y = int(corner[1] + pixels.row[line]) + plane.origin[0]
            x = torch.arange(plane.size[1], dtype=torch.float64) - plane.origin[1] - corner[0] - pixels.column[line]
            expected[mask, y] += product[y] * (lines[line, 0] + lines[line, 1] * x + lines[line, 2] * x**2).exp2()
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-15)


@pytest.mark.parametrize("most", [0.0, 10.0])
def test_gradients_where_the_coherence_is_bounded_too(most):
    patches, lenses, pixels, lines = case(most)
    plane = patches.plane
    values = lenses.values.flatten(1).requires_grad_()
    weight = torch.randn(2 * plane.n_pixels, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def shared(values, lines):
        return weight @ SharedLight.apply(values, lines, pixels, 2 * plane.n_pixels)

    torch.autograd.gradcheck(shared, (values, lines.requires_grad_()), fast_mode=True, eps=1e-7, rtol=1e-4)
