"""Which combinations of closure phases are independent: phases of N holes close in (N - 1)(N - 2)/2 of them."""

from __future__ import annotations

import torch
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from torchmask.interferometry.measurements import Measurements

_EQUAL = 1e-6  # of the length of a baseline: sides of two triangles that differ by less are of the same holes
_RANK = 1e-9  # of the largest singular value: what is smaller is rounding


def closure_combinations(measured: Measurements) -> Tensor:
    """Return orthonormal combinations (C, K) of closure phases that sums of the baselines' phases can take, K <= C.

    Closure phases whose errors are correlated share baselines: those of equal length and direction, to a millionth.
    What the phases of baselines cannot explain, such as a triangle that disagrees with the three around a fourth hole,
    is noise of higher order, whose covariance a few frames do not tell. Without correlations all C count.
    """
    n = len(measured.closure_phases)
    if measured.closure_correlation is None or n == 0:
        return torch.eye(n, dtype=torch.float64)
    _, group = connected_components(measured.closure_correlation.numpy() != 0, directed=False)
    parts = []
    for number in range(group.max() + 1):
        mine = torch.as_tensor(group == number).nonzero().flatten()
        vectors, values, _ = torch.linalg.svd(incidence(measured.triangle_frequencies[mine]), full_matrices=False)
        own = vectors[:, values > _RANK * values[0]]
        part = own.new_zeros(n, own.shape[1])
        part[mine] = own
        parts.append(part)
    return torch.cat(parts, 1)


def incidence(sides: Tensor) -> Tensor:
    """Return by which sign (C, B) the phase of each of B baselines enters closure phases, from `sides` (C, 3, 2)."""
    every = sides.flatten(0, 1)
    lengths = torch.linalg.vector_norm(every, dim=1)
    same, opposite = (torch.cdist(every, sign * every, compute_mode="donot_use_mm_for_euclid_dist") for sign in (1, -1))
    first = (torch.minimum(same, opposite) <= _EQUAL * lengths[:, None]).double().argmax(1)
    signs = torch.where(same[range(len(every)), first] <= opposite[range(len(every)), first], 1.0, -1.0)
    baselines, column = first.unique(return_inverse=True)
    matrix = torch.zeros(len(sides), len(baselines), dtype=torch.float64)
    row = torch.arange(len(every)) // 3
    return matrix.index_put_((row, column), signs.double(), accumulate=True)
