"""Points of the field at which a varying PSF is computed, and the light of the scene that each of them stands for."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.layers import Vector
from torchmask.grid import Grid

SPACING = 0.5  # distance between points in units of theta0


class FieldPoint(NamedTuple):
    """A point of the field whose PSF is used for the light around it.

    direction : (x, y) from the middle of the field [rad]
    light : (H, W) part of the scene that this PSF blurs
    """

    direction: Vector
    light: Tensor


def field_points(scene: Tensor, grid: Grid, spacing: float) -> list[FieldPoint]:
    """Return points at most `spacing` [rad] apart that enclose the light of a scene (H, W), and their shares of it.

    The light of each pixel is divided bilinearly among the four points around it, which interpolates the PSF between
    them; the frame is the sum of the images of all points. With an infinite spacing there is one point, in the middle
    of the field.

    Examples
    --------
    >>> scene = torch.zeros(32, 32); scene[4:13, 6:23] = 1.0
    >>> points = field_points(scene, Grid(32, 1e-6, 550e-9), spacing=8e-6)
    >>> len(points), [round(1e6 * angle) for angle in points[0].direction]
    (6, [-10, -12])
    >>> torch.allclose(sum(point.light for point in points), scene)
    True
    """
    if math.isinf(spacing):
        return [FieldPoint((0.0, 0.0), scene)]
    places, shares = [], []
    for axis in (0, 1):
        lit = torch.nonzero((scene > 0).any(1 - axis)).flatten()
        first, last = int(lit[0]), int(lit[-1])
        wanted = math.ceil((last - first) * grid.pixel_scale / spacing * (1 - 1e-9))
        count = min(wanted, last - first) + 1  # at most one for each pixel
        nodes = torch.linspace(first, last, count, dtype=torch.float64, device="cpu")
        pixels = torch.arange(scene.shape[axis], dtype=torch.float64, device="cpu")
        step = (last - first) / (count - 1) if count > 1 else 1.0
        shares.append((1 - (pixels - nodes[:, None]).abs() / step).clamp(min=0))
        places.append(((nodes - scene.shape[axis] // 2) * grid.pixel_scale).tolist())
    return [
        FieldPoint((x, y), scene * (by_row[:, None] * by_column).to(scene))
        for y, by_row in zip(places[0], shares[0], strict=True)
        for x, by_column in zip(places[1], shares[1], strict=True)
    ]
