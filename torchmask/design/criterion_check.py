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
    masks, found = aperture.replace(centers=centers), []
    for name, function in (("criterion", criterion), ("criterion.relative", criterion.relative)):
        values = function(masks)
        if not isinstance(values, Tensor):
            raise TypeError(f"{name} returns {type(values).__name__}: a tensor is needed, one value for each mask")
        if values.shape != (2,):
            raise ValueError(
                f"{name} returns shape {tuple(values.shape)} for a population of 2 masks, centers "
                f"{tuple(centers.shape)}: it must return one value for each, (2,)"
            )
        found.append(values)
    if differentiable and not found[1].requires_grad:
        raise TypeError(
            "criterion.relative is not differentiable in the centres of the holes: use operations of PyTorch only, and "
            "do not detach, or search with method='cma' and refine=False"
        )
    return found[1][0].detach()


def require_finite(relative_mse: Tensor) -> None:
    """Raise ValueError unless the relative error of a mask from which a descent begins has a finite logarithm."""
    value = float(relative_mse)
    if not (math.isfinite(value) and value > 0):
        raise ValueError(
            f"the criterion's relative error of the given mask is {value}: it must be finite and positive, as its "
            "logarithm is minimised"
        )
