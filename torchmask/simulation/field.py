"""PSFs that vary over the field: where they are computed, and how much of the scene's light belongs to each."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.layers import Vector
from torchmask.grid import Grid

SPACING = 0.5  # of the points, in units of theta0


class FieldPoint(NamedTuple):
    """A point of the field whose PSF stands for its surroundings.

    direction : (x, y) from the middle of the field [rad]
    light : (H, W) the part of the scene that is blurred by this PSF
    """

    direction: Vector
    light: Tensor


def field_points(scene: Tensor, grid: Grid, spacing: float) -> list[FieldPoint]:
    """Points at most `spacing` [rad] apart that enclose all light of a scene (H, W), and their shares of it.

    Between four points the PSF is interpolated bilinearly: the light of each pixel is divided among them, so the frame
    is the sum of as many images. With an infinite spacing there is one point, in the middle of the field.

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
