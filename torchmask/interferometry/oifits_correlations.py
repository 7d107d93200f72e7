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

Triplets = tuple[np.ndarray, np.ndarray, np.ndarray]  # IINDX, JINDX and CORR
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
