"""Lenses of different pairs of holes whose baselines nearly agree: what they have in common under turbulence.

Two lenses with middles c apart, at baselines that differ by less than two holes, share

    T(u) T(u') < exp(-Q(b, c + t) / 2) >

at the baseline b, u and u' from their own ones; t is the separation of two points, one of either lens, from their
middles. The logarithm of the mean (`torchmask.design.pair_coherence`) is a parabola in b over a patch, after a factor
that is common to far lenses is split off. The lenses of holes with themselves, at baseline 0, take part; there are N of
them in one place.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.design.common_pixels import CommonPixels, SharedLight, powers_of
from torchmask.design.frequency_plane import FrequencyPlane
from torchmask.design.lens_patches import Lenses
from torchmask.design.overlap import Geometry
from torchmask.design.pair_coherence import PairCoherence

_SMALLEST = 5e-4  # products T T' exp(-Q / 2) below, as estimated, are left out
_RICH = 0.005  # of those that are never larger the coherence is taken to be constant
_NODE = 0.4  # of the hole's reach: where the parabolas are fixed, as lenses transmit little further out
_NOTHING = 1e-30  # coherence


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

    def __init__(self, geometry: Geometry, coherence: PairCoherence, plane: FrequencyPlane, pixel: Tensor) -> None:
        self.geometry, self.coherence, self.plane, self.pixel = geometry, coherence, plane, pixel

    def __call__(self, lenses: Lenses, centers: Tensor) -> Tensor:
        """Return what lenses share over `far`, on planes (B, pixels). It counts once more at the opposite frequencies."""
        n_pixels = len(centers) * self.plane.n_pixels
        baselines = lenses.baseline * self.pixel
        with torch.no_grad():
            entries, largest = self._select(lenses, baselines, centers)
        if len(entries.mask) == 0:
            return centers.new_zeros(len(centers), self.plane.n_pixels)
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
        middle, step = middle[one], step[one]
        pixels = CommonPixels.of(lenses, self.plane, pairs.mask, pairs.first, pairs.second, pairs.sign)
        start, unit = (pixels.corner * self.pixel - middle) / step, self.pixel / step
        lines = _lines(nodes, start, unit, pixels)
        found = SharedLight.apply(lenses.values.flatten(1), lines, pixels, n_pixels)
        return found.view(len(centers), -1)  # type: ignore[no-any-return]

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


def _lines(nodes: Tensor, start: Tensor, step: Tensor, pixels: CommonPixels) -> Tensor:
    """Return the coefficients (R, 3), in powers of the pixel, of a polynomial through 3 x 3 nodes (S, y, x) on the rows
    of pixels.

    The first pixel lies at `start` (S, 2), the others are `step` (S, 2) apart, in units of the nodes' distance.
    """
    rows = _coefficients(nodes, start[:, 1:], step[:, 1:])  # (S, 3, x)
    both = _coefficients(rows.transpose(1, 2), start[:, :1], step[:, :1])  # (S, 3 of x, 3 of y)
    n_rows = int(pixels.row.max()) + 1
    lines = (both @ powers_of(n_rows, nodes)).flatten()  # (S, 3 of x, rows)
    powers = torch.arange(3, device=nodes.device)
    index = (pixels.pair[:, None] * 3 + powers) * n_rows + pixels.row[:, None]
    return lines.index_select(0, index.flatten()).view(-1, 3)


def _coefficients(nodes: Tensor, start: Tensor, step: Tensor) -> Tensor:
    """Return the coefficients (S, 3, k), in powers of the pixel, of parabolas through values (S, 3, k) at -1, 0, 1."""
    below, middle, above = nodes.unbind(1)
    slope, curvature = (above - below) / 2, (above + below) / 2 - middle
    at_start = middle + start * (slope + start * curvature)
    return torch.stack([at_start, step * (slope + 2 * start * curvature), step**2 * curvature], 1)
