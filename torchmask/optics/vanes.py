"""The open area between the straight vanes of a telescope's spider: its edges, its sectors and its overlaps.

Lengths are in units of the pupil's radius. Each vane runs from the central obstruction, or from the vanes beside it, to
the rim, so that the pupil is an outer circle less an inner one less half-strips from the origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from torchmask.optics.shape_base import Array

_ON_EDGE = 1e-9  # distance from an edge within which a point counts half: where edges of both copies coincide
_WIDEST = math.pi / 2  # angle of a sector, so that no ray from its corner meets the obstruction again
_BLOCK = 512  # shifts in work at a time


class Spider(NamedTuple):
    """Radius of the central obstruction, half the width of a vane, and the ascending angles of the vanes [rad]."""

    obstruction: float
    half_width: float
    angles: tuple[float, ...]

    @classmethod
    def of(cls, obstruction: float, half_width: float, angles: Sequence[float]) -> Spider:
        """Return the spider with vanes at `angles` in any order [rad]."""
        return cls(obstruction, half_width, tuple(sorted(angle % (2 * math.pi) for angle in angles)))

    def gaps(self) -> list[float]:
        """Return the angle from each vane to the next."""
        ahead = [*self.angles[1:], self.angles[0] + 2 * math.pi]
        return [after - angle for angle, after in zip(self.angles, ahead, strict=True)]

    def corners(self) -> list[float]:
        """Return how far along the vanes each of them meets the next, 0 if they do not."""
        return [max(0.0, self.half_width / math.tan(min(gap, math.pi) / 2)) for gap in self.gaps()]

    def frames(self) -> tuple[Array, Array]:
        """Return unit vectors (V, 2) along the vanes and across them, counterclockwise."""
        cosine, sine = np.cos(self.angles), np.sin(self.angles)
        return np.stack([cosine, sine], -1), np.stack([-sine, cosine], -1)


class Edges(NamedTuple):
    """The boundary of the open area, L segments and A arcs around the origin.

    along, outward : (L, 2) unit vectors along the segments, and normals that point out of the open area
    offset : distance of the segments' lines from the origin along `outward`
    segments : (L, 2) start and end along the line, from its point nearest to the origin
    radius, side : (A,) radii of the arcs, and 1 where they bound the open area from outside, else -1
    arcs : (A, 2) angles of start and end
    """

    along: Array
    outward: Array
    offset: float
    segments: Array
    radius: Array
    side: Array
    arcs: Array

    @property
    def area(self) -> float:
        """The area inside, by Green's theorem: half the integral of x . outward along the boundary."""
        length, angle = np.diff(self.segments)[:, 0], np.diff(self.arcs)[:, 0]
        return float(self.offset * length.sum() + self.side * self.radius**2 @ angle) / 2


@lru_cache(maxsize=32)
def edges(spider: Spider) -> Edges:
    """Return the boundary of the open area."""
    inner, half, angles = spider.obstruction, spider.half_width, np.array(spider.angles)
    gaps, corners = np.array(spider.gaps()), np.array(spider.corners())
    along, across = spider.frames()
    start = np.maximum(math.sqrt(max(inner**2 - half**2, 0.0)), corners)  # of the edge towards the next vane
    begin, end = np.concatenate([start, np.roll(start, 1)]), np.full(2 * len(gaps), math.sqrt(1 - half**2))
    ends = [angles + math.asin(half), angles + gaps - math.asin(half)]
    radius, side, arcs = np.ones(len(gaps)), np.ones(len(gaps)), np.stack(ends, -1)
    free = np.hypot(half, corners) < inner  # vanes that meet outside the obstruction hide it
    if free.any():
        hidden = math.asin(half / inner)
        open_ = np.stack([angles + hidden, angles + gaps - hidden], -1)[free]
        radius, side = np.append(radius, np.full(len(open_), inner)), np.append(side, np.full(len(open_), -1.0))
        arcs = np.concatenate([arcs, open_])
    return Edges(
        np.concatenate([along, along]),
        np.concatenate([-across, across]),
        -half,
        np.stack([begin, end], -1),
        radius,
        side,
        arcs,
    )


def vaned_otf(shift: Tensor, spider: Spider) -> Tensor:
    """Return the overlap (...) of the pupil with itself displaced by `shift` (..., 2), over the open area.

    It is computed in float64 and returned in the dtype of `shift`.
    """
    overlap: Tensor = _VanedOverlap.apply(shift.double().reshape(-1, 2), spider)
    return (overlap / edges(spider).area).reshape(shift.shape[:-1]).to(shift.dtype)


class _VanedOverlap(torch.autograd.Function):
    """Area (F,) that the pupil shares with its copy displaced by `shift` (F, 2), float64.

    By Green's theorem it is an integral along the parts of each boundary that lie in the other copy. Its derivative is
    the integral of the outward normal of the moved copy, and is taken as 0 at zero shift.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(shift: Tensor, spider: Spider) -> Tensor:
        total = edges(spider).area
        parts = []
        for block in shift.split(_BLOCK):
            ahead, normal = _inside(block, spider)
            behind, _ = _inside(-block, spider)
            parts.append(ahead + behind + (block * normal).sum(-1) / 2)
        distance = (shift**2).sum(-1)
        return torch.where(distance == 0, total, torch.cat(parts) * (distance < 4))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        shift, ctx.spider = inputs
        ctx.save_for_backward(shift)

    @staticmethod
    def backward(ctx: Any, *grad: Tensor) -> tuple[Tensor, None]:
        (shift,) = ctx.saved_tensors
        normal = torch.cat([_inside(block, ctx.spider)[1] for block in shift.split(_BLOCK)])
        distance = (shift**2).sum(-1, keepdim=True)
        return normal * ((distance > 0) & (distance < 4)) * grad[0][:, None], None


def _inside(shift: Tensor, spider: Spider) -> tuple[Tensor, Tensor]:
    """Integrate x . n / 2 (F,) and n (F, 2) over the boundary points x, of normal n, for which x + shift is open."""
    bound = edges(spider)
    along, outward, segments, radius, side, arcs = (
        shift.new_tensor(part) for part in (bound.along, bound.outward, bound.segments, *bound[4:])
    )
    begin, end = _open_segments(shift, spider, along, bound.offset * outward, segments)
    length = (end - begin).sum(-1)  # (F, L)
    value, normal = bound.offset / 2 * length.sum(-1), length @ outward
    first, last, share = _open_arcs(shift, spider, radius, arcs)
    value = value + (share * (last - first)).sum(-1) @ (side * radius**2) / 2
    turn = torch.stack([last.sin() - first.sin(), first.cos() - last.cos()], -1)  # (F, A, pieces, 2)
    return value, normal + ((share[..., None] * turn).sum(-2) * (side * radius)[:, None]).sum(-2)


def _open_segments(
    shift: Tensor, spider: Spider, along: Tensor, foot: Tensor, segments: Tensor
) -> tuple[Tensor, Tensor]:
    """Return starts and ends (F, L, pieces) of the segments, cut at the other copy's edges and scaled by openness."""
    place = shift[:, None] + foot  # (F, L, 2)
    middle = -(place * along).sum(-1, keepdim=True)
    apart = (place**2).sum(-1, keepdim=True) - middle**2
    cuts = [middle + sign * (r**2 - apart).clamp(min=0).sqrt() for r in (1.0, spider.obstruction) for sign in (1, -1)]
    across = shift.new_tensor(spider.frames()[1])  # (V, 2)
    slope = along @ across.T  # (L, V)
    parallel = slope.abs() < 1e-12
    for edge in (spider.half_width, -spider.half_width):
        cuts.append(torch.where(parallel, 0.0, edge - place @ across.T) / torch.where(parallel, 1.0, slope))
    ends = segments.expand(len(shift), *segments.shape)
    inner = torch.cat(cuts, -1)
    points = torch.cat([ends, torch.minimum(torch.maximum(inner, ends[..., :1]), ends[..., 1:])], -1).sort(-1).values
    begin, end = points[..., :-1], points[..., 1:]
    share = _openness(place[..., None, :] + ((begin + end) / 2)[..., None] * along[:, None], spider)
    return share * begin, share * end


def _open_arcs(shift: Tensor, spider: Spider, radius: Tensor, arcs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return starts, ends and openness (F, A, pieces) of the arcs, cut at the other copy's edges."""
    x, y = shift.unbind(-1)
    distance = torch.hypot(x, y).clamp(min=1e-30)[:, None]
    heading = torch.atan2(y, x)[:, None]
    cuts = []
    for r in (1.0, spider.obstruction):
        angle = ((r**2 - radius**2 - distance**2) / (2 * radius * distance)).clamp(-1, 1).acos()  # (F, A)
        cuts += [(heading + angle)[..., None], (heading - angle)[..., None]]
    aside = shift @ shift.new_tensor(spider.frames()[1]).T  # (F, V)
    vanes = shift.new_tensor(spider.angles)
    for edge in (spider.half_width, -spider.half_width):
        angle = ((edge - aside[:, None]) / radius[:, None]).clamp(-1, 1).asin()  # (F, A, V)
        cuts += [vanes + angle, vanes + math.pi - angle]
    ends = arcs.expand(len(shift), *arcs.shape)
    inner = ends[..., :1] + torch.remainder(torch.cat(cuts, -1) - ends[..., :1], 2 * math.pi)
    points = torch.cat([ends, torch.minimum(inner, ends[..., 1:])], -1).sort(-1).values
    begin, end = points[..., :-1], points[..., 1:]
    middle = (begin + end) / 2
    place = radius[:, None, None] * torch.stack([middle.cos(), middle.sin()], -1)
    return begin, end, _openness(place + shift[:, None, None], spider)


def _openness(points: Tensor, spider: Spider) -> Tensor:
    """Return 1 for points (..., 2) in the open area, 0 for others, and 1/2 on an edge."""
    r = torch.linalg.vector_norm(points, dim=-1)
    margin = torch.minimum(1 - r, r - spider.obstruction)
    for angle in spider.angles:
        cosine, sine = math.cos(angle), math.sin(angle)
        along, across = (points[..., 0] * a + points[..., 1] * b for a, b in ((cosine, sine), (-sine, cosine)))
        margin = torch.minimum(margin, torch.maximum(-along, across.abs() - spider.half_width))
    return torch.where(margin.abs() < _ON_EDGE, 0.5, (margin > 0).to(points.dtype))


def sector_quadrature(spider: Spider, degree: int) -> tuple[Array, Array]:
    """Return points (Q, 2) and positive weights (Q,), of unit sum, for means of polynomials over the open area.

    Each sector between two vanes has a corner, from which rays reach the obstruction and the rim: Gauss nodes along
    the rays, whose number makes means exact, and in their angles.
    """
    nodes, weights = (np.polynomial.legendre.leggauss(n) for n in (degree // 2 + 2, degree + 10)), []
    (along, share), (turned, part) = (((x + 1) / 2, w / 2) for x, w in nodes)
    points = []
    for first, last, corner in _sectors(spider):
        angle = first + (last - first) * turned
        ray = np.stack([np.cos(angle), np.sin(angle)], -1)
        ahead, apart = ray @ corner, corner @ corner
        far = np.sqrt(ahead**2 + 1 - apart) - ahead
        near = np.sqrt(ahead**2 + spider.obstruction**2 - apart) - ahead if apart < spider.obstruction**2 else 0 * far
        reach = near[:, None] + (far - near)[:, None] * along
        points.append((corner + reach[..., None] * ray[:, None]).reshape(-1, 2))
        weights.append((((last - first) * part * (far - near))[:, None] * share * reach).ravel())
    weight = np.concatenate(weights)
    return np.concatenate(points), weight / weight.sum()


def _sectors(spider: Spider) -> list[tuple[float, float, Array]]:
    """Return first and last angle and the corner (2,) of convex sectors of which the open area consists."""
    found = []
    for angle, gap in zip(spider.angles, spider.gaps(), strict=True):
        n = math.ceil(gap / _WIDEST - 1e-9)
        for k in range(n):
            first, last = angle + k * gap / n, angle + (k + 1) * gap / n
            sides = np.array([[-math.sin(first), math.cos(first)], [-math.sin(last), math.cos(last)]])
            offset = spider.half_width * np.array([k == 0, -(k == n - 1)])
            found.append((first, last, np.linalg.solve(sides, offset)))
    return found


def vane_transform(spider: Spider, frequency: Array) -> Any:
    """Return the Fourier transform (...) of the vanes, complex, their area at frequency (..., 2) zero.

    It is exact along the vanes and by Gauss nodes across them, where their ends are smooth.
    """
    n = 16 + math.ceil(math.pi * spider.half_width * float(np.abs(frequency).max(initial=0.0)))
    nodes, weights = np.polynomial.legendre.leggauss(n)
    nodes, weights = (nodes + 1) / 2, weights / 2
    inner, half, gaps = spider.obstruction, spider.half_width, spider.gaps()
    total = np.zeros(frequency.shape[:-1], dtype=np.complex128)
    for k, (along, across) in enumerate(zip(*spider.frames(), strict=True)):
        for gap, side in ((gaps[k], 1), (gaps[k - 1], -1)):
            slope = math.tan(min(gap, math.pi) / 2)
            turn = min(math.asin(min(half / inner, 1.0)), math.atan(slope)) if inner > 0 else 0.0
            edge = inner * math.sin(turn)  # up to here the vane ends on the obstruction, beyond on the next vane
            t = np.concatenate([inner * np.sin(turn * nodes), edge + (half - edge) * nodes])
            w = np.concatenate([turn * weights * inner * np.cos(turn * nodes), (half - edge) * weights])
            start = np.maximum(np.sqrt(np.clip(inner**2 - t**2, 0, None)), t / slope)
            length, middle = np.sqrt(1 - t**2) - start, (np.sqrt(1 - t**2) + start) / 2
            ahead, aside = (frequency @ along)[..., None], (frequency @ across)[..., None]
            wave = np.exp(-2j * np.pi * (ahead * middle + side * aside * t))
            total += (w * length * np.sinc(ahead * length) * wave).sum(-1)
    return total
