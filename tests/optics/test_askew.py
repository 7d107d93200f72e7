"""The turn that keeps all sides of an uneven polygon as far from the x axis as can be."""

import math
from dataclasses import dataclass

import numpy as np
import pytest

from torchmask.optics.polygons import Polygon


@dataclass(frozen=True)
class Uneven(Polygon):
    """Any strips; without a name, so that no drawing is taken for it."""

    given: tuple[tuple[float, float], ...] = ()

    def strips(self):
        return self.given


@pytest.mark.parametrize("angles", [(0.0, 0.4, 1.9), (0.0, 0.5), (0.0, 1.7, 2.2), (1.0, 1.5, 2.0)])
@pytest.mark.parametrize("orientation", [0.0, 0.7])
def test_normals_leave_the_widest_gap_on_both_sides_of_y(angles, orientation):
    """A normal along y is that of a side along x, at which chords jump."""
    shape = Uneven(orientation, tuple((angle, 1.0) for angle in angles))
    turned = shape.turned(shape.askew)
    normals = [turned.orientation + angle for angle in angles]
    # the angle from y to each normal, whichever way it points, in [-pi / 2, pi / 2)
    away = [normal % math.pi - math.pi / 2 for normal in normals]
    widest = max(after - angle for angle, after in zip(angles, [*angles[1:], angles[0] + math.pi], strict=True))
    before, after = (min(abs(one) for one in away if side * one > 0) for side in (-1, 1))
    assert (before, after) == pytest.approx((widest / 2, widest / 2), abs=1e-12)


@pytest.mark.parametrize("angles", [(0.0, 0.4, 1.9), (0.0, 1.2, 1.5, 2.0)])
def test_chords_of_an_uneven_polygon_end_on_its_sides(angles):
    """Also where the widest gap is not the last one, so that some normals point to the left after the turn."""
    shape = Uneven(0.0, tuple((angle, 1.0 + 0.1 * k) for k, angle in enumerate(angles)))
    turned = shape.turned(shape.askew)
    normal = np.array([[math.cos(turned.orientation + a), math.sin(turned.orientation + a)] for a, _ in shape.given])
    assert normal[:, 0].min() < 0 < normal[:, 0].max()
    half_widths = 0.3 * np.array([width for _, width in shape.given]) / 2
    height = np.linspace(-0.1, 0.1, 21)
    left, right = turned.chords(height, 0.3)
    assert (right > left).all()
    for end in (left, right):
        beyond = np.abs(np.stack([end, height], -1) @ normal.T) - half_widths
        np.testing.assert_allclose(beyond.max(-1), 0, atol=1e-14)
