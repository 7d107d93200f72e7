"""How |OTF|^2 fluctuates between exposures, and what a finite number of them costs: Jensen's term.

At one frequency the OTF of a mask is a sum over lenses, the overlaps of pairs of holes. Each is taken as a steady
amplitude A, whose phase is that of the pair's piston, plus what turbulence within the lens adds, a complex Gaussian
number like a speckle. Then the variance of |OTF|^2 over exposures is

    V = P^2 - sum over lenses of A^4,   P = E|OTF|^2,

which is exact for holes without turbulence inside them, unless pairs with a hole in common overlap: a frequency that
one pair alone transmits does not fluctuate at all, and one that many transmit does so like a speckle.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchmask.design.apart import make_apart
from torchmask.design.lens_patches import Lenses, LensPatches
from torchmask.design.overlap import Geometry
from torchmask.optics.band import Band

_LEVELS = 30  # of the continued fraction


def mean_inverse(mean: Tensor, variance: Tensor, ratio: Tensor) -> Tensor:
    """Return E[1 / (x + ratio)] (...) for a number x >= 0 of known mean and variance, by a Gamma distribution.

    To second order it is Jensen's 1 / s + variance / s^3 with s = mean + ratio. With theta = variance / mean it is
    exp(z) E_k(z) / theta, z = ratio / theta, k = mean / theta, here by the even part of the continued fraction DLMF
    8.19.17: to 2e-5 for the mean of 5 speckles or more, of variance mean^2 / 5, and too small for fewer unless the
    ratio is large: for one, by 3e-3 where it is a tenth of the mean.

    Examples
    --------
    >>> one, none = torch.tensor(1.0), torch.tensor(0.0)
    >>> float(mean_inverse(one, none, one)), round(float(mean_inverse(one, one / 20, none + 1e-6)), 3)  # 20 / 19
    (0.5, 1.053)
    """
    theta = variance / mean.clamp(min=torch.finfo(mean.dtype).tiny)
    rest = mean + ratio + 2 * _LEVELS * theta
    for level in range(_LEVELS, 0, -1):
        rest = mean + ratio + 2 * (level - 1) * theta - level * theta * (mean + (level - 1) * theta) / rest
    return 1 / rest


def steady_lenses(lenses: Lenses, n: int) -> Tensor:
    """Return the square of what is kept of |OTF|^2 of each lens (B, L, rows, columns), N^4 times.

    All `n` holes with themselves are one lens. The modes of a band are independent. Every lens counts at nu and at -nu.
    """
    power = (lenses.kept**4).sum(0)
    return torch.cat([power[:, :1] * (n**4 / 2), power[:, 1:]], 1)


def piston_powers(centers: Tensor, geometry: Geometry, wavelength: float) -> tuple[Tensor, Tensor]:
    """Return P and the sum of A^4 (B, H // 2 + 1, W) of masks with `centers` (B, N, 2) [m], for pistons alone."""
    light = Band.of([wavelength]), wavelength
    patches = make_apart(LensPatches, geometry, *light, None, None, centers.dtype, centers.device)
    n, found = centers.shape[1], []
    for mask in centers.split(1):
        lenses = patches(mask)
        power = (lenses.values**2).sum(0)
        power = torch.cat([power[:, :1] * (n**2 / 2), power[:, 1:]], 1)
        both = torch.cat([power / n**2, steady_lenses(lenses, n) / n**4])
        planes = patches.plane.summed(lenses.index.expand_as(both), both)
        found.append(patches.plane.folded(planes).unflatten(0, (2, len(mask))))
    mean, steady = torch.cat(found, 1).unflatten(-1, (geometry.grid[0] // 2 + 1, geometry.grid[1]))
    return mean, steady
