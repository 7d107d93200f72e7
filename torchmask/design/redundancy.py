"""Analysis of a mask's u-v coverage: baselines, redundancy, gaps, and the point-spread function.

All lengths are metres in the pupil, where a baseline stands for the frequency it transmits. Two holes transmit a patch
of frequencies around their baseline, the support of the autocorrelation of a hole, which has the shape of the hole and
twice its size.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull, KDTree, Voronoi

from torchmask.design.psf_shape import Array, peak_side_lobe, psf_widths
from torchmask.optics.pupil import Aperture
from torchmask.optics.shape_base import Shape

_LINES = 4096  # lines across half the u-v plane
_BLOCK = 2**20  # array elements processed at a time


@dataclass(frozen=True)
class RedundancyReport:
    """Report on the u-v coverage of a mask, which `print` shows as a table.

    n_subapertures : number of holes, N
    n_baselines : number of baselines, N (N - 1) / 2
    n_distinct : number of baselines if those closer than the tolerance count as one
    nonredundant : whether all baselines are distinct, as points
    strictly_nonredundant : whether their patches, including that of baseline zero, do not overlap either
    strict_hole_diameter : largest hole diameter for which the patches do not overlap [m]
    shortest_baseline : length of the shortest baseline [m]
    longest_baseline : length of the longest baseline [m]
    uv_filling : area of the union of patches over that of the u-v disc of a full pupil of `mask_diameter`
    gap_fraction : fraction of the disc up to the highest transmitted frequency that the union does not cover
    largest_gap : radius of the largest circle, centred within the hull of all baselines, that contains no baseline [m];
        frequencies are missing there if it exceeds the hole diameter
    fwhm : full width at half maximum of the PSF [wavelength / mask_diameter], the diameter of a disc with the area
        around the peak where the PSF exceeds half its maximum
    fwhm_min : width in the narrowest direction, in the same unit
    fwhm_max : width in the widest direction, in the same unit
    side_lobe : highest maximum of the PSF besides the central one, relative to that
    """

    n_subapertures: int
    n_baselines: int
    n_distinct: int
    nonredundant: bool
    strictly_nonredundant: bool
    strict_hole_diameter: float
    shortest_baseline: float
    longest_baseline: float
    uv_filling: float
    gap_fraction: float
    largest_gap: float
    fwhm: float
    fwhm_min: float
    fwhm_max: float
    side_lobe: float

    def __str__(self) -> str:
        answer = {True: "yes", False: "no"}
        rows = [
            ("holes", f"{self.n_subapertures}"),
            ("baselines", f"{self.n_baselines}, {self.n_distinct} distinct"),
            ("non-redundant", answer[self.nonredundant]),
            ("strictly, holes included", answer[self.strictly_nonredundant]),
            ("  for holes up to", f"{self.strict_hole_diameter:.4g} m"),
            ("shortest baseline", f"{self.shortest_baseline:.4g} m"),
            ("longest baseline", f"{self.longest_baseline:.4g} m"),
            ("u-v filling", f"{100 * self.uv_filling:.1f} %"),
            ("gaps in the covered disc", f"{100 * self.gap_fraction:.1f} %"),
            ("largest gap, radius", f"{self.largest_gap:.4g} m"),
            ("PSF width", f"{self.fwhm:.3f} ({self.fwhm_min:.3f} to {self.fwhm_max:.3f}) wavelength / mask diameter"),
            ("peak side lobe", f"{100 * self.side_lobe:.2f} %"),
        ]
        width = max(len(name) for name, _ in rows)
        return "\n".join(f"{name:<{width}}  {value}" for name, value in rows)


def analyse_redundancy(aperture: Aperture, tolerance: float = 0.02) -> RedundancyReport:
    """Describe the baselines, the u-v coverage and the PSF of one mask.

    Parameters
    ----------
    aperture : Aperture
        One mask of at least two holes, with centres (N, 2).
    tolerance : float
        Fraction of the shortest baseline below which two baselines count as the same.

    Raises
    ------
    ValueError
        If the aperture is a population or has fewer than two holes, two holes coincide, or the tolerance lies outside
        [0, 1).

    Notes
    -----
    Areas come from the chords of all patches along 4096 lines (relative error below 1e-4), and the PSF from its closed
    form, the transform of a hole times the sum of the holes' phasors. The side lobe is the highest within 2.5
    wavelengths over hole diameter; beyond that, the transform of a hole keeps others below 0.42 % (disc), 0.92 %
    (hexagon) or 1.62 % (square).

    Examples
    --------
    >>> from torchmask.optics.aperture import SparseAperture
    >>> report = analyse_redundancy(SparseAperture.from_catalog("golay6", 1.0, 0.15))
    >>> report.n_baselines, report.n_distinct, report.strictly_nonredundant
    (15, 15, False)
    """
    if aperture.centers.ndim != 2 or aperture.n_subapertures < 2:
        raise ValueError(
            f"centers has shape {tuple(aperture.centers.shape)}: one mask of at least two holes is needed, (N, 2)"
        )
    if not 0 <= tolerance < 1:
        raise ValueError(f"tolerance is {tolerance}: it must be a fraction of the shortest baseline, in [0, 1)")
    centers = aperture.centers.numpy(force=True).astype(np.float64)
    first, second = np.triu_indices(len(centers), 1)
    half = centers[first] - centers[second]
    lengths = np.linalg.norm(half, axis=1)
    if lengths.min() == 0:
        raise ValueError("two holes lie at the same place: remove one")
    baselines = np.concatenate([half, -half])
    sites = np.concatenate([baselines, np.zeros((1, 2))])
    shape, diameter = aperture.shape, aperture.subaperture_diameter
    strict = _smallest_separation(sites, shape) / 2
    distinct = _count_distinct(baselines, tolerance * lengths.min()) // 2
    area, reach = _covered_area(sites, shape, diameter), _reach(sites, shape, diameter)
    widths = aperture.mask_diameter * psf_widths(centers, aperture)
    return RedundancyReport(
        n_subapertures=len(centers),
        n_baselines=len(half),
        n_distinct=distinct,
        nonredundant=distinct == len(half),
        strictly_nonredundant=strict >= diameter * (1 - 1e-9),
        strict_hole_diameter=strict,
        shortest_baseline=float(lengths.min()),
        longest_baseline=float(lengths.max()),
        uv_filling=area / (math.pi * aperture.mask_diameter**2),
        gap_fraction=1 - area / (math.pi * reach**2),
        largest_gap=_largest_empty_circle(sites),
        fwhm=float(np.sqrt(np.mean(widths**2))),
        fwhm_min=float(widths.min()),
        fwhm_max=float(widths.max()),
        side_lobe=peak_side_lobe(centers, aperture),
    )


def _smallest_separation(sites: Array, shape: Shape) -> float:
    """Return the smallest diameter at which two equal holes at the sites touch [m]."""
    points, smallest = torch.from_numpy(sites), math.inf
    for rows in torch.arange(len(points)).split(max(1, _BLOCK // len(points))):
        separation = shape.separation(points[rows, None] - points)
        separation[torch.arange(len(rows)), rows] = math.inf
        smallest = min(smallest, float(separation.min()))
    return smallest


def _count_distinct(baselines: Array, distance: float) -> int:
    """Return the number of groups of baselines, of both signs, linked by steps of at most `distance`."""
    pairs = KDTree(baselines).query_pairs(distance, output_type="ndarray")
    links = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(baselines),) * 2)
    return int(connected_components(links, directed=False)[0])


def _reach(sites: Array, shape: Shape, diameter: float) -> float:
    """Return the radius of the smallest disc around zero that contains every patch [m]."""
    return -float(shape.clearance(torch.from_numpy(sites), 2 * diameter, 0.0).min())


def _covered_area(sites: Array, shape: Shape, diameter: float) -> float:
    """Return the area of the union of all patches [m^2], from the union of their chords on each of many lines."""
    top, turn = _reach(sites, shape, diameter), shape.askew  # chords are continuous if no side is parallel to the lines
    sites = sites @ np.array([[math.cos(turn), math.sin(turn)], [-math.sin(turn), math.cos(turn)]])
    patch = shape.turned(turn)
    step = top / _LINES
    lines = (np.arange(_LINES) + 0.5) * step  # the other half of the plane is its point reflection
    length = 0.0  # length of the union, summed over lines
    for y in np.array_split(lines, math.ceil(_LINES * len(sites) / _BLOCK)):
        left, right = patch.chords(y[:, None] - sites[:, 1], 2 * diameter)
        left, right = left + sites[:, 0], right + sites[:, 0]
        order = np.argsort(left, axis=1)
        left, right = np.take_along_axis(left, order, 1), np.take_along_axis(right, order, 1)
        before = np.maximum.accumulate(right, axis=1)[:, :-1]
        new = right[:, 1:] - np.maximum(left[:, 1:], before)
        length += float((right[:, 0] - left[:, 0]).sum() + np.clip(new, 0, None).sum())
    return 2 * length * step


def _largest_empty_circle(sites: Array) -> float:
    """Return the radius of the largest circle without a site inside, centred in the convex hull of the sites.

    Its centre is a vertex of the Voronoi diagram, or a point where an edge of the diagram crosses the hull.
    """
    singular, axes = np.linalg.svd(sites)[1:]
    if singular[1] < 1e-9 * singular[0]:  # all sites are collinear
        return float(np.diff(np.sort(sites @ axes[0])).max()) / 2
    voronoi, hull = Voronoi(sites), ConvexHull(sites)
    inside = (voronoi.vertices @ hull.equations[:, :2].T + hull.equations[:, 2]).max(axis=1) <= 0
    p, q = sites[voronoi.ridge_points[:, 0], None], sites[voronoi.ridge_points[:, 1], None]  # (ridge, 1, 2)
    start, end = sites[hull.simplices[:, 0]], sites[hull.simplices[:, 1]]  # (edge, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (((p + q) / 2 - start) * (q - p)).sum(-1) / ((end - start) * (q - p)).sum(-1)
    ridge, edge = np.nonzero((t >= 0) & (t <= 1))
    crossings = start[edge] + t[ridge, edge, None] * (end - start)[edge]
    distances, _ = KDTree(sites).query(np.concatenate([voronoi.vertices[inside], crossings]))
    return float(distances.max())
