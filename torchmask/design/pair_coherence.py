"""Coherence under turbulence of two lenses, overlaps of different pairs of holes, at the baselines that they share.

For lenses with middles s apart it is, at the baseline b, the mean over t of

    exp(-E[(a (phi_1 - phi_2) - a' (phi_3 - phi_4))^2] / 2)

(`torchmask.atmosphere.transfer.difference_variance`) for pairs of points s + t apart, one in each lens, and light whose
phases are a and a' times those at the reference wavelength: exp(-Q(b, s + t) / 2) for one wavelength. The separation t
is known by its second moments, to which the exposure adds those of the drift: nine points stand for it.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence, colour_loss
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.design.early_gradient import by_chunks
from torchmask.design.overlap import Geometry
from torchmask.design.spline_table import SplineTable
from torchmask.memory import AtATime

_KURTOSIS = 2.5  # along one axis, of the separation of two points of two discs
_PLACES = [
    (i * math.sqrt(_KURTOSIS), (1 - abs(i)) * (1 - 1 / _KURTOSIS) + abs(i) / (2 * _KURTOSIS)) for i in (-1, 0, 1)
]
_POINTS = [(i, j, a * b) for i, a in _PLACES for j, b in _PLACES]
# what the exponent sums, by the signs of the baselines that are added to a separation, and the factor of the structure
# function there: -Q(b, s) / 2, and the same of two colours, b being the mean and half the difference of their baselines
_ONE_COLOUR = [(1, 0.5), (-1, 0.5), (0, -1.0)]
_TWO_COLOURS = [(1, 0, 0.5), (-1, 0, 0.5), (0, 1, -0.5), (0, -1, -0.5)]
_LIGHT = 0.13  # mean square of a place in a lens's T, a Gaussian here, along either axis, over the hole's diameter^2
_LOG2E = 1 / math.log(2)
_STEPS = 4  # of the spline to a hole
_CHUNK = AtATime(processor=2**14, gpu=2**18)  # baselines


class PairCoherence:
    """Coherence of lenses of holes of one geometry under one turbulence, at baselines up to `longest` [m].

    colours : what the wavelengths of a band have in common; None for the reference wavelength alone
    """

    def __init__(
        self,
        geometry: Geometry,
        seeing: Seeing,
        colours: ColourCoherence | None,
        longest: float,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.reach: float = geometry.reach
        terms = _ONE_COLOUR if colours is None else _TWO_COLOURS
        # (terms, points, axes): the displacements of each term, over the middles' separation, the axes of the lenses'
        # own separations, and the baselines
        rows = [[(1.0, i, j, *signs) for i, j, _ in _POINTS] for *signs, _ in terms]
        self.displacements: Tensor = torch.tensor(rows, dtype=torch.float64).to(device, dtype)
        self.factors: list[float] = [factor for *_, factor in terms]
        self.weights: Tensor = torch.tensor([weight for *_, weight in _POINTS], dtype=torch.float64).to(device, dtype)
        points, weights = geometry.shape.quadrature(4, geometry.diameter)
        self.variance: float = float((weights @ points**2).mean())  # of the points of a hole, along either axis [m^2]
        steps, shares = seeing.drift()
        moments = (shares[:, None, None] * steps[:, :, None] * steps[:, None]).sum(0)
        self.drift: tuple[float, float, float] = (float(moments[0, 0]), float(moments[0, 1]), float(moments[1, 1]))
        self.structure: StructureFunction = seeing.structure(4 * longest + 4 * self.reach)
        self.colours: SplineTable | None = None
        self.spread: float = 0.0  # of the phases of a band, between its ends
        if colours is not None:
            self.scales: Tensor = colours.scales.to(device, dtype)
            self.shares: Tensor = colours.shares.to(device, dtype)
            self.spread = float(self.scales.max() - self.scales.min())
            self.colours = SplineTable(colours.factors, longest, geometry.diameter / _STEPS, dtype, device)

    def far(self, x: Tensor, y: Tensor) -> Tensor:
        """Return a factor (...) that follows exp(-D), the coherence of far lenses, where that is not small."""
        return torch.exp(_log_far(self.structure.at(x, y)))

    def of_points(self, bx: Tensor, by: Tensor, sx: Tensor, sy: Tensor) -> Tensor:
        """Return exp(-Q(b, s) / 2) (...) for pairs of points s apart at the reference wavelength."""
        crossed = self.structure.at(sx + bx, sy + by) + self.structure.at(sx - bx, sy - by)
        return torch.exp(crossed / 2 - self.structure.at(bx, by) - self.structure.at(sx, sy))

    def around(self, first: Tensor, second: Tensor, separation: Tensor, step: Tensor, n: int) -> Tensor:
        """Return the coherence over `far`, (E, rows, columns), at n x n baselines around that midway.

        Lenses have the baselines `first` and `second` (E, 2) and middles a `separation` (E, 2) apart; the baselines
        are `step` (E, 2) apart, all in m.
        """
        node = torch.arange(n, dtype=first.dtype, device=first.device) - (n - 1) / 2
        nodes = torch.stack(torch.meshgrid(node, node, indexing="xy")).flatten(1)[..., None]  # (2, n * n, 1)
        first, second, separation, step = (one.T[:, None] for one in (first, second, separation, step))
        parts = torch.broadcast_tensors(torch.addcmul((first + second) / 2, nodes, step), first, second, separation)
        # each coordinate in one piece, as `_over_far` takes them
        places = torch.stack(parts).flatten(2).permute(2, 0, 1)
        found = by_chunks(self._over_far, places, _CHUNK.on(step.device))
        return found.view(n * n, -1).T.unflatten(1, (n, n))

    def _over_far(self, places: Tensor) -> Tensor:
        """Return the coherence (Q,) over `far` at baselines of two lenses, by `places` (Q, 4, 2) [m].

        They are the baseline, those of the lenses, and the separation of their middles.
        """
        (bx, by), *lenses, separation = places.permute(1, 2, 0).contiguous()
        x, y = torch.stack(lenses, 1)
        between = self.structure.at(bx, by)
        if self.colours is None:
            axes = self._axes(bx - x, by - y)
            known, found = -between, self._changing([separation, *axes, (bx, by)])
        else:
            phases, spreads = self._phases(bx, by, x, y)
            at = torch.stack([bx, by], -1)[None] / phases.mean(0)[:, None]
            second, third = self.colours(at)[0].unbind(-1)
            one, other = phases = _shared_phases(phases, spreads, second, third)
            axes = self._axes(bx / phases - x, by / phases - y)
            mean, half = (1 / one + 1 / other) / 2, (1 / one - 1 / other) / 2
            mx, my, hx, hy = bx * mean, by * mean, bx * half, by * half
            own = self.structure.at(mx + hx, my + hy) * one**2 + self.structure.at(mx - hx, my - hy) * other**2
            known = colour_loss(second, third, one, other) - own / 2
            found = self._changing([separation, *axes, (mx, my), (hx, hy)]) * (one * other)
        # to base 2, whose exponential takes half as long
        return self.weights @ torch.add((known - _log_far(between)) * _LOG2E, found, alpha=_LOG2E).exp2_()

    def _axes(self, x: Tensor, y: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return x and y (Q,) of the two axes in which `_POINTS` count, for two lenses at the places (x, y) (2, Q)."""
        moments = zip(self._moments(x, y), self.drift, strict=True)
        xx, xy, yy = (torch.add(one, other).add_(drift) for (one, other), drift in moments)
        # the symmetric square root: a mask that is turned by 90 degrees has the same points
        root = torch.sqrt(torch.addcmul(xx * yy, xy, xy, value=-1).clamp(min=1e-6 * self.variance**2))
        trace = torch.sqrt(xx + yy + 2 * root)
        skew = xy / trace
        return [((xx + root) / trace, skew), (skew, (yy + root) / trace)]

    def _changing(self, axes: list[Any]) -> Tensor:
        """Return the part of the exponent (points, Q) that changes with the points' separation, over the product of the
        phases, by x and y (Q,) of all that `displacements` count in."""
        x, y = (torch.stack(parts) for parts in zip(*axes, strict=True))
        total = x.new_zeros(())
        for displacements, factor in zip(self.displacements, self.factors, strict=True):  # the cache holds one
            total = torch.add(total, self.structure.at(displacements @ x, displacements @ y), alpha=factor)
        return total

    def _phases(self, bx: Tensor, by: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and variance (2, Q) of the phases, over those at the reference wavelength, of the light of a band
        that lenses with the baselines (x, y) (2, Q) transmit."""
        scales = self.scales[:, None, None]
        x, y = bx / scales - x, by / scales - y
        brightness = self.shares.log()[:, None, None] - (x * x + y * y) / (2 * _LIGHT * self.reach**2)
        light = torch.softmax(brightness, 0)
        mean = (light * scales).sum(0)
        return mean, (light * scales**2).sum(0) - mean**2

    def _moments(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the moments xx, xy and yy (...) [m^2] of the lens at the place (x, y).

        Its width and height shrink as those of the lens of two discs, to a per cent of a hole's; r is the distance over
        the hole's diameter.
        """
        x, y = x / self.reach, y / self.reach
        square = torch.addcmul(x.new_full((), 1e-4), x, x).addcmul_(y, y)
        r = torch.sqrt(square)
        inside = (1 - r).clamp(min=0.03)  # no lens: it has no weight either
        height, width = torch.addcmul(inside, inside, r, value=0.6), inside * inside
        width = torch.addcmul(width, width, r, value=-0.1)
        narrow, base = (width - height) * (self.variance / square), height * self.variance
        along, across = narrow * x, narrow * y
        return torch.addcmul(base, along, x), along * y, torch.addcmul(base, across, y)


def _shared_phases(mean: Tensor, variance: Tensor, second: Tensor, third: Tensor) -> Tensor:
    """Return the mean phases (2, Q) of the light that two lenses share, by those of all their light.

    Like colours count most: exp(-k), with k = loss (a - a')^2, brings normal distributions of a and a' nearer.
    """
    one, other = mean
    loss = (second + third * (one - other).abs() * 2 / (one + other)).clamp(min=0)
    nearer = 2 * loss * (one - other) / (1 + 2 * loss * variance.sum(0))
    return torch.stack([one - variance[0] * nearer, other + variance[1] * nearer])


def _log_far(structure: Tensor) -> Tensor:
    """Return the logarithm (...) of `PairCoherence.far` where the structure function is D."""
    return -structure / (1 + structure / 3)
