"""A telescope's vanes are no point-symmetric figure: which way they are mirrored shows, and where they end."""

import math

import numpy as np
import pytest
import torch

from torchmask.optics.telescope_pupil import TelescopePupil

PUPIL = TelescopePupil(0.2, 0.06, (0.3, 1.7, 4.0))


def test_a_mirrored_pupil_is_open_where_the_pupil_is_at_the_opposite_x():
    """The transfer function cannot tell it from the mirror image in y, which is turned by half a turn."""
    axis = torch.linspace(-1.1, 1.1, 45, dtype=torch.float64)
    places = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)
    cell = torch.tensor([0.05, 0.05], dtype=torch.float64)
    opposite = places * places.new_tensor([-1.0, 1.0])
    seen, expected = PUPIL.mirrored().coverage(places, cell, 2.0), PUPIL.coverage(opposite, cell, 2.0)
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-12)
    assert float((seen - PUPIL.mirrored().turned(math.pi).coverage(places, cell, 2.0)).abs().max()) > 0.9


def test_drawn_vanes_reach_from_the_middle_to_the_rim_and_are_as_wide_as_they_are():
    radius, width = 1.5, 0.06 * 3.0
    vanes = [contour.points for contour in PUPIL.outline(2 * radius)[-3:]]
    for points, angle in zip(vanes, PUPIL.vane_angles, strict=True):
        distance = np.sort(np.linalg.norm(points, axis=-1))
        np.testing.assert_allclose(distance, [width / 2, width / 2, radius, radius], rtol=1e-12)
        aside = points @ [-math.sin(angle), math.cos(angle)]
        np.testing.assert_allclose(np.sort(aside), np.array([-1, -1, 1, 1]) * width / 2, rtol=1e-12)
        assert (points @ [math.cos(angle), math.sin(angle)]).max() > 0.9 * radius


def test_two_vanes_leave_an_opening_from_the_angle_on_at_which_their_edges_meet_on_the_rim():
    """Edges half a width beside two rays meet where sin(angle / 2) is half the width over the distance: the radius."""
    least = 2 * math.asin(0.2)  # the width over the diameter
    apart = TelescopePupil(0.3, 0.2, (0.0, 1.01 * least))
    assert apart.area(2.0) > 0
    with pytest.raises(ValueError, match="leave no opening between them"):
        TelescopePupil(0.3, 0.2, (0.0, 0.99 * least))


@pytest.mark.parametrize("meeting", [0.19, 0.205, 0.1])
def test_the_area_is_that_of_all_rays_from_the_middle(meeting):
    """Two vanes meet at `meeting` along themselves: inside the obstruction of 0.2, outside, or aside of its edge."""
    half = 0.1
    angles = (0.4, 0.4 + 2 * math.atan(half / meeting))
    pupil = TelescopePupil(0.2, half, angles)
    n = 400_000
    turn = (np.arange(n) + 0.5) * (2 * math.pi / n)
    least = np.full(n, 0.2)  # the distance from which on a ray is open
    for angle in angles:
        ahead = np.cos(turn - angle) > 0
        least = np.where(ahead, np.maximum(least, half / np.maximum(np.abs(np.sin(turn - angle)), half)), least)
    area = np.sum(1 - least**2) / 2 * (2 * math.pi / n)
    # kinks between the midpoints of n parts cost about (2 pi / n)^2 each
    assert pupil.area(2.0) == pytest.approx(area, rel=1e-8)
