"""Lenses of different pairs of holes whose baselines nearly agree: what they have in common under turbulence.

Two lenses with middles c apart, at baselines that differ by less than two holes, share

    T(u) T(u') < exp(-Q(b, c + t) / 2) >

at the baseline b, u and u' from their own ones; t is the separation of two points, one of either lens, from their
middles. It is known by its second moments, to which the exposure adds those of the drift: four points stand for it.
The mean varies little over a patch and is a parabola in b there, after a factor that is common to far lenses is split
off. The lenses of holes with themselves, at baseline 0, take part; there are N of them in one place.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.design.overlap import Geometry, PatchPlan

_SMALLEST = 3e-3  # products T T' exp(-Q / 2) below, as estimated from above, are left out
_NODE = 0.7  # of the hole's reach: where the parabolas are fixed


class Lenses(NamedTuple):
    """The lenses (B, L) of masks: L - 1 pairs of holes after those of the holes with themselves.

    values (B, L, rows, columns) T on the pixels of each one's patch, `baseline`, `corner` (B, L, 2) [pixels] with
    nu_y >= 0 (sign (B, L, 1) times that of the pair), `middle` (B, L, 2) [m] between the holes
    """

    values: Tensor
    baseline: Tensor
    corner: Tensor
    sign: Tensor
    middle: Tensor


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
    """What the pairs of lenses of masks share, for holes of one geometry under one turbulence."""

    geometry: Geometry
    seeing: Seeing
    pixel: Tensor

    def __init__(self, geometry: Geometry, seeing: Seeing, longest: float, pixel: Tensor) -> None:
        self.geometry, self.seeing, self.pixel = geometry, seeing, pixel
        reach = geometry.reach
        points, weights = geometry.shape.quadrature(4, geometry.diameter)
        self.variance: float = float((weights @ points**2).mean())  # of the points of a hole, along either axis [m^2]
        steps, shares = seeing.drift()
        moments = (shares[:, None, None] * steps[:, :, None] * steps[:, None]).sum(0)
        self.drift: tuple[float, float, float] = (float(moments[0, 0]), float(moments[0, 1]), float(moments[1, 1]))
        self.structure: StructureFunction = seeing.structure(4 * longest + 4 * reach)

    def far(self, baselines: Tensor) -> Tensor:
        """A factor (...) that follows exp(-D), the coherence of far lenses, where that is not small."""
        d = self.structure(baselines)
        return torch.exp(-d / (1 + d / 3))

    def __call__(self, lenses: Lenses, centers: Tensor, plan: PatchPlan) -> tuple[Tensor, Tensor, Tensor] | None:
        """What lenses share over `far`, as patches: their mask (S,), corner (S, 2) [pixels] and values (S, rows,
        columns); each counts once more at the opposite frequencies. None if they share nothing."""
        baselines = lenses.baseline * self.pixel
        with torch.no_grad():
            entries = self._select(lenses, baselines, centers)
        if len(entries.mask) == 0:
            return None
        mask = entries.mask
        sign = entries.sign[:, None]
        first, second = baselines[mask, entries.first], sign * baselines[mask, entries.second]
        separation = self._middles(lenses, centers, entries, 0) - self._middles(lenses, centers, entries, 1)
        nodes = self._coherence(first, second, separation)  # (E, 3, 3)
        n_slots = int(entries.slot.max()) + 1
        nodes = nodes.new_zeros(n_slots, 3, 3).index_add(0, entries.slot, nodes)
        one = torch.zeros(n_slots, dtype=torch.long, device=mask.device)
        one[entries.slot] = torch.arange(len(mask), device=mask.device)  # an entry of each slot
        mask, a, b, sign = mask[one], entries.first[one], entries.second[one], entries.sign[one]
        corner = lenses.corner[mask, a]
        mirrors = a == b  # are their own opposite
        shared = lenses.values[mask, a] * _at_the_pixels_of(lenses, mask, a, b, sign)
        shared = shared * self._parabola(nodes, corner, (first[one] + second[one]) / 2, plan)
        return mask, corner, shared * torch.where(mirrors, 1.0, 2.0).to(shared)[:, None, None]

    def _select(self, lenses: Lenses, baselines: Tensor, centers: Tensor) -> Entries:
        n, count = centers.shape[1], baselines.shape[1]
        upper = torch.ones(count, count, dtype=torch.bool, device=centers.device).triu(1)
        limit, found = 2 * self.geometry.reach, []
        for sign in (1, -1):
            distance = (sign * baselines[:, None] - baselines[:, :, None]).norm(dim=-1)
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
        rows = rows[self._largest(result, lenses, baselines, centers) > _SMALLEST]
        key = ((rows[:, 0] * count + rows[:, 1]) * count + rows[:, 2]) * 2 + (rows[:, 3] > 0)
        slot = torch.unique(key, return_inverse=True)[1]
        return Entries(rows[:, 0], rows[:, 1], rows[:, 2], rows[:, 3], rows[:, 4:], slot)

    def _largest(self, entries: Entries, lenses: Lenses, baselines: Tensor, centers: Tensor) -> Tensor:
        """About the most that each entry gives anywhere (E,)."""
        first = baselines[entries.mask, entries.first]
        second = entries.sign[:, None] * baselines[entries.mask, entries.second]
        separation = self._middles(lenses, centers, entries, 0) - self._middles(lenses, centers, entries, 1)
        reach = self.geometry.reach
        lens = self.geometry.shape.otf((first - second) / 2, self.geometry.diameter) ** 2
        near = [
            vector * (1 - reach / 2 / vector.norm(dim=-1, keepdim=True)).clamp(min=0)
            for vector in ((first + second) / 2, separation)
        ]
        return lens * self._kernel(*near)

    def _middles(self, lenses: Lenses, centers: Tensor, entries: Entries, which: int) -> Tensor:
        """Of the first or second lens of each entry (E, 2) [m]."""
        lens = entries.second if which else entries.first
        hole = centers[entries.mask, entries.holes[:, which]]
        return torch.where((lens == 0)[:, None], hole, lenses.middle[entries.mask, lens])

    def _kernel(self, baseline: Tensor, separation: Tensor) -> Tensor:
        """exp(-Q / 2) (...)."""
        structure = self.structure
        crossed = structure(separation + baseline) + structure(separation - baseline)
        return torch.exp(crossed / 2 - structure(baseline) - structure(separation))

    def _coherence(self, first: Tensor, second: Tensor, separation: Tensor) -> Tensor:
        """The mean of exp(-Q / 2) over `far` at 3 x 3 baselines around that midway (E, rows, columns)."""
        step = _NODE * self.geometry.reach * torch.arange(-1.0, 2.0, dtype=first.dtype, device=first.device)
        offsets = torch.stack(torch.meshgrid(step, step, indexing="xy"), -1)
        half = ((second - first) / 2)[:, None, None]
        baseline = ((first + second) / 2)[:, None, None] + offsets
        xx, xy, yy = (
            one + other + drift
            for one, other, drift in zip(
                self._moments(offsets + half), self._moments(offsets - half), self.drift, strict=True
            )
        )
        # the symmetric square root: a mask that is turned by 90 degrees has the same points
        root = torch.sqrt((xx * yy - xy**2).clamp(min=1e-6 * self.variance**2))
        trace = torch.sqrt(xx + yy + 2 * root)
        along, skew, across = (xx + root) / trace, xy / trace, (yy + root) / trace
        total = torch.zeros_like(xx)
        for i in (-1, 1):
            for j in (-1, 1):
                t = torch.stack([i * along + j * skew, i * skew + j * across], -1)
                total = total + self._kernel(baseline, separation[:, None, None] + t)
        return total / (4 * self.far(baseline))

    def _moments(self, place: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """xx, xy and yy (...) [m^2] of the lens at `place` (..., 2): its width shrinks as 1 - x, its height as that of
        two discs, x the distance over the hole's diameter."""
        scaled = place / self.geometry.reach
        squared = (scaled**2).sum(-1) + 1e-4
        x = torch.sqrt(squared)
        inside = (1 - x).clamp(min=0.03)  # no lens: it has no weight either
        narrow, base = -2 * inside / x * self.variance, inside * (1 + x) * self.variance
        a, b = scaled.unbind(-1)
        return base + narrow * a * a, narrow * a * b, base + narrow * b * b

    def _parabola(self, nodes: Tensor, corner: Tensor, middle: Tensor, plan: PatchPlan) -> Tensor:
        """The values at 3 x 3 nodes around `middle` (S, 2) [m] on the pixels of the patches (S, rows, columns)."""
        step = _NODE * self.geometry.reach
        start = (corner * self.pixel - middle) / step
        x = start[:, :1] + plan.column * (float(self.pixel[0]) / step)
        y = start[:, 1:] + torch.arange(len(plan.row), device=x.device) * (float(self.pixel[1]) / step)
        rows = _quadratic(nodes, x[:, None, :])  # (S, 3, columns)
        return _quadratic(rows.transpose(1, 2)[:, None], y[:, :, None])


def _quadratic(nodes: Tensor, t: Tensor) -> Tensor:
    """The parabola through values (..., 3) at -1, 0, 1, at t (...)."""
    below, middle, above = (nodes[..., k, None] if nodes.ndim == 3 else nodes[..., k] for k in range(3))
    return middle + t * ((above - below) / 2 + t * ((above + below) / 2 - middle))


def _at_the_pixels_of(lenses: Lenses, mask: Tensor, a: Tensor, b: Tensor, sign: Tensor) -> Tensor:
    """The second lens on the patches of the first, (S, rows, columns); turned by half a turn where its sign is -1."""
    rows, columns = lenses.values.shape[-2:]
    padded = torch.nn.functional.pad(lenses.values, (1, 1, 1, 1))
    size = torch.tensor([columns, rows], device=mask.device)
    corner, other = lenses.corner[mask, a].long(), lenses.corner[mask, b].long()
    positive = (sign > 0)[:, None]
    shift = torch.where(positive, corner - other, corner + other + size - 1)
    index = []
    for axis, count in enumerate((columns, rows)):
        place = shift[:, axis, None] + torch.arange(count, device=mask.device)
        place = torch.where(positive, place, count - 1 - place)
        index.append(place.clamp(-1, count) + 1)
    start = (mask * lenses.values.shape[1] + b) * ((rows + 2) * (columns + 2))
    flat = start[:, None, None] + index[1][:, :, None] * (columns + 2) + index[0][:, None, :]
    return padded.flatten()[flat]
