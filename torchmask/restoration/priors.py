"""Priors on the object: penalties on images, with the gradients and curvatures that a minimiser needs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchmask.numbers import require
from torchmask.restoration.slopes import divergence, gradient

_PROBES = 8  # random vectors that estimate the diagonal of a Hessian
_SEED = 0
_STEP = 0.01  # of differences of gradients, in mean pixels: as far as total variation rounds its kinks by default


class ObjectPrior(nn.Module):
    """A penalty on the object: `forward(image)` maps an image (H', W') to a scalar that is lower for likelier objects.

    Images are in units of the stack's mean pixel and cover the object's field, which is slightly wider than the frames.
    A subclass needs only `forward`, written with operations of PyTorch; gradient and curvature follow by
    differentiation. To save time, it may override them with closed forms.
    """

    def forward(self, image: Tensor) -> Tensor:
        raise TypeError(f"{type(self).__name__} has no method forward(image): define one that returns a scalar")

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Return the penalty of `image` (H', W') and its gradient (H', W')."""
        with torch.enable_grad():
            leaf = image.detach().requires_grad_()
            value = self(leaf)
            (slope,) = torch.autograd.grad(value, leaf)
        return value.detach(), slope

    def curvature(self, image: Tensor) -> Tensor:
        """Return the approximate diagonal (H', W') of the Hessian at `image`, or of a majorising quadratic, at least 0.

        It is estimated from Hessian-vector products with random signs (Bekas, Kokiopoulou & Saad, Appl. Numer.
        Math. 57, 1214, 2007). These are differences of gradients where autograd has no second derivatives: in compiled
        code, and at kinks such as those of a norm at zero.
        """
        try:
            found = self._diagonal(image, self._products(image))
        except RuntimeError:  # compiled code is not differentiated twice
            found = None
        if found is None or not bool(torch.isfinite(found).all()):
            found = self._diagonal(image, self._differences(image))
        return found.clamp(min=0)

    def _products(self, image: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the function of a vector (H', W') that multiplies it by the Hessian at `image`."""
        with torch.enable_grad():
            leaf = image.detach().requires_grad_()
            (slope,) = torch.autograd.grad(self(leaf), leaf, create_graph=True)
        if not slope.requires_grad:  # a linear penalty has no curvature
            return torch.zeros_like
        return lambda along: torch.autograd.grad(slope, leaf, along, retain_graph=True, materialize_grads=True)[0]

    def _differences(self, image: Tensor) -> Callable[[Tensor], Tensor]:
        """Return `_products` by differences of gradients; pixels stay above zero, below which a penalty may end."""
        middle = image.detach().clamp(min=2 * _STEP)

        def product(along: Tensor) -> Tensor:
            after, before = (self.value_and_gradient(middle + sign * _STEP * along)[1] for sign in (1, -1))
            return (after - before) / (2 * _STEP)

        return product

    @staticmethod
    def _diagonal(image: Tensor, product: Callable[[Tensor], Tensor]) -> Tensor:
        """Estimate the diagonal (H', W') of the matrix that `product` multiplies by."""
        generator = torch.Generator().manual_seed(_SEED)
        diagonal = torch.zeros_like(image)
        for _ in range(_PROBES):
            signs = torch.randint(2, image.shape, generator=generator, device="cpu").to(image) * 2 - 1
            diagonal += signs * product(signs) / _PROBES
        return diagonal

    def in_search(self, rate: float) -> ObjectPrior:
        """Return the prior of a search in faint light for an object whose slopes have a rate between 0 and 2.

        See `rate_of_slopes`. It is `self` where it knows no scale.
        """
        return self

    def suited_to(self, rate: float) -> ObjectPrior:
        """Return the prior at the scale of an object whose slopes have this rate: the same one where it knows none.

        See `rate_of_slopes`; the rate is positive.
        """
        return self

    def family(self, rate: float) -> tuple[ObjectPrior, ...]:
        """Return the priors to choose from for known aberrations, heaviest first; the rate is as for `choices`."""
        return (self,)

    def choices(self, rate: float) -> tuple[ObjectPrior, ...]:
        """Return the priors to choose from for the last descent, heaviest first, if aberrations are unknown.

        The rate is that of `spectrum.rate_at_end`, 0 where no scale is to be found: then the first is taken. They are
        fewer than the `family`: once aberrations are bent to an object that follows noise, frames predict each other
        best under too light a prior.
        """
        return (self,)

    def adapted_to(self, image: Tensor, reach: float) -> ObjectPrior:
        """Return the prior that suits the structure of an object (H', W') near the true one, as far as it is known.

        `reach` is the width of what the object shows [pixels]. It is `self` where the prior has no regard for that.
        """
        return self


class EdgePreserving(ObjectPrior):
    """Penalty that is quadratic in small slopes and linear in edges, so smooth shading remains smooth.

    It is weight * threshold^2 * sum over pixels of |g| / threshold - log(1 + |g| / threshold), with g the slope as in
    `TotalVariation` (Mugnier, Fusco & Conan, J. Opt. Soc. Am. A 21, 1841, 2004). Slopes well below the threshold are
    penalised by their square, as noise, and edges well above it by their height. Total variation, in contrast, turns
    smooth shading into steps.

    Parameters
    ----------
    weight : float
        Weight of the penalty, for frames of mean 1, which multiplies half the square of small slopes.
    threshold : float
        Slope between small slopes and edges [mean pixels per pixel].

    Raises
    ------
    ValueError
        If a number is not finite and positive.

    Examples
    --------
    >>> image = torch.zeros(4, 4, dtype=torch.float64); image[1, 1] = 1e-3
    >>> round(float(EdgePreserving(weight=1.0)(image)) / (0.5 * 4e-6), 2)  # half the sum of squares of small slopes
    1.0
    """

    def __init__(self, weight: float = 2.0, threshold: float = 0.5) -> None:
        super().__init__()
        require("weight", weight)
        require("threshold", threshold)
        self.weight: float = float(weight)
        self.threshold: float = float(threshold)

    def forward(self, image: Tensor) -> Tensor:
        return self.value_and_gradient(image)[0]

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        dy, dx, ratio = self._slopes(image)
        value = self.weight * self.threshold**2 * (ratio - torch.log1p(ratio)).sum(dim=(-2, -1))
        return value, self.weight * divergence(dy / (1 + ratio), dx / (1 + ratio))

    def curvature(self, image: Tensor) -> Tensor:
        inverse = 1 / (1 + self._slopes(image)[2])
        return self.weight * (2 * inverse + inverse.roll(1, -2) + inverse.roll(1, -1))

    def _slopes(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        dy, dx = gradient(image)
        squared = dy**2 + dx**2
        flat = squared == 0  # where the square root has no derivative, and none is needed
        return dy, dx, torch.where(flat, 0.0, torch.where(flat, 1.0, squared).sqrt()) / self.threshold

    def extra_repr(self) -> str:
        return f"weight={self.weight:g}, threshold={self.threshold:g}"
