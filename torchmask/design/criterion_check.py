"""Refusal of criteria that a search cannot use, before any work."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from torchmask.design.merit import Criterion
    from torchmask.optics.aperture import SparseAperture


@torch.enable_grad()
def require_criterion(criterion: Criterion, aperture: SparseAperture, differentiable: bool = True) -> Tensor:
    """Return the relative error of one mask, or raise an error unless a search can use the criterion.

    Raises
    ------
    TypeError
        If it cannot be called or has no `relative`, does not return tensors, or its relative error should be
        `differentiable` in the centres and is not.
    ValueError
        If it does not return one value for each mask of a population.
    """
    if not callable(criterion) or not callable(getattr(criterion, "relative", None)):
        raise TypeError(
            f"criterion is {type(criterion).__name__}: an object such as AsymptoticMSE is needed, that can be called "
            "and has a method `relative`, both of which take masks and return their errors"
        )
    # a mask and what it is turned by half a turn: as feasible, and told apart if one value stands for both
    centers = torch.stack([aperture.centers.detach(), -aperture.centers.detach()]).requires_grad_()
    masks = aperture.replace(centers=centers)
    _require_values("criterion", criterion(aperture), ())
    relative = _require_values("criterion.relative", criterion.relative(masks), (2,))
    if differentiable and not relative.requires_grad:
        raise TypeError(
            "criterion.relative is not differentiable in the centres of the holes: use operations of PyTorch only, and "
            "do not detach, or search with method='cma' and refine=False"
        )
    return relative[0].detach()


def _require_values(name: str, values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """Return the values of one mask, or of a population of 2, or raise an error unless they are a tensor of `shape`."""
    if not isinstance(values, Tensor):
        raise TypeError(f"{name} returns {type(values).__name__}: a tensor is needed, one value for each mask")
    if values.shape != shape:
        masks = f"a population of {shape[0]} masks" if shape else "one mask"
        raise ValueError(
            f"{name} returns shape {tuple(values.shape)} for {masks}: it must return one value for each, {shape}"
        )
    return values


def require_finite(relative_mse: Tensor) -> None:
    """Raise ValueError unless the relative error of a mask from which a descent begins has a finite logarithm."""
    value = float(relative_mse)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(
            f"the criterion's relative error of the given mask is {value}: it must be finite and positive, as its "
            "logarithm is minimised"
        )
