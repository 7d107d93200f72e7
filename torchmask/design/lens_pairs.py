"""Lenses of different pairs of holes whose baselines nearly agree: what they have in common under turbulence.

Two lenses with middles c apart, at baselines that differ by less than two holes, share

    T(u) T(u') < exp(-Q(b, c + t) / 2) >

at the baseline b, u and u' from their own ones; t is the separation of two points, one of either lens, from their
middles. The logarithm of the mean (`torchmask.design.pair_coherence`) is a parabola in b over a patch, after a factor
that is common to far lenses is split off. The lenses of holes with themselves, at baseline 0, take part; there are N of
them in one place.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.design.lens_patches import Lenses
from torchmask.design.overlap import Geometry
from torchmask.design.pair_coherence import PairCoherence

_SMALLEST = 5e-4  # products T T' exp(-Q / 2) below, as estimated, are left out
_RICH = 0.005  # of those that are never larger the coherence is taken to be constant
_WINDOWS = (0.65, 0.85, 1.0)  # sizes of patches, of that of a lens
_NODE = 0.4  # of the hole's reach: where the parabolas are fixed, as lenses transmit little further out
_NOTHING, _MOST = 1e-30, 10.0  # coherence, and logarithm of it over `far`, that no pixel with light goes beyond


class Entries(NamedTuple):
    """E pairs of lenses: which mask, first and second lens, the sign of the second, and the place of what they give.

    Pairs that share `slot` have the same baselines; `holes` (E, 2) says which holes the lenses at baseline 0 belong to.
    """

    mask: Tensor
    first: Tensor
    second: Tensor
    sign: Tensor
    holes: Tensor
    slot: Tensor


class LensPairs:
    """What pairs of lenses of a mask share, for holes of one geometry; `pixel` (2,) [m]."""

    def __init__(self, geometry: Geometry, coherence: PairCoherence, pixel: Tensor) -> None:
        self.geometry, self.coherence, self.pixel = geometry, coherence, pixel

    def __call__(self, lenses: Lenses, centers: Tensor) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Return what lenses share over `far`, in patches of some sizes: mask (S,), corner (S, 2) [pixels] and values
        (S, rows, columns). Each patch counts once more at the opposite frequencies."""
        baselines = lenses.baseline * self.pixel
        with torch.no_grad():
            entries, largest = self._select(lenses, baselines, centers)
        if len(entries.mask) == 0:
            return []
        sign = entries.sign[:, None]
        first, second = baselines[entries.mask, entries.first], sign * baselines[entries.mask, entries.second]
        separation = self._middles(lenses, centers, entries, 0) - self._middles(lenses, centers, entries, 1)
        middle = (first + second) / 2
        step = _NODE * (self.geometry.reach + self.coherence.spread / 2 * middle.abs())
        n_slots = int(entries.slot.max()) + 1
        nodes = middle.new_zeros(n_slots, 9)
        for some, n in ((largest > _RICH, 3), (largest <= _RICH, 1)):
            found = self.coherence.around(first[some], second[some], separation[some], step[some], n).flatten(1)
            nodes = nodes.index_add(0, entries.slot[some], found.expand(-1, 9))
        one = torch.zeros(n_slots, dtype=torch.long, device=sign.device)
        one[entries.slot] = torch.arange(len(sign), device=sign.device)  # an entry of each slot
        pairs = Entries(*(part[one] for part in entries))
        own = pairs.first == pairs.second  # their own opposite
        nodes = (nodes * torch.where(own, 1.0, 2.0).to(nodes)[:, None]).clamp(min=_NOTHING).log().unflatten(1, (3, 3))
        between = (first - second).detach()[one].norm(dim=-1)
        return [
            (pairs.mask[some], *self._patches(lenses, Entries(*(part[some] for part in pairs)), nodes[some], *places))
            for some, places in self._windows(lenses, pairs, largest[one], between, middle[one], step[one])
        ]

    def _windows(
        self, lenses: Lenses, pairs: Entries, largest: Tensor, between: Tensor, middle: Tensor, step: Tensor
    ) -> Iterator[tuple[Tensor, tuple[Tensor, Tensor, Tensor, int, int]]]:
        """Yield pairs by the size of the window beyond which they share nothing: which they are, the windows' first
        pixels, and what the parabolas need."""
        rows, columns = lenses.values.shape[-2:]
        if lenses.scale is not None:  # the lenses of a band are as wide as they are
            every = torch.arange(len(largest), device=middle.device)
            yield every, (lenses.corner[pairs.mask, pairs.first], middle, step, rows, columns)
            return
        needed = (1 - (between / (2 * self.geometry.reach)) ** 2).clamp(min=0).sqrt()
        needed = torch.where(pairs.first == 0, 1.0, needed)
        smallest = 0.0
        for size in _WINDOWS:
            some = ((needed > smallest) & (needed <= size)).nonzero()[:, 0]
            smallest = size
            if len(some) == 0:
                continue
            reach = size * self.geometry.reach / self.pixel
            n_columns, n_rows = (2 * reach + 1).long().tolist()
            corner = (middle[some].detach() / self.pixel - reach).ceil()
            yield some, (corner, middle[some], step[some], min(n_rows, rows), min(n_columns, columns))

    def _patches(
        self,
        lenses: Lenses,
        pairs: Entries,
        nodes: Tensor,
        corner: Tensor,
        middle: Tensor,
        step: Tensor,
        n_rows: int,
        n_columns: int,
    ) -> tuple[Tensor, Tensor]:
        """Return corner (S, 2) and values (S, rows, columns) of what pairs share, from their coherence at the nodes."""
        size = (n_rows, n_columns)
        first = _at_pixels(lenses, pairs.mask, pairs.first, torch.ones_like(pairs.sign), corner, size)
        second = _at_pixels(lenses, pairs.mask, pairs.second, pairs.sign, corner, size)
        start = (corner * self.pixel - middle) / step
        return corner, (first * second).sum(1) * _parabola(nodes, start, self.pixel / step, *size).clamp(
            max=_MOST
        ).exp()

    def _select(self, lenses: Lenses, baselines: Tensor, centers: Tensor) -> tuple[Entries, Tensor]:
        """Return the pairs that share something, and about the most that each gives anywhere."""
        n, count = centers.shape[1], baselines.shape[1]
        upper = torch.ones(count, count, dtype=torch.bool, device=centers.device).triu(1)
        limit, found = (2 * self.geometry.reach) ** 2, []
        x, y = baselines.unbind(-1)
        for sign in (1, -1):
            distance = (sign * x[:, None] - x[:, :, None]) ** 2 + (sign * y[:, None] - y[:, :, None]) ** 2
            allowed = upper if sign > 0 else upper | torch.eye(count, dtype=torch.bool, device=centers.device)
            allowed = allowed.clone()
            if sign < 0:
                allowed[0] = False  # the opposite of what the lenses at baseline 0 share with the others
            pairs = ((distance < limit) & allowed).nonzero()
            found.append(torch.cat([pairs, torch.full_like(pairs[:, :1], sign)], 1))
        rows = torch.cat(found)
        central = rows[:, 1] == 0
        lone, short = rows[~central], rows[central]
        holes = torch.arange(n, device=centers.device)
        no_hole = lone.new_zeros(len(lone), 2)
        entries = [torch.cat([lone, no_hole], 1)]
        each = short.repeat_interleave(n, 0)
        which = holes.repeat(len(short))[:, None]
        entries.append(torch.cat([each, which, which], 1))
        rows = torch.cat(entries)
        result = Entries(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:], rows[:, 0])
        largest = self._largest(result, lenses, baselines, centers)
        counts = largest > _SMALLEST
        rows, largest = rows[counts], largest[counts]
        key = ((rows[:, 0] * count + rows[:, 1]) * count + rows[:, 2]) * 2 + (rows[:, 3] > 0)
        slot = torch.unique(key, return_inverse=True)[1]
        return Entries(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:], slot), largest

    def _largest(self, entries: Entries, lenses: Lenses, baselines: Tensor, centers: Tensor) -> Tensor:
        """Return about the most that each entry gives anywhere (E,)."""
        first = baselines[entries.mask, entries.first]
        second = entries.sign[:, None] * baselines[entries.mask, entries.second]
        separation = self._middles(lenses, centers, entries, 0) - self._middles(lenses, centers, entries, 1)
        reach = self.geometry.reach
        lens = self.geometry.shape.otf((first - second) / 2, self.geometry.diameter) ** 2
        near = []
        for x, y in (((first + second) / 2).unbind(-1), separation.unbind(-1)):
            shrunk = (1 - reach / 2 * torch.rsqrt(x * x + y * y)).clamp(min=0)
            near += [shrunk * x, shrunk * y]
        near = [vector.nan_to_num(0.0) for vector in near]
        return lens * self.coherence.of_points(*near)

    def _middles(self, lenses: Lenses, centers: Tensor, entries: Entries, which: int) -> Tensor:
        """Return the middle of the first or second lens of each entry, (E, 2) [m]."""
        lens = entries.second if which else entries.first
        hole = centers[entries.mask, entries.holes[:, which]]
        return torch.where((lens == 0)[:, None], hole, lenses.middle[entries.mask, lens])


def _parabola(nodes: Tensor, start: Tensor, step: Tensor, n_rows: int, n_columns: int) -> Tensor:
    """Return values at 3 x 3 nodes (S, y, x), interpolated by a polynomial on patches (S, rows, columns).

    The first pixel lies at `start` (S, 2), the others are `step` (S, 2) apart, in units of the nodes' distance.
    """
    rows = _coefficients(nodes, start[:, 1:], step[:, 1:])  # (S, 3, x)
    both = _coefficients(rows.transpose(1, 2), start[:, :1], step[:, :1])  # (S, 3 of x, 3 of y)
    row, column = (torch.arange(n, dtype=nodes.dtype, device=nodes.device) for n in (n_rows, n_columns))
    powers = [[(row**j)[:, None] * (column**i) for j in range(3)] for i in range(3)]
    matrix = torch.stack([torch.stack(some) for some in powers]).flatten(0, 1).flatten(1)
    return (both.flatten(1) @ matrix).unflatten(1, (n_rows, n_columns))


def _coefficients(nodes: Tensor, start: Tensor, step: Tensor) -> Tensor:
    """Return the coefficients (S, 3, k), in powers of the pixel, of parabolas through values (S, 3, k) at -1, 0, 1."""
    below, middle, above = nodes.unbind(1)
    slope, curvature = (above - below) / 2, (above + below) / 2 - middle
    at_start = middle + start * (slope + start * curvature)
    return torch.stack([at_start, step * (slope + 2 * start * curvature), step**2 * curvature], 1)


def _at_pixels(
    lenses: Lenses, mask: Tensor, lens: Tensor, sign: Tensor, corner: Tensor, size: tuple[int, int]
) -> Tensor:
    """Return lenses (S,) on patches of `size` whose first pixel is `corner` (S, 2), (S, modes, rows, columns).

    They are turned by half a turn where their sign is -1.
    """
    n_modes, rows, columns = lenses.values.shape[-3:]
    padded = torch.nn.functional.pad(lenses.values, (1, 1, 1, 1))
    first, own, sign = corner.long(), lenses.corner[mask, lens].long(), sign[:, None]
    y, x = (
        (sign * (first[:, axis, None] + torch.arange(n, device=mask.device)) - own[:, axis, None]).clamp(-1, last) + 1
        for axis, n, last in ((1, size[0], rows), (0, size[1], columns))
    )
    layer = (rows + 2) * (columns + 2)
    start = (mask * lenses.values.shape[1] + lens) * (n_modes * layer)
    start = start[:, None] + torch.arange(n_modes, device=mask.device) * layer
    index = (start[:, :, None] + (y * (columns + 2))[:, None])[..., None] + x[:, None, None]
    return padded.flatten().index_select(0, index.flatten()).view(index.shape)
