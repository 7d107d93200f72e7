"""OI_CORR, the table of an OIFITS file with the correlations of errors.

It is a sparse matrix for all data of a file, with a row for each correlated pair. Each row of a table of measurements
has the index of its first wavelength in that matrix, counted from 1 (CORRINDX_...).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchmask.interferometry.closures import incidence

Triplets = tuple[np.ndarray, np.ndarray, np.ndarray]  # IINDX, JINDX and CORR
_SHARED_SIDE = 1 / 3  # correlation of two closure phases that share a baseline, if all baselines are as noisy
_NO_INDEX = 0  # for a row whose data are not in the matrix


def correlation_triplets(covariances: Sequence[Tensor]) -> Triplets:
    """Return IINDX < JINDX, counted from 1, and CORR of several (M, M) covariances, one after the other.

    Correlations that are not finite are left out.
    """
    first, rows, columns, values = 1, [], [], []
    for covariance in covariances:
        scale = covariance.diagonal().rsqrt()
        correlation = (covariance * scale[:, None] * scale).numpy(force=True)
        i, j = np.triu_indices(len(correlation), 1)
        upper = correlation[i, j]
        kept = np.isfinite(upper) & (upper != 0)
        rows.append(first + i[kept])
        columns.append(first + j[kept])
        values.append(upper[kept])
        first += len(correlation)
    return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)


def read_correlations(hdus: Any) -> dict[str, Triplets]:
    """Read IINDX, JINDX and CORR of every OI_CORR, by its CORRNAME."""
    found = {}
    for hdu in hdus:
        if hdu.name == "OI_CORR":
            i, j, values = (np.asarray(hdu.data[name]).ravel() for name in ("IINDX", "JINDX", "CORR"))
            found[str(hdu.header["CORRNAME"]).strip()] = (i.astype(int), j.astype(int), values.astype(float))
    return found


def correlation_of(names: np.ndarray, places: np.ndarray, triplets: Mapping[str, Triplets]) -> Tensor | None:
    """Return the correlation (M, M) of data at indices `places` (M,) of matrices `names` (M,); None if independent."""
    matrix = torch.eye(len(places), dtype=torch.float64)
    correlated = False
    for name, (i, j, values) in triplets.items():
        mine = np.flatnonzero((names == name) & (places > _NO_INDEX))
        if not len(mine):
            continue
        number = np.full(1 + max(int(places[mine].max()), int(max(i.max(initial=0), j.max(initial=0)))), -1)
        number[places[mine]] = mine
        both = (number[i] >= 0) & (number[j] >= 0)
        a, b = torch.as_tensor(number[i[both]]), torch.as_tensor(number[j[both]])
        matrix[a, b] = matrix[b, a] = torch.as_tensor(values[both])
        correlated = correlated or bool(both.any())
    return matrix if correlated else None


def shared_sides(stations: np.ndarray, triangles: Tensor, exposure: np.ndarray) -> Tensor | None:
    """Return the correlation (C, C) of closure phases with equally noisy baselines; None if no baseline is shared.

    Parameters
    ----------
    stations : (C, 3) array
        Stations of each triangle; where they are not three, baselines are told by their coordinates.
    triangles : (C, 2, 2) tensor
        First and second baseline of each triangle [m].
    exposure : (C, L) array
        Numbers that differ between exposures, which share no noise.
    """
    matrix = np.eye(len(stations))
    _, group = np.unique(exposure, axis=0, return_inverse=True)
    for number in range(group.max(initial=-1) + 1):
        mine = np.flatnonzero(group.ravel() == number)
        if all(len(set(triangle)) == len(triangle) for triangle in stations[mine].tolist()):
            signs = _signs(stations[mine])
        else:
            first, second = triangles[mine].unbind(1)
            signs = incidence(torch.stack([first, second, -first - second], 1)).numpy()
        matrix[np.ix_(mine, mine)] = _SHARED_SIDE * signs @ signs.T
    return None if (matrix == np.diag(matrix.diagonal())).all() else torch.as_tensor(matrix)


def _signs(stations: np.ndarray) -> np.ndarray:
    """Return by which sign (C, B) each of B baselines enters the closure phases of triangles of `stations` (C, 3)."""
    names = sorted({frozenset(pair) for triangle in stations for pair in _pairs(triangle)}, key=sorted)
    column = {name: index for index, name in enumerate(names)}
    signs = np.zeros((len(stations), len(names)))
    for row, triangle in enumerate(stations):
        for first, second in _pairs(triangle):
            signs[row, column[frozenset((first, second))]] = 1 if first < second else -1
    return signs


def _pairs(triangle: np.ndarray) -> list[tuple[int, int]]:
    i, j, k = triangle.tolist()
    return [(i, j), (j, k), (k, i)]
