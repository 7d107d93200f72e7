"""Coherence under turbulence of two lenses, overlaps of different pairs of holes, at the baselines that they share.

For lenses with middles s apart it is, at the baseline b, the mean over t of

    exp(-E[(a (phi_1 - phi_2) - a' (phi_3 - phi_4))^2] / 2)

(`torchmask.atmosphere.transfer.difference_variance`) for pairs of points s + t apart, one in each lens, and light whose
phases are a and a' times those at the reference wavelength: exp(-Q(b, s + t) / 2) for one wavelength. The separation t
is known by its second moments, to which the exposure adds those of the drift: nine points stand for it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchmask.atmosphere.colour_coherence import ColourCoherence, colour_loss
from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.design.overlap import Geometry
from torchmask.design.spline_table import SplineTable

_KURTOSIS = 2.5  # along one axis, of the separation of two points of two discs
_POINTS = [
    (i * math.sqrt(_KURTOSIS), (1 - abs(i)) * (1 - 1 / _KURTOSIS) + abs(i) / (2 * _KURTOSIS)) for i in (-1, 0, 1)
]
_LIGHT = 0.13  # mean square of a place in a lens's T, a Gaussian here, along either axis, over the hole's diameter^2
_STEPS = 4  # of the spline to a hole


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
        d = self.structure.of_square(x * x + y * y)
        return torch.exp(-d / (1 + d / 3))

    def of_points(self, bx: Tensor, by: Tensor, sx: Tensor, sy: Tensor, own: Tensor | None = None) -> Tensor:
        """Return exp(-Q(b, s) / 2) (...) for pairs of points s apart at the reference wavelength.

        own : the structure function of b, if it is known already
        """
        structure = self.structure.of_square
        own = structure(bx * bx + by * by) if own is None else own
        crossed = structure((sx + bx) ** 2 + (sy + by) ** 2) + structure((sx - bx) ** 2 + (sy - by) ** 2)
        return torch.exp(crossed / 2 - own - structure(sx * sx + sy * sy))

    def around(self, first: Tensor, second: Tensor, separation: Tensor, step: Tensor, n: int) -> Tensor:
        """Return the coherence over `far`, (E, rows, columns), at n x n baselines around that midway.

        Lenses have the baselines `first` and `second` (E, 2) and middles a `separation` (E, 2) apart; the baselines
        are `step` (E, 2) apart, all in m.
        """
        nodes = torch.arange(n, dtype=first.dtype, device=first.device) - (n - 1) / 2
        middle = (first + second) / 2
        zero = torch.zeros(n, n, dtype=first.dtype, device=first.device)
        bx = middle[:, :1, None] + step[:, :1, None] * nodes + zero
        by = middle[:, 1:, None] + step[:, 1:, None] * nodes[:, None] + zero
        sx, sy = separation[:, :1, None], separation[:, 1:, None]
        if self.colours is None:
            points = self._points(bx, by, bx, by, first, second, sx, sy)
            return self._of_one_colour(bx, by, points) / self.far(bx, by)
        one, other = self._phases(bx, by, first), self._phases(bx, by, second)
        points = self._points(bx / one, by / one, bx / other, by / other, first, second, sx, sy)
        return self._of_two_colours(bx, by, one, other, points) / self.far(bx, by)

    def _points(
        self,
        x: Tensor,
        y: Tensor,
        other_x: Tensor,
        other_y: Tensor,
        first: Tensor,
        second: Tensor,
        sx: Tensor,
        sy: Tensor,
    ) -> list[tuple[float, Tensor, Tensor]]:
        """Return weights and x, y of separations that stand for those of two lenses at their baselines."""
        xx, xy, yy = (
            one + other + drift
            for one, other, drift in zip(
                self._moments(x - first[:, :1, None], y - first[:, 1:, None]),
                self._moments(other_x - second[:, :1, None], other_y - second[:, 1:, None]),
                self.drift,
                strict=True,
            )
        )
        # the symmetric square root: a mask that is turned by 90 degrees has the same points
        root = torch.sqrt((xx * yy - xy**2).clamp(min=1e-6 * self.variance**2))
        trace = torch.sqrt(xx + yy + 2 * root)
        along, skew, across = (xx + root) / trace, xy / trace, (yy + root) / trace
        return [
            (share * other, sx + i * along + j * skew, sy + i * skew + j * across)
            for i, share in _POINTS
            for j, other in _POINTS
        ]

    def _of_one_colour(self, bx: Tensor, by: Tensor, points: list[tuple[float, Tensor, Tensor]]) -> Tensor:
        own, total = self.structure.of_square(bx * bx + by * by), torch.zeros_like(bx)
        for weight, sx, sy in points:
            total = total + weight * self.of_points(bx, by, sx, sy, own)
        return total

    def _of_two_colours(
        self, bx: Tensor, by: Tensor, one: Tensor, other: Tensor, points: list[tuple[float, Tensor, Tensor]]
    ) -> Tensor:
        """Return the coherence of light whose phases are `one` and `other` times those at the reference wavelength,
        over what the same two colours have in common in the same lens, which the modes of the lenses know."""
        assert self.colours is not None
        structure = self.structure.of_square
        mean, half = (1 / one + 1 / other) / 2, (1 / one - 1 / other) / 2
        mx, my, hx, hy = bx * mean, by * mean, bx * half, by * half
        own = (
            structure((mx + hx) ** 2 + (my + hy) ** 2) * one**2 + structure((mx - hx) ** 2 + (my - hy) ** 2) * other**2
        )
        middle = torch.stack([bx, by], -1) / ((one + other) / 2)[..., None]
        second, fourth = self.colours(middle.flatten(1, 2)).unflatten(1, bx.shape[1:]).unbind(-1)
        known = colour_loss(second, fourth, one, other) - own / 2
        total = torch.zeros_like(bx)
        for weight, sx, sy in points:
            crossed = structure((sx + mx) ** 2 + (sy + my) ** 2) + structure((sx - mx) ** 2 + (sy - my) ** 2)
            parallel = structure((sx + hx) ** 2 + (sy + hy) ** 2) + structure((sx - hx) ** 2 + (sy - hy) ** 2)
            total = total + weight * torch.exp(known + one * other / 2 * (crossed - parallel))
        return total

    def _phases(self, bx: Tensor, by: Tensor, lens: Tensor) -> Tensor:
        """Return the phases (E, rows, columns), over those at the reference wavelength, of the light of a band that
        lenses (E, 2) transmit, on average."""
        inverse = 1 / self.scales[:, None, None]
        x, y = (at[:, None] * inverse - lens[:, axis, None, None, None] for axis, at in enumerate((bx, by)))
        brightness = self.shares.log()[:, None, None] - (x * x + y * y) / (2 * _LIGHT * self.reach**2)
        return (torch.softmax(brightness, 1) * self.scales[:, None, None]).sum(1)

    def _moments(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the moments xx, xy and yy (...) [m^2] of the lens at the place (x, y).

        Its width and height shrink as those of the lens of two discs, to a per cent of a hole's; r is the distance over
        the hole's diameter.
        """
        x, y = x / self.reach, y / self.reach
        r = torch.sqrt(x * x + y * y + 1e-4)
        inside = (1 - r).clamp(min=0.03)  # no lens: it has no weight either
        height, width = inside * (1 + 0.6 * r), inside * inside * (1 - 0.1 * r)
        narrow, base = (width - height) / (r * r) * self.variance, height * self.variance
        return base + narrow * x * x, narrow * x * y, base + narrow * y * y
