"""Priors on the object that users bring: any function or module of an image, and the checks that it is one."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from torchmask.restoration.priors import ObjectPrior

_SLACK = 0.1  # of a gradient: where a value has a kink, as |x| at 0, any slope between those beside it will do


class FunctionPrior(ObjectPrior):
    """A penalty given by any function or module of an image.

    `function.gradient(image)` and `function.curvature(image)`, both (H', W') -> (H', W'), are used if they exist.
    """

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        super().__init__()
        self.function = function

    def forward(self, image: Tensor) -> Tensor:
        return self.function(image)

    def value_and_gradient(self, image: Tensor) -> tuple[Tensor, Tensor]:
        known = getattr(self.function, "gradient", None)
        if known is None:
            return super().value_and_gradient(image)
        with torch.no_grad():
            return self(image), known(image)

    def curvature(self, image: Tensor) -> Tensor:
        known = getattr(self.function, "curvature", None)
        return super().curvature(image) if known is None else known(image)

    def __repr__(self) -> str:
        if isinstance(self.function, nn.Module):
            return repr(self.function)
        named = getattr(self.function, "__qualname__", None)  # the repr of a function contains its address
        return f"{self.function.__module__}.{named}" if named else repr(self.function)


def as_prior(prior: Callable[[Tensor], Tensor]) -> ObjectPrior:
    """Return an `ObjectPrior` for any function from an image to a scalar.

    Raises TypeError if it is not callable, or a class where an object of it is needed.
    """
    if isinstance(prior, type):
        raise TypeError(f"prior is the class {prior.__name__}: give an object of it, such as {prior.__name__}()")
    if not callable(prior):
        raise TypeError(f"prior is {prior!r}: it must be a function or module that maps an image to a scalar")
    return prior if isinstance(prior, ObjectPrior) else FunctionPrior(prior)


def check_prior(prior: ObjectPrior, image: Tensor) -> None:
    """Raise ValueError unless `prior` is a finite, differentiable scalar with a curvature at `image` (H', W').

    A gradient of its own has to be that of the value, but for rounding and for pixels where the value has a kink.
    """
    try:
        with torch.enable_grad():
            value = prior(leaf := image.detach().requires_grad_())
    except (RuntimeError, IndexError) as error:
        raise ValueError(f"the prior {prior!r} fails on an image {tuple(image.shape)}: {error}") from error
    if not isinstance(value, Tensor) or value.ndim:
        what = f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
        raise ValueError(f"the prior {prior!r} returns {what} for an image: it must return a scalar tensor")
    if not math.isfinite(float(value.detach())):
        raise ValueError(f"the prior {prior!r} is {float(value.detach())} at the mean frame: it must be finite there")
    if not value.requires_grad:
        raise ValueError(f"the prior {prior!r} is not differentiable in the image: use operations of PyTorch only")
    (exact,) = torch.autograd.grad(value, leaf)
    slope = prior.value_and_gradient(image)[1]
    if slope.shape != image.shape or not bool(torch.isfinite(slope).all()):
        raise ValueError(
            f"the gradient of the prior {prior!r} at the mean frame has shape {tuple(slope.shape)} or is not finite: "
            f"it must be finite, of shape {tuple(image.shape)}"
        )
    if float((slope - exact).norm()) > _SLACK * float(exact.norm()):
        raise ValueError(
            f"the gradient of the prior {prior!r} at the mean frame is another than that of its value by autograd, by "
            f"{float((slope - exact).norm() / exact.norm()):.3g} of it: mend the method, or leave it out"
        )
    curved = prior.curvature(image)
    fits = isinstance(curved, Tensor) and curved.shape == image.shape
    if not fits or not bool((torch.isfinite(curved) & (curved >= 0)).all()):
        what = (
            f"a tensor of shape {tuple(curved.shape)}" if isinstance(curved, Tensor) else f"a {type(curved).__name__}"
        )
        raise ValueError(
            f"the curvature of the prior {prior!r} at the mean frame is {what}, or holds values that are negative or "
            f"not finite: a tensor of shape {tuple(image.shape)} is needed, finite and at least 0"
        )
