"""Total variation: the object has few edges. With bends it keeps even shading, adapted to an object it keeps edges."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from torchmask.numbers import require
from torchmask.restoration.priors import ObjectPrior
from torchmask.restoration.slopes import divergence, gradient
from torchmask.restoration.structure import Metric, even_metric

_BENDS = 0.25  # weight of bends over that of slopes
_FEW_BENDS = 0.1  # the same if slopes are steep: 0 to 0.25 tried
_HEAVIEST = 3.0  # factor on a prior in the last descent: up to 10 tried
_LIGHTEST = 0.25  # factor on a prior in the search
_FACTORS = (6.3, 4.0, 2.5, 1.6, 1.0, 0.63, 0.4, 0.25, 0.16, 0.1, 0.063, 0.04, 0.025)  # on a prior, to choose from


class TotalVariation(ObjectPrior):
    """Total variation, which favours few edges: weight * sum over pixels of sqrt(dx^2 + dy^2 + epsilon^2) - epsilon.

    It is isotropic and smoothed, with forward differences that are periodic at the border (Rudin, Osher & Fatemi,
    Physica D 60, 259, 1992).

    Parameters
    ----------
    weight : float
        Weight mu of the penalty, for frames of mean 1.
    epsilon : float
        Slope, in mean pixels, below which differences count as noise rather than as edges.

    Raises
    ------
    ValueError
        If a number is not finite and positive.

    Examples
    --------
    >>> image = torch.zeros(4, 4, dtype=torch.float64); image[1:3, 1:3] = 1.0
    >>> round(float(TotalVariation(epsilon=1e-9)(image)), 6)  # six straight slopes and a diagonal one
    7.414214
    """

    def __init__(self, weight: float = 1.0, epsilon: float = 0.01) -> None:
        super().__init__()
        require("weight", weight)
        require("epsilon", epsilon)
        self.weight: float = float(weight)
        self.epsilon: float = float(epsilon)

    def forward(self, image: Tensor) -> Tensor:
        return self.weight * (self._slopes(image)[2] - self.epsilon * self._size).sum(dim=(-2, -1))

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        dy, dx, length = self._slopes(image)
        value = (length - self.epsilon * self._size).sum(dim=(-2, -1))
        return self.weight * value, self.weight * self._pull(dy / length, dx / length)

    def curvature(self, image: Tensor) -> Tensor:
        return self._curvature_of_slopes(image)

    def in_search(self, rate: float) -> TotalVariation:
        """Return a copy with the weight times the rate, but at least times 0.25.

        The penalty of a subclass has to be proportional to its attribute `weight`, a float.
        """
        lighter = copy.copy(self)
        lighter.weight = self.weight * max(rate, _LIGHTEST)
        return lighter

    def suited_to(self, rate: float) -> ObjectPrior:
        """Return a `SmoothVariation` of `weight` times the rate."""
        return SmoothVariation(self.weight * rate, epsilon=self.epsilon)

    def family(self, rate: float) -> tuple[ObjectPrior, ...]:
        """Return `SmoothVariation` of 1 to 0.025 times the weight, or for a rate above 1 of 6.3 times on.

        Bends weigh more for that. For others the heaviest are left out, as bright frames of a full pupil take long to
        tell that they are too heavy.
        """
        return tuple(self._smooth(factor, gentle=rate > 1) for factor in _FACTORS if factor <= 1 or rate > 1)

    def choices(self, rate: float) -> tuple[ObjectPrior, ...]:
        """Return `SmoothVariation` of one or several weights.

        A rate above 1, up to 3, is the only factor on the given weight. Else they go down from the given one, by up to
        a factor of 40 but not below the rate, with less weight on bends.
        """
        if rate > 1:
            return (self._smooth(min(rate, _HEAVIEST), gentle=True),)
        factors = (factor for factor in _FACTORS if factor == 1 or 1 > factor > rate > 0)
        return tuple(self._smooth(factor, gentle=False) for factor in factors)

    @property
    def _size(self) -> Tensor | float:
        """By how much slopes and bends count around each pixel."""
        return 1.0

    def _smooth(self, factor: float, *, gentle: bool) -> SmoothVariation:
        bending = _BENDS if gentle else _FEW_BENDS
        return SmoothVariation(self.weight * factor, bending=bending, epsilon=self.epsilon)

    def _slopes(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        dy, dx = gradient(image)
        return dy, dx, torch.sqrt(dy**2 + dx**2 + self.epsilon**2)

    def _curvature_of_slopes(self, image: Tensor) -> Tensor:
        inverse = self.weight / self._slopes(image)[2]
        return 2 * inverse + inverse.roll(1, -2) + inverse.roll(1, -1)

    def _pull(self, dy: Tensor, dx: Tensor) -> Tensor:
        return divergence(dy, dx)

    def extra_repr(self) -> str:
        return f"weight={self.weight:g}, epsilon={self.epsilon:g}"


class SmoothVariation(TotalVariation):
    """weight * sum of |gradient| + bending * |Hessian| over the pixels: an object has few edges, and few bends.

    The lengths are sqrt(dx^2 + dy^2 + epsilon^2) - epsilon and sqrt(dxx^2 + dyy^2 + 2 dxy^2 + epsilon^2) - epsilon, by
    differences that are periodic at the border (Papafitsoros & Schoenlieb, J. Math. Imaging Vis. 48, 308, 2014). Total
    variation alone makes steps of even shading; bends that cost something too keep it even.

    Parameters
    ----------
    weight : float
        In units of frames of mean 1.
    bending : float
        Weight of the bends over that of the slopes.
    epsilon : float
        Slopes and bends below it, in mean pixels, count as noise.

    Raises
    ------
    ValueError
        If a number is not finite and positive.

    Examples
    --------
    >>> ramp = torch.arange(4.0).double().expand(4, 4)  # each row rises by 1 three times and falls by 3: it bends twice
    >>> round(float(SmoothVariation(weight=1.0, bending=0.1, epsilon=1e-9)(ramp)), 6)  # 4 rows (1 + 1 + 1 + 3 + 0.8)
    27.2
    """

    def __init__(self, weight: float = 1.0, bending: float = _BENDS, epsilon: float = 0.01) -> None:
        super().__init__(weight, epsilon)
        require("bending", bending)
        self.bending: float = float(bending)

    def forward(self, image: Tensor) -> Tensor:
        bends = (self._size * (self._bends(image)[3] - self.epsilon)).sum(dim=(-2, -1))
        return super().forward(image) + self.weight * self.bending * bends

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        value, slope = super().value_and_gradient(image)
        yy, xx, xy, length = self._bends(image)
        weight = self.weight * self.bending * self._size
        inverse = weight / length
        yy, xx, xy = yy * inverse, xx * inverse, 2 * xy * inverse
        by_dy, by_dx = yy - yy.roll(-1, -2) + xy.roll(1, -1) - xy, xx - xx.roll(-1, -1)
        return value + (weight * (length - self.epsilon)).sum(dim=(-2, -1)), slope + divergence(by_dy, by_dx)

    def curvature(self, image: Tensor) -> Tensor:
        inverse = self.weight * self.bending * self._size / self._bends(image)[3]
        left, above = inverse.roll(1, -1), inverse.roll(1, -2)
        straight = 8 * inverse + left + above + inverse.roll(-1, -1) + inverse.roll(-1, -2)
        return self._curvature_of_slopes(image) + straight + 2 * (inverse + left + above + left.roll(1, -2))

    def adapted_to(self, image: Tensor, reach: float) -> ObjectPrior:
        """Return an `AdaptedVariation`, or itself if the image has no slopes."""
        metric = even_metric(image, reach)
        return self if metric is None else AdaptedVariation(self, metric)

    def family(self, rate: float) -> tuple[ObjectPrior, ...]:
        return (self,)

    def choices(self, rate: float) -> tuple[ObjectPrior, ...]:
        return (self,)

    def _bends(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        dy, dx = gradient(image)
        yy, xx, xy = dy - dy.roll(1, -2), dx - dx.roll(1, -1), dy.roll(-1, -1) - dy
        return yy, xx, xy, torch.sqrt(yy**2 + xx**2 + 2 * xy**2 + self.epsilon**2)

    def extra_repr(self) -> str:
        return f"weight={self.weight:g}, bending={self.bending:g}, epsilon={self.epsilon:g}"


class AdaptedVariation(SmoothVariation):
    """A `SmoothVariation` in which slopes count the less the steeper an object is around them, in their direction.

    Total variation takes from an edge what it takes from noise. Once an object shows where its edges are, and how they
    run, slopes across them may cost less and all others more: weight * sum of |M gradient| + bending * size * |Hessian|
    over the pixels, with M and `size` by `structure.even_metric` of that object. Its slopes together cost what they do
    under the `SmoothVariation`, but for epsilon; its bends need not. Reweighted l1 norms do the same for sparse vectors
    (Candes, Wakin & Boyd, J. Fourier Anal. Appl. 14, 877, 2008), and the direction is that of anisotropic total
    variation (Grasmair & Lenzen, Appl. Math. Optim. 62, 323, 2010).

    Parameters
    ----------
    prior : SmoothVariation
        Weights of slopes and bends.
    metric : Metric
        By how much they count around each pixel. Its tensors are the buffers `yy`, `xy`, `xx` and `size`.
    """

    yy: Tensor
    xy: Tensor
    xx: Tensor
    size: Tensor

    def __init__(self, prior: SmoothVariation, metric: Metric) -> None:
        super().__init__(prior.weight, prior.bending, prior.epsilon)
        for name, values in metric._asdict().items():
            self.register_buffer(name, values)

    @property
    def metric(self) -> Metric:
        """By how much slopes and bends count around each pixel."""
        return Metric(self.yy, self.xy, self.xx, self.size)

    @property
    def _size(self) -> Tensor:
        return self.size

    def _slopes(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        dy, dx = self.metric.of(*gradient(image))
        return dy, dx, torch.sqrt(dy**2 + dx**2 + (self.epsilon * self._size) ** 2)

    def _curvature_of_slopes(self, image: Tensor) -> Tensor:
        inverse, (yy, xy, xx, _) = self.weight / self._slopes(image)[2], self.metric
        by_dy, by_dx, both = yy**2 + xy**2, xy**2 + xx**2, 2 * xy * (yy + xx)
        return inverse * (by_dy + by_dx + both) + (inverse * by_dy).roll(1, -2) + (inverse * by_dx).roll(1, -1)

    def _pull(self, dy: Tensor, dx: Tensor) -> Tensor:
        return super()._pull(*self.metric.of(dy, dx))
