"""Functions of the distance from a baseline, on the pixels around it, as smooth splines that follow the baseline.

All patches have their pixels at whole steps, and only their offset by a part of a pixel differs. So a spline on a
lattice that divides the pixel takes every patch from the same few slices of its coefficients: one matrix product.
"""

from __future__ import annotations

import math

import torch
from scipy.ndimage import spline_filter
from torch import Tensor

_FINENESS = 48  # lattice steps across the radius of support
_MARGIN = 20  # more steps on every side: what the spline does at the lattice's end is not felt


class SplinePatches:
    """R functions of a displacement (x, y), as cubic splines on a lattice that divides the pixels.

    reach : (x, y) pixels from the middle of a patch to its first one, at most; the functions vanish further out
    size : (columns, rows) of a patch
    """

    reach: tuple[float, float]
    size: tuple[int, int]

    def __init__(self, reach: tuple[float, float], size: tuple[int, int]) -> None:
        self.reach, self.size = reach, size
        self.parts: int = math.ceil(_FINENESS / min(reach))
        self.n_rows: int = self.parts + 4  # slices of either axis
        # of the lattice, a whole number of its steps from the middle: opposite places have equal errors
        self.start: tuple[float, ...] = tuple(math.ceil(one * self.parts) / self.parts for one in reach)

    def lattice(self) -> tuple[Tensor, Tensor]:
        """Return the places at which the functions must be known, x (X,) and y (Y,) [pixels]."""
        axes = [
            torch.arange(-1 - _MARGIN, self.parts * size + 3 + _MARGIN, dtype=torch.float64) / self.parts - start
            for start, size in zip(self.start, self.size, strict=True)
        ]
        return axes[0], axes[1]

    def slices(self, values: Tensor) -> Tensor:
        """Return the matrix (slices, R rows columns) of functions known on the lattice, `values` (R, Y, X)."""
        coefficients = torch.stack([torch.from_numpy(spline_filter(one.numpy(), order=3)) for one in values])
        # no spline reaches beyond the support: pixels there are in a patch or not, as its offset is
        for axis, nodes, reach in zip((-1, -2), self.lattice(), self.reach, strict=True):
            inside = nodes.abs() <= reach - 2 / self.parts
            coefficients = coefficients * (inside if axis == -1 else inside[:, None])
        coefficients = coefficients[:, _MARGIN:-_MARGIN, _MARGIN:-_MARGIN]
        columns, rows = self.size
        unfolded = coefficients.unfold(-2, self.parts * (rows - 1) + 1, 1)[:, : self.n_rows, :, :: self.parts]
        unfolded = unfolded.unfold(-2, self.parts * (columns - 1) + 1, 1)[:, :, : self.n_rows, :, :: self.parts]
        return unfolded.permute(1, 2, 0, 3, 4).flatten(2).flatten(0, 1).contiguous()

    def patches(self, slices: Tensor, offset: Tensor) -> Tensor:
        """Return the functions on the pixels of patches (..., R rows columns), by the matrix of their slices.

        The first pixel of a patch lies at `offset` (..., 2) [pixels] from the middle, -reach <= offset < 1 - reach, in
        which they are differentiable.
        """
        place = (offset.flatten(0, -2) + offset.new_tensor(self.start)) * self.parts
        start = place.detach().nan_to_num(0.0).floor().clamp(0, self.parts)
        (by_x, by_y), (column, row) = cubic_basis(place - start).unbind(1), start.long().unbind(1)
        across = column[:, None] + torch.arange(4, device=offset.device)
        by_x = offset.new_zeros(len(place), self.n_rows).scatter(-1, across, by_x)
        weights = (by_y[:, :, None] * by_x[:, None]).flatten(1)  # of the slices of four rows of the lattice
        order = row.argsort()
        some = weights.index_select(0, order).split(row.bincount(minlength=self.parts + 1).tolist())
        found = torch.cat([one @ slices[n * self.n_rows : (n + 4) * self.n_rows] for n, one in enumerate(some)])
        return found.index_select(0, order.argsort()).unflatten(0, offset.shape[:-1])


def cubic_basis(t: Tensor) -> Tensor:
    """Return the four cubic B-splines that are not zero at t in [0, 1] of a step, (..., 4)."""
    rest = 1 - t
    inner = (4 - 6 * t**2 + 3 * t**3) / 6
    return torch.stack([rest**3 / 6, inner, (4 - 6 * rest**2 + 3 * rest**3) / 6, t**3 / 6], -1)
