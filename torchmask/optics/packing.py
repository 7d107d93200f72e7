"""Packing of equal discs in a larger disc, its limits, and random packings."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from torchmask.numbers import whole_number

# Smallest known diameter of the disc that encloses N = 1, 2, ... equal discs, in units of their diameter: R. L. Graham,
# B. D. Lubachevsky, K. J. Nurmela, P. R. J. Ostergard, Discrete Mathematics 181, 139 (1998); E. Specht, packomania.com.
# Proven optimal up to 14 and for 19.
_RATIOS = (
    1.0,
    2.0,
    1 + 2 / math.sqrt(3),
    1 + math.sqrt(2),
    1 + math.sqrt(2 * (1 + 1 / math.sqrt(5))),
    3.0,
    3.0,
    1 + 1 / math.sin(math.pi / 7),
    1 + math.sqrt(2 * (2 + math.sqrt(2))),
    3.8130256313981246,
    1 + 1 / math.sin(math.pi / 9),
    4.0296019301161834,
    2 + math.sqrt(5),
    4.3284285548608363,
    1 + math.sqrt(6 + 2 / math.sqrt(5) + 4 * math.sqrt(1 + 2 / math.sqrt(5))),
    4.6154255948731940,
    4.7920337488105831,
    1 + math.sqrt(2) + math.sqrt(6),
    1 + math.sqrt(2) + math.sqrt(6),
    5.1223207369915291,
)
_ATTEMPTS = 60
_ROUNDING = 1e-12  # in units of the mask diameter


def largest_fill_factor(n_subapertures: int) -> float:
    """Return the largest N d^2 / D^2 for N discs of diameter d inside one of diameter D.

    Up to N = 20 it is that of the best packing known; beyond, an upper bound that no packing reaches (N. Oler, Acta
    Mathematica 105, 19 (1961): a convex figure holds at most 2/sqrt(3) area + perimeter/2 + 1 points at mutual
    distances of at least 1).
    """
    n = n_subapertures
    if n <= len(_RATIOS):
        return n / _RATIOS[n - 1] ** 2
    area = 2 * math.pi / math.sqrt(3)  # area r^2 + pi r + 1 = N, r the radius of the centres' disc in hole diameters
    radius = (math.sqrt(math.pi**2 + 4 * area * (n - 1)) - math.pi) / (2 * area)
    return n / (1 + 2 * radius) ** 2


def largest_number(ratio: float) -> int:
    """Return an upper limit on the number of equal discs that fit into a disc `ratio` times as wide.

    Up to 20 it is that of the best packings known; beyond, the bound of Oler, whose density tends to pi / sqrt(12).
    """
    known = sum(ratio >= needed * (1 - _ROUNDING) for needed in _RATIOS)
    if known < len(_RATIOS):
        return known
    radius = (ratio - 1) / 2
    return max(known, math.floor(2 * math.pi / math.sqrt(3) * radius**2 + math.pi * radius + 1))


def certain_number(ratio: float) -> int:
    """Return a number of equal discs that certainly fit into a disc `ratio` times as wide.

    It is that of the best packing known, or of a hexagonal lattice if that is more.
    """
    known = sum(ratio >= needed for needed in _RATIOS)
    if known < len(_RATIOS):
        return known
    reach = math.ceil(ratio)
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    lattice = (i**2 + i * j + j**2) <= ((ratio - 1) / 2) ** 2  # squared distances from a point of the lattice
    return max(known, int(lattice.sum()))


def hole_diameter(n_subapertures: int, mask_diameter: float, fill_factor: float) -> float:
    """Return the diameter d [m] of N holes in a disc of diameter D with N d^2 / D^2 = `fill_factor`.

    Raises
    ------
    ValueError
        If a number is out of range or the holes cannot be packed; the message gives the largest fill factor.
    """
    n_subapertures = whole_number("n_subapertures", n_subapertures)
    if not (math.isfinite(mask_diameter) and mask_diameter > 0):
        raise ValueError(f"mask_diameter is {mask_diameter}: it must be finite and positive, in m")
    largest = largest_fill_factor(n_subapertures)
    if not 0 < fill_factor <= largest * (1 + 1e-12):
        stated = math.floor(largest * 1e5) / 1e5
        known = "the best packing known" if n_subapertures <= len(_RATIOS) else "more than any packing reaches"
        raise ValueError(
            f"fill_factor is {fill_factor}: {n_subapertures} round holes in a disc need N d^2/D^2 above 0 and at most "
            f"{stated:.5f}, which is {known}"
        )
    return mask_diameter * math.sqrt(fill_factor / n_subapertures)


def random_packing(
    n_subapertures: int, mask_diameter: float, fill_factor: float, generator: torch.Generator | None = None
) -> Tensor:
    """Return centres (N, 2) [m], float64, of randomly placed holes that lie in the mask disc and do not overlap.

    Holes are drawn uniformly in the disc and pushed apart until they fit. Raises ValueError if they do not.
    """
    reach = hole_diameter(n_subapertures, 1.0, fill_factor)
    n_subapertures = int(n_subapertures)  # a whole number, as that has checked
    best = 0.0
    for _ in range(_ATTEMPTS):
        u = torch.rand(n_subapertures, 2, generator=generator, dtype=torch.float64, device="cpu").numpy()
        angle = 2 * math.pi * u[:, 1]
        thrown = (1 - reach) / 2 * np.sqrt(u[:, :1]) * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        for centers in (thrown, relaxed := _push_apart(thrown, reach)):
            if _largest_diameter(centers) >= reach - _ROUNDING:
                return torch.as_tensor(mask_diameter * centers)
        inflated = _inflate(relaxed)
        best = max(best, _largest_diameter(inflated))
        if best >= reach - _ROUNDING:
            return torch.as_tensor(mask_diameter * inflated)
    raise ValueError(
        f"fill_factor is {fill_factor}: in {_ATTEMPTS} attempts {n_subapertures} round holes were packed into the disc "
        f"with at most {math.floor(n_subapertures * best**2 * 1e5) / 1e5:.5f}"
    )


def _largest_diameter(centers: np.ndarray) -> float:
    """Return the largest diameter of discs at these centres that neither overlap nor leave the disc of diameter 1."""
    to_rim = 1 - 2 * np.linalg.norm(centers, axis=-1).max()
    first, second = np.triu_indices(len(centers), 1)
    return float(min(to_rim, np.linalg.norm(centers[first] - centers[second], axis=-1).min(initial=np.inf)))


def _push_apart(centers: np.ndarray, diameter: float) -> np.ndarray:
    """Minimise the sum of the squared overlaps of discs that are enlarged slightly, so that the real ones end clear."""
    diameter = diameter * (1 + 1e-6)
    first, second = np.triu_indices(len(centers), 1)

    def energy(flat: np.ndarray) -> tuple[float, np.ndarray]:
        points = flat.reshape(-1, 2)
        apart = points[first] - points[second]
        distance = np.maximum(np.linalg.norm(apart, axis=-1), 1e-12)
        radius = np.maximum(np.linalg.norm(points, axis=-1), 1e-12)
        overlap = np.maximum(diameter - distance, 0)
        beyond = np.maximum(radius - (1 - diameter) / 2, 0)
        push = (overlap / distance)[:, None] * apart
        gradient = 2 * (beyond / radius)[:, None] * points
        np.add.at(gradient, first, -2 * push)
        np.add.at(gradient, second, 2 * push)
        return float((overlap**2).sum() + (beyond**2).sum()), gradient.ravel()

    # An energy of 1e-16, a square, leaves overlaps of 1e-8, less than the enlargement of the discs.
    return minimize(energy, centers.ravel(), jac=True, method="L-BFGS-B", tol=1e-18).x.reshape(-1, 2)


def _inflate(centers: np.ndarray) -> np.ndarray:
    """Move the centres so that the equal discs that fit are locally largest (sequential quadratic programming)."""
    n = len(centers)
    first, second = np.triu_indices(n, 1)
    size = _largest_diameter(centers)
    near = np.linalg.norm(centers[first] - centers[second], axis=-1) < 2.5 * max(size, 0.9 / math.sqrt(n))
    first, second = first[near], second[near]
    rows = np.arange(len(first))

    def clearance(z: np.ndarray) -> np.ndarray:
        points, d = z[:-1].reshape(-1, 2), z[-1]
        pairs = ((points[first] - points[second]) ** 2).sum(-1) - d**2
        return np.concatenate([pairs, (1 - d) ** 2 / 4 - (points**2).sum(-1)])

    def jacobian(z: np.ndarray) -> np.ndarray:
        points, d = z[:-1].reshape(-1, 2), z[-1]
        slope = np.zeros((len(first) + n, n, 2))
        apart = 2 * (points[first] - points[second])
        slope[rows, first], slope[rows, second] = apart, -apart
        slope[len(first) + np.arange(n), np.arange(n)] = -2 * points
        by_size = np.concatenate([np.full(len(first), -2 * d), np.full(n, -(1 - d) / 2)])
        return np.concatenate([slope.reshape(len(slope), -1), by_size[:, None]], axis=1)

    result = minimize(
        lambda z: (-z[-1], np.append(np.zeros(2 * n), -1.0)),
        np.append(centers.ravel(), size),
        jac=True,
        method="SLSQP",
        constraints={"type": "ineq", "fun": clearance, "jac": jacobian},
        options={"maxiter": 200, "ftol": 1e-15},
    )
    return result.x[:-1].reshape(-1, 2)
