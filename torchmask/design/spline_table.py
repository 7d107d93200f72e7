"""Functions of the plane that splines on a square lattice know, differentiable in the place."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from scipy.ndimage import spline_filter
from torch import Tensor

from torchmask.design.spline_patches import cubic_basis


class SplineTable:
    """R functions of a place (x, y) [m] up to `longest` away from the origin, along either axis, as cubic splines.

    Beyond that they are constant along the axis.
    """

    def __init__(
        self,
        functions: Callable[[Tensor], Tensor],
        longest: float,
        step: float,
        dtype: torch.dtype,
        device: torch.device,
    ) -> None:
        self.step: float = step
        self.half: int = math.ceil(longest / step) + 2
        axis = step * torch.arange(-self.half, self.half + 1, dtype=torch.float64)
        places = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1).flatten(0, 1)
        values = functions(places).unflatten(-1, (len(axis), len(axis)))
        coefficients = torch.stack([torch.from_numpy(spline_filter(one.numpy(), order=3)) for one in values])
        self.coefficients: Tensor = coefficients.flatten(1).T.contiguous().to(device, dtype)

    def __call__(self, places: Tensor) -> Tensor:
        """Return the functions (B, L, R) at `places` (B, L, 2)."""
        place = (places / self.step + self.half).clamp(1, 2 * self.half - 1)
        start = place.detach().nan_to_num(0.0).floor().clamp(1, 2 * self.half - 2)
        basis = cubic_basis(place - start)  # (B, L, 2, 4)
        index = start.long()[..., None] + torch.arange(-1, 3, device=places.device)
        flat = index[..., 1, :, None] * (2 * self.half + 1) + index[..., 0, None, :]
        weights = (basis[..., 1, :, None] * basis[..., 0, None, :]).flatten(-2)
        rows = self.coefficients.index_select(0, flat.flatten()).view(*weights.shape, self.coefficients.shape[1])
        return (weights[..., None, :] @ rows)[..., 0, :]
