"""Detection of overlapping holes in a mask.

Masks with overlapping holes are allowed, because some real ones have them. Code that simulates or draws a mask checks
for them here: the models count the light in an overlap twice, and a plate has one hole where the drawing shows two.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchmask.optics.aperture import Aperture, SparseAperture

_SHOWN = 3  # largest number of pairs in a message


class Overlap(NamedTuple):
    """Two overlapping holes, numbered from 0, and the depth of their overlap [m]."""

    first: int
    second: int
    depth: float


def pair_clearances(aperture: SparseAperture) -> Tensor:
    """Return the gap between the holes of each pair (..., N(N-1)/2) [m], negative where they overlap.

    Pairs are in the order of `torch.triu_indices(N, N, 1)`. For polygons the gap is measured along the normal of a
    side: it is exact for sides that face each other, always has the right sign, and never exceeds the true distance.
    """
    n = aperture.n_subapertures
    first, second = torch.triu_indices(n, n, 1, device=aperture.centers.device)
    difference = aperture.centers[..., first, :] - aperture.centers[..., second, :]
    return aperture.shape.separation(difference) - aperture.subaperture_diameter


def find_overlaps(aperture: SparseAperture, tolerance: float = 1e-6) -> list[Overlap]:
    """Return the pairs of holes that overlap by more than `tolerance` times the mask diameter, the deepest first.

    The default tolerance allows for the rounding of touching holes in files and in float32. For a population, the pairs
    of all its masks are returned together.
    """
    n = aperture.n_subapertures
    first, second = torch.triu_indices(n, n, 1, device="cpu").tolist()
    depths = -pair_clearances(aperture).detach().cpu()
    depths = depths.reshape(math.prod(depths.shape[:-1]), len(first))
    found = [
        Overlap(first[pair], second[pair], float(depths[mask, pair]))
        for mask, pair in torch.nonzero(depths > tolerance * aperture.mask_diameter).tolist()
    ]
    return sorted(found, key=lambda overlap: -overlap.depth)


def check_overlaps(aperture: SparseAperture, tolerance: float = 1e-6) -> None:
    """Raise ValueError if holes overlap (see `find_overlaps`); the message says which ones, and by how much.

    Examples
    --------
    >>> check_overlaps(SparseAperture([[-0.4, 0.0], [-0.3, 0.0], [0.4, 0.0]], 0.2, 1.0))
    Traceback (most recent call last):
        ...
    ValueError: 1 pair of holes overlaps: 0 and 1 by 0.1 m (holes of 0.2 m, counted from 0)
    """
    pairs = find_overlaps(aperture, tolerance)
    if pairs:
        raise ValueError(describe_overlaps(aperture, pairs))


def require_apart(aperture: Aperture, allow_overlap: bool = False) -> None:
    """Raise ValueError as `check_overlaps` if an aperture is a mask whose holes overlap, unless that is allowed.

    Drawings for a workshop and simulations ask for it.
    """
    if isinstance(aperture, SparseAperture) and not allow_overlap:
        try:
            check_overlaps(aperture)
        except ValueError as error:
            raise ValueError(f"{error}; give allow_overlap to accept it") from error


def describe_overlaps(aperture: SparseAperture, pairs: list[Overlap]) -> str:
    """Describe the overlaps in one line, the deepest first."""
    count = "1 pair of holes overlaps" if len(pairs) == 1 else f"{len(pairs)} pairs of holes overlap"
    shown = ", ".join(f"{first} and {second} by {depth:.3g} m" for first, second, depth in pairs[:_SHOWN])
    more = f", and {len(pairs) - _SHOWN} more pairs" if len(pairs) > _SHOWN else ""
    return f"{count}: {shown}{more} (holes of {aperture.subaperture_diameter:.4g} m, counted from 0)"
