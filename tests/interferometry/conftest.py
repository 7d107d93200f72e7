"""Measurements of a star, with correlated errors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_model import pair_visibilities

STATIONS = [[0.0, 2.6], [2.4, 0.3], [1.1, -2.3], [-1.7, -1.9], [-2.5, 0.8], [0.6, 0.4]]
WAVELENGTH = 2e-6


@pytest.fixture(scope="session")
def measure_pair() -> Callable[..., Measurements]:
    """|V|^2 and closure phases of a companion (3,), or of the star alone, through six holes.

    Closure phases are sums of noisy phases of the baselines; squared visibilities share a tenth of their variance.
    """
    stations = torch.tensor(STATIONS, dtype=torch.float64)
    pairs = list(itertools.combinations(range(6), 2))
    number = {pair: index for index, pair in enumerate(pairs)}
    triangles = list(itertools.combinations(range(6), 3))
    baselines = torch.stack([stations[j] - stations[i] for i, j in pairs])
    sides = torch.stack([torch.stack([stations[j] - stations[i], stations[k] - stations[j]]) for i, j, k in triangles])
    signs = torch.zeros(len(triangles), len(pairs), dtype=torch.float64)
    for row, (i, j, k) in enumerate(triangles):
        signs[row, number[i, j]] = signs[row, number[j, k]] = 1
        signs[row, number[i, k]] = -1

    def measure(
        companion: Tensor | None = None, seed: int | None = None, rms: float = 0.01, told: float = 1.0
    ) -> Measurements:
        star = torch.zeros(3, dtype=torch.float64) if companion is None else companion
        values = pair_visibilities(baselines / WAVELENGTH, star)
        phases, power = values.angle(), values.abs() ** 2
        if seed is not None:
            generator = torch.Generator().manual_seed(seed)
            draw = torch.randn(2 * len(pairs) + 1, generator=generator, dtype=torch.float64)
            phases = phases + rms * draw[: len(pairs)]
            power = power + rms * (math.sqrt(0.9) * draw[len(pairs) : -1] + math.sqrt(0.1) * draw[-1])
        closures = signs @ phases
        shared = 0.9 * torch.eye(len(pairs), dtype=torch.float64) + 0.1
        return Measurements(
            *(baselines, torch.full((len(pairs),), WAVELENGTH, dtype=torch.float64), power),
            *(torch.full_like(power, told * rms), shared, sides),
            torch.full((len(triangles),), WAVELENGTH, dtype=torch.float64),
            torch.atan2(closures.sin(), closures.cos()),
            torch.full((len(triangles),), told * rms * math.sqrt(3), dtype=torch.float64),
            signs @ signs.T / 3,
        )

    return measure
