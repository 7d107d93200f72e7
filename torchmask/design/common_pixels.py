"""The pixels that pairs of lenses have in common, row by row.

Rows are ordered by their length, so that those of one length make one block and none is padded.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.design.frequency_plane import FrequencyPlane
from torchmask.design.lens_patches import Lenses


class CommonPixels(NamedTuple):
    """R rows of P pixels that S pairs of lenses have in common, the shortest first.

    corner (S, 2) the first pixel of each pair; pair, row (R,) which pair a row belongs to, and which of its rows it is;
    counts how many rows have 0, 1, 2 ... pixels; first, second, target (P,) where the values of either lens, of all
    masks one after the other, and their planes have the pixels
    """

    corner: Tensor
    pair: Tensor
    row: Tensor
    counts: list[int]
    first: Tensor
    second: Tensor
    target: Tensor

    @classmethod
    def of(
        cls, lenses: Lenses, plane: FrequencyPlane, mask: Tensor, first: Tensor, second: Tensor, sign: Tensor
    ) -> CommonPixels:
        """Find those of the lenses `first` and `second` of a `mask` (S,); where `sign` (S,) is -1, the second one is
        turned by half a turn."""
        corner, size = lenses.corner[mask, first], lenses.size[mask, first]
        own, extent = lenses.corner[mask, second], lenses.size[mask, second]
        facing = torch.where(sign[:, None] > 0, own, 1 - own - extent)
        start = torch.maximum(corner, facing)
        n_columns, n_rows = (torch.minimum(corner + size, facing + extent) - start).clamp(min=0).long().unbind(-1)
        order = n_columns.argsort()
        n_rows = (n_rows * (n_columns > 0))[order]
        pair = order.repeat_interleave(n_rows)
        row = torch.arange(len(pair), device=pair.device) - (n_rows.cumsum(0) - n_rows).repeat_interleave(n_rows)
        counts: list[int] = n_columns[pair].bincount().tolist()

        rows, columns = lenses.values.shape[-2:]
        n_lenses, (x, y) = lenses.values.shape[2], start.long().unbind(-1)
        (left, top), (own_left, own_top) = corner.long().unbind(-1), own.long().unbind(-1)
        places = torch.stack(
            [
                ((mask * n_lenses + first) * rows + y - top) * columns + x - left,
                ((mask * n_lenses + second) * rows + sign * y - own_top) * columns + sign * x - own_left,
                mask * plane.n_pixels + (y + plane.origin[0]) * plane.size[1] + x + plane.origin[1],
            ],
            -1,
        )
        one = torch.ones_like(sign)
        steps = torch.stack([one, sign, one], -1)
        lines = steps * steps.new_tensor([columns, columns, plane.size[1]])
        by_row = torch.addcmul(places.index_select(0, pair), lines.index_select(0, pair), row[:, None])
        found = pair.new_empty(3, sum(width * n for width, n in enumerate(counts)))
        step = sign.index_select(0, pair)[:, None]
        result = cls(start, pair, row, counts, *found)
        for some, pixels, width in result.blocks():
            column = torch.arange(width, device=pair.device)
            first_, second_, target_ = (part[pixels].view(-1, width) for part in found)
            torch.add(by_row[some, :1], column, out=first_)
            torch.addcmul(by_row[some, 1:2], step[some], column, out=second_)
            torch.add(by_row[some, 2:], column, out=target_)
        return result

    def blocks(self) -> Iterator[tuple[slice, slice, int]]:
        """Yield rows of one length: which rows and which pixels they are, and their length."""
        row = pixel = 0
        for width, n in enumerate(self.counts):
            if n > 0 and width > 0:
                yield slice(row, row + n), slice(pixel, pixel + n * width), width
            row, pixel = row + n, pixel + n * width
