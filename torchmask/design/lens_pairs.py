"""Lenses of different pairs of holes whose baselines nearly agree: what they have in common under turbulence.

Two lenses with middles c apart, at baselines that differ by less than two holes, share

    T(u) T(u') < exp(-Q(b, c + t) / 2) >

at the baseline b, u and u' from their own ones; t is the separation of two points, one of either lens, from their
middles. The logarithm of the mean (`torchmask.design.pair_coherence`) is a parabola in b over a patch, after a factor
that is common to far lenses is split off. The lenses of holes with themselves, at baseline 0, take part; there are N of
them in one place.
"""

from __future__ import annotations

from collections.abc import Sequence
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

    Lenses are counted through all masks, and so is the `hole` to which a first lens at baseline 0 belongs; the second
    one is never there. Pairs that share `slot` have the same baselines.
    """

    mask: Tensor
    first: Tensor
    second: Tensor
    sign: Tensor
    hole: Tensor
    slot: Tensor


class LensPairs:
    """What pairs of lenses of a mask share, for holes of one geometry; `pixel` (2,) [m]."""

    def __init__(self, geometry: Geometry, coherence: PairCoherence, plane: FrequencyPlane, pixel: Tensor) -> None:
        self.geometry, self.coherence, self.plane, self.pixel = geometry, coherence, plane, pixel

    def __call__(self, lenses: Lenses, centers: Tensor) -> Tensor:
        """Return what lenses share over `far`, on planes (B, pixels). It counts at the opposite frequencies too."""
        n_pixels = len(centers) * self.plane.n_pixels
        with torch.no_grad():
            entries, largest = self._select(lenses, centers)
        if len(entries.mask) == 0:
            return centers.new_zeros(len(centers), self.plane.n_pixels)
        first, second, separation = self._places(entries, lenses, centers)
        middle = (first + second) / 2
        step = _NODE * (self.geometry.reach + self.coherence.spread / 2 * middle.abs())
        n_slots = int(entries.slot.max()) + 1
        shared = middle.new_zeros(n_slots, 9)  # at the nodes of the parabolas
        rich = largest > _RICH
        for some, n in ((rich, 3), (~rich, 1)):
            which = some.nonzero()[:, 0]
            places = (part.index_select(0, which) for part in (first, second, separation, step))
            found = self.coherence.around(*places, n=n).flatten(1)
            shared = shared.index_add(0, entries.slot.index_select(0, which), found.expand(-1, 9))
        one = torch.zeros_like(entries.slot[:n_slots])
        one[entries.slot] = torch.arange(len(largest), device=one.device)  # an entry of each slot
        pairs = Entries(*(part[one] for part in entries))
        own = pairs.first == pairs.second  # their own opposite
        shared = shared * torch.where(own, 1.0, 2.0).to(shared)[:, None]
        logarithm = shared.clamp(min=_NOTHING).log2().unflatten(1, (3, 3))
        middle, step = middle[one], step[one]
        pixels = CommonPixels.of(lenses, self.plane, *pairs[:4])
        if len(pixels.pair) == 0:
            return centers.new_zeros(len(centers), self.plane.n_pixels)
        turns = lenses.turns.flatten(0, 1)[pairs.first]
        start, unit = ((pixels.corner + turns) * self.pixel - middle) / step, self.pixel / step
        aliased, values = turns.any(-1), lenses.values.flatten(1)
        if not aliased.any():
            lines = _lines(logarithm, start, unit, pixels)
            return SharedLight.apply(values, lines, pixels, n_pixels).view(len(centers), -1)  # type: ignore[no-any-return]
        # `far` belongs to true baselines: lenses that alias have planes of their own, and their coherence itself
        far = self._far_at_nodes(middle, step).log2()
        lines = _lines(logarithm + torch.where(aliased[:, None, None], far, 0.0), start, unit, pixels)
        pixels = pixels._replace(target=pixels.target + n_pixels * aliased[pixels.pair])
        found, others = SharedLight.apply(values, lines, pixels, 2 * n_pixels).view(2, len(centers), -1)
        far = self.coherence.far(*self.plane.baselines.to(found).unbind(-1))
        return found + others / far  # type: ignore[no-any-return]

    def _far_at_nodes(self, middle: Tensor, step: Tensor) -> Tensor:
        """Return `far` (S, y, x) at the nodes of parabolas around `middle` (S, 2), `step` (S, 2) apart, all in m."""
        node = torch.arange(-1, 2, device=middle.device)
        x, y = (middle[:, None] + node[:, None] * step[:, None]).unbind(-1)
        return self.coherence.far(x[:, None], y[:, :, None])

    def _select(self, lenses: Lenses, centers: Tensor) -> tuple[Entries, Tensor]:
        """Return the pairs that share something, and about the most that each gives anywhere."""
        n, count = centers.shape[1], lenses.baseline.shape[1]
        numbers = torch.arange(count, device=centers.device)
        one, other = numbers[:, None], numbers
        x, y = ((lenses.baseline + lenses.turns) * self.pixel).unbind(-1)
        limit, found = (2 * self.geometry.reach) ** 2, []
        # lenses at baseline 0 are their own opposites: what they share with another's opposite, they share with it
        for sign, allowed in ((1, one < other), (-1, (one > 0) & (one <= other))):
            dx, dy = self._between([sign * part[:, :, None] for part in (x, y)], [part[:, None] for part in (x, y)])
            mask, i, j = ((torch.addcmul(dx * dx, dy, dy) < limit) & allowed).nonzero().unbind(-1)
            found.append((mask, mask * count + i, mask * count + j, torch.full_like(mask, sign)))
        columns = [torch.cat(parts) for parts in zip(*found, strict=True)]
        columns.append(torch.arange(len(columns[0]), device=centers.device))
        central = columns[1] % count == 0
        order = torch.cat([(~central).nonzero()[:, 0], central.nonzero()[:, 0].repeat_interleave(n)])
        mask, first, second, sign, slot = (column.index_select(0, order) for column in columns)
        entries = Entries(mask, first, second, sign, mask * n + torch.arange(len(mask), device=mask.device) % n, slot)
        largest = self._largest(*self._places(entries, lenses, centers))
        kept = (largest > _SMALLEST).nonzero()[:, 0]
        entries = Entries(*(column.index_select(0, kept) for column in entries))
        changes = entries.slot.diff(prepend=entries.slot[:1]) != 0  # those of one slot follow each other
        return entries._replace(slot=changes.cumsum(0)), largest[kept]

    def _places(self, entries: Entries, lenses: Lenses, centers: Tensor) -> list[Tensor]:
        """Return the baselines of both lenses of each entry and the separation of their middles, (E, 2) [m]."""
        baselines = ((lenses.baseline + lenses.turns) * self.pixel).flatten(0, 1)  # not those on the torus
        middles = lenses.middle.flatten(0, 1)
        first, second = (baselines.index_select(0, lens) for lens in (entries.first, entries.second))
        middle, other = (middles.index_select(0, lens) for lens in (entries.first, entries.second))
        central = (entries.first % lenses.baseline.shape[1] == 0)[:, None]
        middle = torch.where(central, centers.flatten(0, 1).index_select(0, entries.hole), middle)
        return [first, second * entries.sign[:, None], middle - other]

    def _between(self, first: Sequence[Tensor], second: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
        """Return the difference (x, y) of two baselines (x, y) at the wavelengths of a band that bring them nearest.

        Over the band a baseline moves along itself, by the spread of the phases.
        """
        x, y = (one - other for one, other in zip(first, second, strict=True))
        spread = self.coherence.spread
        if spread == 0:
            return x, y
        middle_x, middle_y = ((one + other) / 2 for one, other in zip(first, second, strict=True))
        square = torch.addcmul(middle_x * middle_x, middle_y, middle_y).clamp(min=1e-9 * self.geometry.reach**2)
        moved = ((x * middle_x + y * middle_y) / square).clamp(-spread, spread)
        return x - moved * middle_x, y - moved * middle_y

    def _largest(self, first: Tensor, second: Tensor, separation: Tensor) -> Tensor:
        """Return about the most that lenses of each entry at these places (E, 2) [m] give anywhere (E,)."""
        reach = self.geometry.reach
        between = torch.stack(self._between(first.unbind(-1), second.unbind(-1)), -1)
        lens = self.geometry.shape.otf(between / 2, self.geometry.diameter) ** 2
        near = []
        for x, y in (((first + second) / 2).unbind(-1), separation.unbind(-1)):
            shrunk = (1 - reach / 2 * torch.rsqrt(x * x + y * y)).clamp(min=0)
            near += [shrunk * x, shrunk * y]
        near = [vector.nan_to_num(0.0) for vector in near]
        return lens * self.coherence.of_points(*near)


def _lines(nodes: Tensor, start: Tensor, step: Tensor, pixels: CommonPixels) -> Tensor:
    """Return the coefficients (R, 3), in powers of the pixel, of a polynomial through 3 x 3 nodes (S, y, x) on the rows
    of pixels.

    The pairs' corners lie at `start` (S, 2), pixels are `step` (S, 2) apart, in units of the nodes' distance.
    """
    rows = _coefficients(nodes, start[:, 1:], step[:, 1:])  # (S, 3, x)
    both = _coefficients(rows.transpose(1, 2), start[:, :1], step[:, :1])  # (S, 3 of x, 3 of y)
    lines = powers_of(int(pixels.row.max()) + 1, nodes).T @ both.permute(2, 0, 1).flatten(1)  # (rows, S * 3 of x)
    constant, slope, curvature = lines.view(-1, 3).index_select(0, pixels.row * len(nodes) + pixels.pair).unbind(1)
    x = pixels.column.to(nodes)
    bent = x * curvature
    return torch.stack([torch.addcmul(constant, x, slope + bent), slope + 2 * bent, curvature], 1)


def _coefficients(nodes: Tensor, start: Tensor, step: Tensor) -> Tensor:
    """Return the coefficients (S, 3, k), in powers of the pixel, of parabolas through values (S, 3, k) at -1, 0, 1."""
    below, middle, above = nodes.unbind(1)
    slope, curvature = (above - below) / 2, (above + below) / 2 - middle
    at_start = middle + start * (slope + start * curvature)
    return torch.stack([at_start, step * (slope + 2 * start * curvature), step**2 * curvature], 1)
