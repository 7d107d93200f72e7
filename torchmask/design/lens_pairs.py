"""Lenses of different pairs of holes whose baselines nearly agree: what they have in common under turbulence.

Two lenses with middles c apart, at baselines that differ by less than two holes, share

    T(u) T(u') < exp(-Q(b, c + t) / 2) >

at the baseline b, u and u' from their own ones; t is the separation of two points, one of either lens, from their
middles. It is known by its second moments, to which the exposure adds those of the drift: nine points stand for it.
The logarithm of the mean is a parabola in b over a patch, after a factor that is common to far lenses is split off. The
lenses of holes with themselves, at baseline 0, take part; there are N of them in one place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.design.lens_patches import Lenses
from torchmask.design.overlap import Geometry

_SMALLEST = 5e-4  # products T T' exp(-Q / 2) below, as estimated, are left out
_RICH = 0.005  # of those that are never larger the coherence is taken to be constant
_WINDOWS = (0.65, 0.85, 1.0)  # sizes of patches, of that of a lens
_KURTOSIS = 2.5  # along one axis, of the separation of two points of two discs
_POINTS = [(i * math.sqrt(_KURTOSIS), (1 - abs(i)) * (1 - 1 / _KURTOSIS) + abs(i) / (2 * _KURTOSIS)) for i in (-1, 0, 1)]
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
    """Coherence that pairs of lenses of a mask share, for holes of one geometry under one turbulence.

    pixel : (2,) [m]; scales : the least and largest phases of the band's light, over those at the reference wavelength
    """

    def __init__(
        self, geometry: Geometry, seeing: Seeing, longest: float, pixel: Tensor, scales: tuple[float, float]
    ) -> None:
        self.geometry, self.pixel, self.scales = geometry, pixel, scales
        reach = geometry.reach
        points, weights = geometry.shape.quadrature(4, geometry.diameter)
        self.variance: float = float((weights @ points**2).mean())  # of the points of a hole, along either axis [m^2]
        steps, shares = seeing.drift()
        moments = (shares[:, None, None] * steps[:, :, None] * steps[:, None]).sum(0)
        self.drift: tuple[float, float, float] = (float(moments[0, 0]), float(moments[0, 1]), float(moments[1, 1]))
        self.structure: StructureFunction = seeing.structure(4 * longest + 4 * reach)

    def far(self, baselines: Tensor) -> Tensor:
        """Return a factor (...) that follows exp(-D), the coherence of far lenses, where that is not small."""
        return self._far(*baselines.unbind(-1))

    def _far(self, x: Tensor, y: Tensor) -> Tensor:
        d = self.structure.of_square(x * x + y * y)
        return torch.exp(-d / (1 + d / 3))

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
        step = _NODE * (self.geometry.reach + (self.scales[1] - self.scales[0]) / 2 * middle.abs())
        n_slots = int(entries.slot.max()) + 1
        nodes = middle.new_zeros(n_slots, 9)
        for some, n in ((largest > _RICH, 3), (largest <= _RICH, 1)):
            found = self._coherence(first[some], second[some], separation[some], step[some], n).flatten(1)
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
        return corner, (first * second).sum(1) * _parabola(nodes, start, self.pixel / step, *size).clamp(max=_MOST).exp()

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
        return lens * self._kernel(*near)

    def _middles(self, lenses: Lenses, centers: Tensor, entries: Entries, which: int) -> Tensor:
        """Return the middle of the first or second lens of each entry, (E, 2) [m]."""
        lens = entries.second if which else entries.first
        hole = centers[entries.mask, entries.holes[:, which]]
        return torch.where((lens == 0)[:, None], hole, lenses.middle[entries.mask, lens])

    def _kernel(self, bx: Tensor, by: Tensor, sx: Tensor, sy: Tensor, square: Tensor | float = 1.0) -> Tensor:
        """Return exp(-Q / 2) (...) to the power `square` of the phases' scale."""
        structure = self.structure.of_square
        crossed = structure((sx + bx) ** 2 + (sy + by) ** 2) + structure((sx - bx) ** 2 + (sy - by) ** 2)
        return torch.exp(square * (crossed / 2 - structure(bx * bx + by * by) - structure(sx * sx + sy * sy)))

    def _coherence(self, first: Tensor, second: Tensor, separation: Tensor, step: Tensor, n: int) -> Tensor:
        """Return the mean of exp(-Q / 2) over `far`, (E, rows, columns), at n x n baselines around that midway.

        The baselines are `step` (E, 2) apart.
        """
        nodes = torch.arange(n, dtype=first.dtype, device=first.device) - (n - 1) / 2
        middle = (first + second) / 2
        zero = torch.zeros(n, n, dtype=first.dtype, device=first.device)
        bx = middle[:, :1, None] + step[:, :1, None] * nodes + zero
        by = middle[:, 1:, None] + step[:, 1:, None] * nodes[:, None] + zero
        scale, square = self._scale(middle, bx, by)
        xx, xy, yy = (
            one + other + drift
            for one, other, drift in zip(
                self._moments(bx / scale - first[:, :1, None], by / scale - first[:, 1:, None]),
                self._moments(bx / scale - second[:, :1, None], by / scale - second[:, 1:, None]),
                self.drift,
                strict=True,
            )
        )
        # the symmetric square root: a mask that is turned by 90 degrees has the same points
        root = torch.sqrt((xx * yy - xy**2).clamp(min=1e-6 * self.variance**2))
        trace = torch.sqrt(xx + yy + 2 * root)
        along, skew, across = (xx + root) / trace, xy / trace, (yy + root) / trace
        sx, sy = separation[:, :1, None], separation[:, 1:, None]
        total = torch.zeros_like(xx)
        for i, share in _POINTS:
            for j, other in _POINTS:
                kept = self._kernel(bx, by, sx + i * along + j * skew, sy + i * skew + j * across, square)
                total = total + share * other * kept
        return total / self._far(bx, by)

    def _scale(self, middle: Tensor, bx: Tensor, by: Tensor) -> tuple[Tensor | float, Tensor | float]:
        """Return the phases of the light over those at the reference wavelength, and their squares.

        The baselines (E, 3, 3) lie near `middle` (E, 2).
        """
        least, largest = self.scales
        if largest == least:
            return least, least**2
        squared = (middle**2).sum(-1)[:, None, None]
        along = (bx * middle[:, :1, None] + by * middle[:, 1:, None] - squared) / (squared + 1e-6 * self.variance)
        # the part of it that the lenses tell apart: all of it where they lie side by side, none where they overlap
        spread = (largest - least) ** 2 / 4 * squared
        scale = 1 + along.clamp(least - 1, largest - 1) * spread / (spread + self.variance)
        return scale, scale * scale

    def _moments(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the moments xx, xy and yy (...) [m^2] of the lens at the place (x, y).

        Its width shrinks as 1 - r, its height as that of two discs; r is the distance over the hole's diameter.
        """
        x, y = x / self.geometry.reach, y / self.geometry.reach
        r = torch.sqrt(x * x + y * y + 1e-4)
        inside = (1 - r).clamp(min=0.03)  # no lens: it has no weight either
        height, width = inside * (1 + 0.6 * r), inside * inside * (1 - 0.1 * r)
        narrow, base = (width - height) / (r * r) * self.variance, height * self.variance
        return base + narrow * x * x, narrow * x * y, base + narrow * y * y


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
