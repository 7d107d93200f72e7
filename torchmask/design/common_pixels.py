"""The pixels that pairs of lenses have in common, row by row, and what the pairs share there.

Rows are ordered by their length, so that those of one length make one block: none is padded, and a block stays in the
cache from the pixels' places to their sums, forwards and backwards.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchmask.design.frequency_plane import FrequencyPlane
from torchmask.design.lens_patches import Lenses

_MOST = 14.0  # logarithm to base 2 of the coherence over `far`, that no pixel with light goes beyond


class CommonPixels(NamedTuple):
    """R rows of pixels that S pairs of lenses have in common, the shortest first.

    corner (S, 2) a pixel of each pair, at or before its first row and column; pair, row, column (R,) which pair a row
    belongs to, and where it begins, from that pixel on; sign (R,) -1 where the second lens is turned by half a turn;
    first, second, target (R,) where the values of either lens, of all masks one after the other, and their planes have
    the first pixel; counts how many rows have 0, 1, 2 ... pixels
    """

    corner: Tensor
    pair: Tensor
    row: Tensor
    column: Tensor
    sign: Tensor
    first: Tensor
    second: Tensor
    target: Tensor
    counts: list[int]

    @classmethod
    def of(
        cls, lenses: Lenses, plane: FrequencyPlane, mask: Tensor, first: Tensor, second: Tensor, sign: Tensor
    ) -> CommonPixels:
        """Find those of the lenses `first` and `second`, counted through all masks, of a `mask`; (S,) each.

        The second lens is turned by half a turn where `sign` is -1.
        """
        rows, columns = lenses.values.shape[-2:]
        corners = lenses.corner.nan_to_num(0.0).long().flatten(0, 1)
        (left, top), (own_left, own_top) = (corners.index_select(0, lens).unbind(-1) for lens in (first, second))
        facing = torch.where(sign > 0, own_top, 1 - own_top - rows)
        y = torch.maximum(top, facing)
        n_rows = (torch.minimum(top, facing) + rows - y).clamp(min=0)
        pair = torch.arange(len(first), device=y.device).repeat_interleave(n_rows)
        row = torch.arange(len(pair), device=y.device) - (n_rows.cumsum(0) - n_rows).index_select(0, pair)

        # rows of all lenses, and the columns of the plane where they begin and end
        one = (first * rows + y - top).index_select(0, pair) + row
        turned = sign.index_select(0, pair)
        other = torch.addcmul((second * rows + sign * y - own_top).index_select(0, pair), turned, row)
        begin, end = (lenses.ends.flatten(0, 1) + corners[:, None, :1]).flatten(0, 1).T.contiguous()
        own_begin, own_end = begin.index_select(0, other), end.index_select(0, other)
        x = torch.maximum(begin.index_select(0, one), torch.where(turned > 0, own_begin, 1 - own_end))
        width = torch.minimum(end.index_select(0, one), torch.where(turned > 0, own_end, 1 - own_begin)) - x
        width.clamp_(min=0)
        counts: list[int] = width.bincount().tolist()
        order = width.to(torch.int16).argsort()[sum(counts[:1]) :]  # few bits are sorted fastest
        pair, row, x, one, other, turned = (part.index_select(0, order) for part in (pair, row, x, one, other, turned))

        base = (mask * plane.n_pixels + plane.first(torch.stack([torch.zeros_like(y), y], -1))).index_select(0, pair)
        column = x - left.index_select(0, pair)
        return cls(
            torch.stack([left, y], -1),
            pair,
            row,
            column,
            turned,
            one * columns + column,
            other * columns + turned * x - own_left.index_select(0, pair),
            base + row * plane.size[1] + x,
            [0, *counts[1:]],
        )

    def blocks(self) -> Iterator[tuple[slice, int, Tensor, Tensor, Tensor]]:
        """Yield rows of one length: which they are, their length, and where the values of either lens and the planes
        have their pixels, one row after the other."""
        column, begin = torch.arange(len(self.counts), device=self.pair.device), 0
        for width, n in enumerate(self.counts):
            some, x, begin = slice(begin, begin + n), column[:width], begin + n
            if n > 0:
                first, target = (place[some, None] + x for place in (self.first, self.target))
                second = torch.addcmul(self.second[some, None], self.sign[some, None], x)
                yield some, width, first.flatten(), second.flatten(), target.flatten()


class SharedLight(torch.autograd.Function):
    """Planes (P,), the sum of the products of `values` (M, V) of both lenses times the coherence, in `pixels`.

    `lines` (R, 3) are the coefficients of its logarithm to base 2, whose exponential takes half as long as that to
    base e, in powers of the pixel's number, row by row.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, lines: Tensor, pixels: CommonPixels, n_pixels: int) -> Tensor:
        ctx.save_for_backward(values, lines)
        ctx.pixels = pixels
        powers, planes = powers_of(len(pixels.counts), lines), values.new_zeros(n_pixels)
        for some, width, first, second, target in pixels.blocks():
            coherence = (lines[some] @ powers[:, :width]).clamp_(max=_MOST).exp2_().flatten()
            products = (layer.index_select(0, first).mul_(layer.index_select(0, second)) for layer in values)
            light = reduce(Tensor.add_, products)
            planes.scatter_add_(0, target, light.mul_(coherence))
        return planes

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, Tensor, None, None]:
        values, lines = ctx.saved_tensors
        powers = powers_of(len(ctx.pixels.counts), lines)
        by_value, by_line = torch.zeros_like(values), torch.zeros_like(lines)
        for some, width, first, second, target in ctx.pixels.blocks():
            logarithm = (lines[some] @ powers[:, :width]).flatten()
            slope = logarithm.clamp(max=_MOST).exp2_().mul_(grad[0].index_select(0, target))
            light = torch.zeros_like(slope)
            for layer, by_layer in zip(values, by_value, strict=True):
                one, other = layer.index_select(0, first), layer.index_select(0, second)
                light.addcmul_(one, other)
                by_layer.scatter_add_(0, first, other.mul_(slope)).scatter_add_(0, second, one.mul_(slope))
            light.mul_(slope).mul_(logarithm <= _MOST)
            torch.mm(light.view(-1, width), powers[:, :width].T, out=by_line[some])
        return by_value, by_line.mul_(math.log(2)), None, None


def powers_of(n: int, like: Tensor) -> Tensor:
    """Return the powers 0, 1 and 2 (3, n) of the numbers below n."""
    number = torch.arange(n, dtype=like.dtype, device=like.device)
    return torch.stack([number**0, number, number**2])
