"""Priors on the object that users bring: any function or module of an image, and the checks that it is one."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torch.nn.parameter import is_lazy

from torchmask.restoration.parts import everything_in
from torchmask.restoration.priors import ObjectPrior

_CHANCE = 1e-3  # of a gradient: sums of float32 on a GPU differ less from one evaluation to the next
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

    A gradient of its own has to be that of the value, but for rounding and for pixels where the value has a kink. A
    prior that changes its networks or is random is refused; the networks are left as they were.
    """
    with _left_as_they_are(prior):
        exact = _gradient_by_autograd(prior, image)
        again = _gradient_by_autograd(prior, image)
    if (apart := _apart(again, exact)) > _CHANCE:
        raise ValueError(
            f"the prior {prior!r} is random: its gradient at the mean frame changes by {apart:.3g} of it from one "
            "evaluation to the next, as under dropout in training. Call eval() on its network"
        )
    slope = prior.value_and_gradient(image)[1]
    if slope.shape != image.shape or not bool(torch.isfinite(slope).all()):
        raise ValueError(
            f"the gradient of the prior {prior!r} at the mean frame has shape {tuple(slope.shape)} or is not finite: "
            f"it must be finite, of shape {tuple(image.shape)}"
        )
    if (apart := _apart(slope, exact)) > _SLACK:
        raise ValueError(
            f"the gradient of the prior {prior!r} at the mean frame is another than that of its value by autograd, by "
            f"{apart:.3g} of it: mend the method, or leave it out"
        )
    _check_curvature(prior, image)


def _gradient_by_autograd(prior: ObjectPrior, image: Tensor) -> Tensor:
    """Return the gradient (H', W') of the value. Raises ValueError unless it is a finite, differentiable scalar."""
    try:
        with torch.enable_grad():
            value = prior(leaf := image.detach().requires_grad_())
    except (RuntimeError, IndexError) as error:
        raise ValueError(f"the prior {prior!r} fails on an image {tuple(image.shape)}: {error}") from error
    if not isinstance(value, Tensor) or value.ndim:
        raise ValueError(f"the prior {prior!r} returns {_kind(value)} for an image: it must return a scalar tensor")
    if not math.isfinite(float(value.detach())):
        raise ValueError(f"the prior {prior!r} is {float(value.detach())} at the mean frame: it must be finite there")
    if not value.requires_grad:
        raise ValueError(f"the prior {prior!r} is not differentiable in the image: use operations of PyTorch only")
    return torch.autograd.grad(value, leaf)[0]


def _check_curvature(prior: ObjectPrior, image: Tensor) -> None:
    curved = prior.curvature(image)
    fits = isinstance(curved, Tensor) and curved.shape == image.shape
    if not fits or not bool((torch.isfinite(curved) & (curved >= 0)).all()):
        raise ValueError(
            f"the curvature of the prior {prior!r} at the mean frame is {_kind(curved)}, or holds values that are "
            f"negative or not finite: a tensor of shape {tuple(image.shape)} is needed, finite and at least 0"
        )


@contextmanager
def _left_as_they_are(prior: ObjectPrior) -> Iterator[None]:
    """Undo what the block changes in the networks of a prior, and raise ValueError if that is anything."""
    networks = [value for value in everything_in(prior) if isinstance(value, nn.Module)]
    buffers = [(network, name) for network in networks for name, held in network.named_buffers() if not is_lazy(held)]
    before = [network.get_buffer(name).clone() for network, name in buffers]
    changed = []
    try:
        yield
    finally:
        for (network, name), kept in zip(buffers, before, strict=True):
            if not torch.equal(now := network.get_buffer(name), kept):
                now.copy_(kept)
                changed.append(name.removeprefix("function."))
    if changed:
        raise ValueError(
            f"the prior {prior!r} changes {changed[0]}, one of {len(changed)} such buffers, whenever it is evaluated, "
            "as batch normalisation does in training. Call eval() on its network"
        )


def _apart(one: Tensor, other: Tensor) -> float:
    """Return by how much one gradient differs from the other, relative to that."""
    difference, norm = float((one - other).norm()), float(other.norm())
    if not norm:
        return math.inf if difference else 0.0
    return difference / norm


def _kind(value: object) -> str:
    return f"a tensor of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
