"""Coherence under turbulence of the overlap of two equal holes, as a short sum of functions with tabulated factors.

Two holes of a pupil transmit a baseline b if it differs from their own by u, less than a hole; their overlap is then a
lens, wherever the holes are. Turbulence and exposure leave the fraction

    c(b, u) = < exp(-Q(b, s) / 2) >,   Q(b, s) = 2 D(b) + 2 D(s) - D(s + b) - D(s - b),

of its |OTF|^2, the mean over pairs of points of the lens, of separation s. The length of a thin lens is proportional to
the cube root of its transmission T(u), and its loss to about (length / r0)^(5/3), or T^(5/9). Hence c is nearly linear
in T^(1/2), and so is its root, the fraction of the amplitude: a parabola in T^(1/2) with terms for the direction of u
approximates it to about half a per cent. Amplitudes add up where several wavelengths of a band meet.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import map_coordinates
from torch import Tensor

from torchmask.atmosphere.seeing import Seeing
from torchmask.atmosphere.structure import StructureFunction
from torchmask.optics.shape_base import Shape

_PER_HOLE, _PER_R0, _PER_SHARED = 20, 6, 10  # samples
_MOST_LAGS = 12
_PLACES = (12, 16)  # number of distances and directions (over half a turn) of u
_BASELINES = (16, 16)  # the same for the baselines b
_SHARED_BASELINES = (9, 12)  # the same for baselines within a hole, of lenses of holes with themselves
_SEPARATIONS = (28, 12)  # the same for the separations of these holes
_TOLERANCE = 1e-3  # of the table of lenses of holes with themselves, in its norm
_NOTHING = 1e-14  # of the density of separations, less than what rounding leaves of it
_FAINT = 0.05  # errors of c^(1/2) are weighted by T^(1/2) plus this: thin lenses transmit little


class PolarTable:
    """Table of an even function in the plane, with values (..., distances, directions).

    Distances are `longest` (i / (n - 1))^power, and directions are evenly spaced over half a turn.
    """

    values: np.ndarray
    longest: float
    power: float

    def __init__(self, values: Tensor, longest: float, power: float) -> None:
        # half a turn more to either side, so that a cubic spline is smooth at the seam
        self.values, self.longest, self.power = torch.cat([values] * 3, -1).numpy(), longest, power
        self.n_directions: int = values.shape[-1]

    @staticmethod
    def nodes(sizes: tuple[int, int], longest: float, power: float) -> Tensor:
        """Return the points (distances, directions, 2) at which the function is tabulated."""
        radius = longest * torch.linspace(0, 1, sizes[0], dtype=torch.float64) ** power
        angle = math.pi * torch.arange(sizes[1], dtype=torch.float64) / sizes[1]
        return radius[:, None, None] * torch.stack([angle.cos(), angle.sin()], -1)

    def __call__(self, points: Tensor) -> Tensor:
        """Return the values (..., P) at points (P, 2), by cubic splines; beyond `longest` they are constant."""
        x, y = points.double().cpu().numpy().T
        opposite = (y < 0) | ((y == 0) & (x < 0))  # mapped to their opposites, for exact evenness
        x, y = np.where(opposite, -x, x), np.where(opposite, -y, y)
        n = self.values.shape[-2] - 1
        distance = np.minimum(np.hypot(x, y) / self.longest, 1) ** (1 / self.power) * n
        direction = (np.arctan2(y, x) / math.pi + 1) * self.n_directions
        leading = self.values.shape[:-2]
        flat = self.values.reshape(-1, *self.values.shape[-2:])
        found = [map_coordinates(one, [distance, direction], order=3, mode="mirror") for one in flat]
        return torch.from_numpy(np.stack(found)).reshape(*leading, len(points))


class SharedCoherence(NamedTuple):
    """A function of the baseline and of the separation of two holes, as a sum of products of functions of each."""

    by_baseline: PolarTable
    by_place: PolarTable


def lens_sum(factors: Iterable[Tensor], root: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the amplitude c^(1/2), of the shape of the arguments, by the factors of `lens_amplitude`.

    `root` is the square root of T; x and y are u over the holes' outer diameter.
    """
    constant, linear, square, along, skew = factors
    slope = torch.addcmul(linear, root, square)
    slope.addcmul_(x * x - y * y, along).addcmul_(2 * x * y, skew)
    return torch.addcmul(constant, root, slope)


def lens_amplitude(
    shape: Shape, diameter: float, seeing: Seeing, longest: float, scale: float = 1.0, steady: bool = False
) -> PolarTable:
    """Tabulate the factors of c^(1/2) against the baseline, up to `longest` [m], for holes of one shape.

    Phases are `scale` times those of the seeing. With `steady` it is exp(-<Q> / 4) instead, what remains of an
    amplitude that does not fluctuate.
    """
    reach = shape.outer_diameter(diameter)
    nodes = PolarTable.nodes(_PLACES, reach, 1.0)
    places = nodes.flatten(0, 1)
    drift, shares = lens_drift(seeing)
    fewest = _PER_HOLE if len(drift) == 1 else _PER_HOLE * 3 // 5  # fewer, as the drift smooths
    per_hole = max(fewest, math.ceil(_PER_R0 * diameter / seeing.r0))
    structure = seeing.structure(longest + 2 * reach + float(drift.norm(dim=-1).max()))
    baselines = PolarTable.nodes(_BASELINES, longest, 2.0)

    def amplitude(baselines: Tensor, places: Tensor) -> Tensor:
        separations, densities = _reached(*lens_densities(shape, diameter, places, per_hole))
        total = torch.zeros(len(baselines), len(separations), dtype=torch.float64)
        for step, share in zip(drift, shares, strict=True):
            exponent = scale**2 * _exponent(structure, baselines[:, None], separations + step)
            total += share * (exponent if steady else exponent.exp())
        kept = total @ densities.T
        return (kept / 2).exp() if steady else kept.sqrt()

    root = shape.otf(places, diameter).sqrt()
    weight = root + _FAINT
    functions = torch.stack([lens_sum(one, root, *(places / reach).unbind(-1)) for one in torch.eye(5).double()], -1)
    table = _table(amplitude, baselines, nodes, shape, seeing) * weight
    factors = torch.linalg.lstsq(functions * weight[:, None], table.T, driver="gelsd").solution
    return PolarTable(factors.unflatten(-1, _BASELINES), longest, 2.0)


def shared_coherence(shape: Shape, diameter: float, seeing: Seeing, longest: float) -> SharedCoherence:
    """Tabulate the coherence <exp(-Q(u, c + t) / 2)> of the lenses of two holes, each with itself.

    It depends on the baseline u, smaller than a hole, and on the separation c of the holes, up to `longest` [m]; the
    mean is over the separation t of two points of one lens.
    """
    reach = shape.outer_diameter(diameter)
    nodes = PolarTable.nodes(_SEPARATIONS, longest, 1.5)
    drift, shares = lens_drift(seeing)
    per_hole = _PER_SHARED if len(drift) == 1 else _PER_SHARED * 3 // 5
    structure = seeing.structure(longest + 4 * reach + float(drift.norm(dim=-1).max()))

    def coherence(baselines: Tensor, between: Tensor) -> Tensor:
        separations, densities = _reached(*lens_densities(shape, diameter, baselines, per_hole))
        separations = torch.cat([separations, -separations])
        rows = [(density > _NOTHING).repeat(2).nonzero()[:, 0] for density in densities]
        densities = densities.repeat(1, 2) / 2
        total = torch.zeros(len(baselines), len(between), dtype=torch.float64)
        for step, share in zip(drift, shares, strict=True):
            points = between[:, None] + step + separations
            own = structure(points)
            for row, chosen in enumerate(rows):
                exponent = _exponent(structure, baselines[row], points[:, chosen], own[:, chosen])
                total[row] += share * (exponent.exp() @ densities[row, chosen])
        return total

    baselines = PolarTable.nodes(_SHARED_BASELINES, reach, 1.5)
    rows, columns = _factors(_table(coherence, baselines, nodes, shape, seeing))
    by_baseline = PolarTable(rows.unflatten(-1, _SHARED_BASELINES), reach, 1.5)
    return SharedCoherence(by_baseline, PolarTable(columns.unflatten(-1, _SEPARATIONS), longest, 1.5))


def _table(
    function: Callable[[Tensor, Tensor], Tensor], baselines: Tensor, others: Tensor, shape: Shape, seeing: Seeing
) -> Tensor:
    """Return `function` of all polar baselines (n, m, 2) and other points (k, l, 2), as (n m, k l).

    In turbulence that is the same in all directions, what is mirrored about x is so too if the shape is, and if it is
    round all directions of the baseline follow from the first, as only the angle between both arguments matters.
    """

    def values(baselines: Tensor, others: Tensor) -> Tensor:
        found = function(baselines.flatten(0, 1), others.flatten(0, 1))
        return found.unflatten(-1, others.shape[:2]).unflatten(0, baselines.shape[:2])

    n_turns, n_others = baselines.shape[1], others.shape[1]
    if not seeing.is_isotropic or shape.mirrored() != shape:
        return values(baselines, others).flatten(2).flatten(0, 1)
    if shape.is_round:
        half = values(baselines[:, :1], others[:, : n_others // 2 + 1])[:, 0]
        first = torch.cat([half, half[..., 1 : (n_others + 1) // 2].flip(-1)], -1)
        found = torch.stack([first.roll(turn * n_others // n_turns, -1) for turn in range(n_turns)], 1)
    else:
        half = values(baselines[:, : n_turns // 2 + 1], others)
        mirrored = half[:, 1 : (n_turns + 1) // 2].flip(1).flip(-1).roll(1, -1)
        found = torch.cat([half, mirrored], 1)
    return found.flatten(2).flatten(0, 1)


def lens_drift(seeing: Seeing) -> tuple[Tensor, list[float]]:
    """Return displacements (L, 2) [m] during the exposure, each with its opposite, and their weights."""
    if seeing.exposure == 0:
        return torch.zeros(1, 2, dtype=torch.float64), [1.0]
    n = 3 + math.ceil(2 * seeing.exposure * seeing.speed / seeing.r0)
    steps, shares = seeing.drift(min(n, _MOST_LAGS), min(n, _MOST_LAGS))
    return torch.cat([steps, -steps]), (shares / 2).repeat(2).tolist()


def _exponent(structure: StructureFunction, baseline: Tensor, separation: Tensor, own: Tensor | None = None) -> Tensor:
    """Return -Q / 2 (...); `own` is the structure function of the separation, if it is known already."""
    own = structure(separation) if own is None else own
    crossed = structure(separation + baseline) + structure(separation - baseline)
    return crossed / 2 - own - structure(baseline)


def _factors(table: Tensor) -> tuple[Tensor, Tensor]:
    """Return rows (R, n) and columns (R, m) whose outer products sum to the table (n, m)."""
    left, size, right = torch.linalg.svd(table, full_matrices=False)
    rank = max(1, int((size > _TOLERANCE * size[0]).sum()))
    root = size[:rank].sqrt()
    return (left[:, :rank] * root).T, root[:, None] * right[:rank]


def _reached(separations: Tensor, densities: Tensor) -> tuple[Tensor, Tensor]:
    """Return the separations (S, 2) that some lens has, and their densities (U, S)."""
    some = (densities > _NOTHING).any(0)
    return separations[some], densities[:, some]


def lens_densities(
    shape: Shape, diameter: float, places: Tensor, per_hole: int, others: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return separations (S, 2) [m] in half the plane, and their densities (U, S) in the lenses at `places` (U, 2).

    With `others` (U, 2), they are those between points of a lens at a place and points of one at the other place, with
    a common middle. Densities have unit sum. A lens without extent has separation 0 only.
    """
    step = diameter * shape.fineness / per_hole
    size = math.ceil(shape.outer_diameter(diameter) / step) + 2
    axis = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * step
    points = torch.stack(torch.meshgrid(axis, axis, indexing="xy"), -1)
    cell = torch.tensor([step, step], dtype=torch.float64)

    def transform(places: Tensor) -> Tensor:
        half = places[:, None, None] / 2
        lens = shape.coverage(points + half, cell, diameter) * shape.coverage(points - half, cell, diameter)
        return torch.fft.rfft2(lens, s=(2 * size, 2 * size))

    first = transform(places)
    power = first.conj() * (first if others is None else transform(others))
    density = torch.fft.irfft2(power, s=(2 * size, 2 * size)).clamp(min=0).flatten(1)
    lag = torch.fft.fftfreq(2 * size, 1 / (2 * size), dtype=torch.float64) * step
    separations = torch.stack(torch.meshgrid(lag, lag, indexing="xy"), -1).flatten(0, 1)
    upper = (separations[:, 1] > 0) | ((separations[:, 1] == 0) & (separations[:, 0] >= 0))
    density[:, 0] = density[:, 0] / 2 + 1e-12 * float(density.max())  # half of it belongs to the other half plane
    density = density[:, upper]
    return separations[upper], density / density.sum(-1, keepdim=True)
