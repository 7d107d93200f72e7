"""Half the frequency plane, with room around for patches of pixels that reach beyond its border."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.design.overlap import Geometry


class FrequencyPlane(NamedTuple):
    """The half-plane nu_y >= 0 with columns from -1/2 to 1/2 and a margin on all sides, flat.

    What a patch holds counts at its frequencies and at the opposite ones: `folded` brings both into the half-plane.
    """

    size: tuple[int, int]  # rows and columns
    origin: tuple[int, int]  # row and column of zero frequency
    n_columns: int  # of the half-plane, as FFT order has them
    n_half: int  # pixels of the half-plane
    source: Tensor  # pixels of the plane
    target: Tensor  # of the half-plane: where they count
    baselines: Tensor  # (pixels, 2) [m], on the CPU in float64

    @classmethod
    def of(cls, geometry: Geometry, widest: float, device: torch.device) -> FrequencyPlane:
        """Make a plane with room for lenses at baselines `widest` times as long as those on the torus."""
        widest = max(widest, 1.0)
        margins = [
            int(2 * widest * geometry.reach * n / geometry.period + (widest - 1) * n / 2) + 2 for n in geometry.grid
        ]
        (rows, columns), height = geometry.grid, geometry.grid[0] // 2 + 1
        y = torch.arange(-margins[0], height + margins[0])
        x = torch.arange(-(columns // 2) - margins[1], columns - columns // 2 + margins[1])
        index = torch.arange(len(y) * len(x)).view(len(y), len(x))
        sources, targets = [], []
        for sign in (1, -1):
            row, column = (sign * y).remainder(rows), (sign * x).remainder(columns)
            counts = row < height
            sources.append(index[counts])
            targets.append(row[counts, None] * columns + column)
        return cls(
            (len(y), len(x)),
            (margins[0], columns // 2 + margins[1]),
            columns,
            height * columns,
            torch.cat(sources).flatten().to(device),
            torch.cat(targets).flatten().to(device),
            torch.stack(torch.meshgrid(x.double() / columns, y.double() / rows, indexing="xy"), -1).flatten(0, 1)
            * geometry.period,
        )

    @property
    def n_pixels(self) -> int:
        return self.size[0] * self.size[1]

    def index(self, corner: Tensor, n_rows: int, n_columns: int) -> Tensor:
        """Return the indices (..., rows, columns) of the pixels of patches whose first pixel is `corner` (..., 2)."""
        y = torch.arange(n_rows, device=corner.device) * self.size[1]
        x = torch.arange(n_columns, device=corner.device)
        return self.first(corner)[..., None, None] + (y[:, None] + x)

    def first(self, corner: Tensor) -> Tensor:
        """Return the index (...) of the pixel `corner` (..., 2)."""
        x, y = corner.nan_to_num(0.0).long().unbind(-1)  # NaN, of an optimiser that diverged, must not become an index
        return (y + self.origin[0]) * self.size[1] + (x + self.origin[1])

    def nearest(self, corner: Tensor, n_rows: int, n_columns: int) -> Tensor:
        """Return the indices, as `index` does, of patches anywhere, for functions that are even.

        Below the plane it is that of the opposite pixel, elsewhere outside it that of the nearest one.
        """
        sign = torch.where(corner[..., 1:] < -self.origin[0], -1, 1)
        x, y = (
            (sign * (first.nan_to_num(0.0).long() + torch.arange(n, device=corner.device)) + origin).clamp(0, size - 1)
            for first, n, origin, size in zip(
                (corner[..., :1], corner[..., 1:]), (n_columns, n_rows), self.origin[::-1], self.size[::-1], strict=True
            )
        )
        return y[..., :, None] * self.size[1] + x[..., None, :]

    def summed(self, index: Tensor, values: Tensor) -> Tensor:
        """Return planes (B, pixels): in each the sum of `values` (B, ...) at the pixels `index`, of the same shape."""
        planes = values.new_zeros(len(values), self.n_pixels)
        return planes.scatter_add_(1, index.flatten(1), values.flatten(1))

    def folded(self, plane: Tensor) -> Tensor:
        """Return the half-plane (..., pixels) of planes, row by row, columns in FFT order."""
        # a third of the time of index_select and index_add along the last dimension
        source, target = (index.expand(*plane.shape[:-1], -1) for index in (self.source, self.target))
        return plane.new_zeros(*plane.shape[:-1], self.n_half).scatter_add(-1, target, plane.gather(-1, source))


def half_plane(geometry: Geometry) -> Tensor:
    """Return baselines (P, 2) [m] of the frequencies nu_y >= 0, row by row, columns in FFT order."""
    rows, columns = geometry.grid
    nu_y = torch.arange(rows // 2 + 1, dtype=torch.float64) / rows
    nu_x = torch.fft.fftfreq(columns, dtype=torch.float64)
    return torch.stack(torch.meshgrid(nu_x, nu_y, indexing="xy"), -1).flatten(0, 1) * geometry.period
