import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq, minimize_scalar
from scipy.spatial import Delaunay
from scipy.special import j1, jn_zeros

from torchmask.design import psf_shape, redundancy
from torchmask.design.redundancy import analyse_redundancy
from torchmask.grid import Grid
from torchmask.optics import catalog
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.psf import psf_from_samples
from torchmask.optics.shapes import Disc, Hexagon, Polygon, Square


def mask_of(points, hole=0.1, diameter=1.0, **keywords):
    return SparseAperture(torch.as_tensor(np.array(points), dtype=torch.float64), hole, diameter, **keywords)


def lens(separation, radius):
    """Area common to two discs of `radius`."""
    x = separation / (2 * radius)
    return 2 * radius**2 * (math.acos(x) - x * math.sqrt(1 - x**2)) if x < 1 else 0.0


def test_the_catalogue_against_facts(mask_facts):
    for name, fact in mask_facts.items():
        entry, check = catalog.entry(name), fact["check"]
        mask = mask_of(entry.centers, entry.hole_diameter or 0.3, entry.pupil_diameter or 1.0, shape=entry.shape)
        report = analyse_redundancy(mask)
        assert report.n_baselines == check["n_baselines"], name
        assert report.n_distinct == check["n_baselines"] - check["coincident_baselines_tol2pct"], name
        assert report.nonredundant == check["exact_nonredundant"], name
        # printed to four decimals, from coordinates of six
        assert report.shortest_baseline == pytest.approx(check["shortest_baseline"], abs=6e-5), name
        assert report.longest_baseline == pytest.approx(check["longest_baseline"], abs=6e-5), name
        if entry.shape == Disc():
            assert report.strict_hole_diameter == pytest.approx(check["max_hole_diameter_strict"], abs=6e-5), name
            if entry.hole_diameter is not None:
                assert report.strictly_nonredundant == check["strict_nonredundant_with_holes"], name


def test_golay6_fills_the_lattice():
    """Every lattice point within sqrt(7) pitches carries one baseline; the gaps lie among those just beyond."""
    report = analyse_redundancy(mask_of(catalog.entry("golay6").centers, 0.5, 3.6))
    assert report.strict_hole_diameter == pytest.approx(0.5, rel=1e-12)
    assert report.strictly_nonredundant
    assert report.uv_filling == pytest.approx(31 * 0.5**2 / 3.6**2, rel=1e-4)
    assert report.gap_fraction == pytest.approx(1 - 31 * 0.5**2 / (math.sqrt(7) + 0.5) ** 2, rel=1e-4)
    touching = analyse_redundancy(mask_of(catalog.entry("golay6").centers, 0.5 * (1 + 1e-6), 3.6))
    assert not touching.strictly_nonredundant


def test_redundant_rows_and_squares():
    row = analyse_redundancy(mask_of([[0.0, 0], [1, 0], [2, 0], [3, 0]], 0.1, 4.0))
    assert (row.n_baselines, row.n_distinct, row.nonredundant) == (6, 3, False)
    assert row.largest_gap == pytest.approx(0.5, rel=1e-12)
    assert row.strict_hole_diameter == pytest.approx(0, abs=1e-15)
    square = analyse_redundancy(mask_of([[0.0, 0], [1, 0], [0, 1], [1, 1]], 0.1, 2.0))
    assert (square.n_baselines, square.n_distinct) == (6, 4)
    assert square.largest_gap == pytest.approx(math.sqrt(0.5), rel=1e-12)


def test_two_holes_must_be_two_diameters_apart():
    """With two holes only the patch of baseline zero is near: from three on, differences of baselines are baselines."""
    assert analyse_redundancy(mask_of([[0.0, 0], [0.6, 0]], 0.1)).strict_hole_diameter == pytest.approx(0.3, rel=1e-12)


def test_the_tolerance_decides_what_is_distinct():
    row = mask_of([[0.0, 0], [1, 0], [2.03, 0]], 0.1, 4.0)
    assert analyse_redundancy(row).n_distinct == 3
    assert analyse_redundancy(row, tolerance=0.04).n_distinct == 2


@pytest.mark.parametrize("hole", [0.1, 0.3, 0.45])
def test_covered_area_of_two_discs(hole):
    report = analyse_redundancy(mask_of([[-0.25, 0], [0.25, 0]], hole, 1.0))
    # three patches in line, 0.5 apart; the outer two do not meet as long as 2 hole < 1
    area = 3 * math.pi * hole**2 - 2 * lens(0.5, hole)
    assert report.uv_filling == pytest.approx(area / math.pi, rel=1e-4)
    assert report.gap_fraction == pytest.approx(1 - area / (math.pi * (0.5 + hole) ** 2), rel=1e-4, abs=1e-4)


@pytest.mark.parametrize("orientation", [0.0, math.pi / 6, 0.3])
@pytest.mark.parametrize("hole", [0.1, 0.4])
def test_covered_area_of_two_hexagons(orientation, hole):
    mask = mask_of([[-0.25, 0], [0.25, 0]], hole, 1.0, shape="hexagon", orientation=orientation)
    patch = math.sqrt(3) / 2 * (2 * hole) ** 2
    overlap = patch * float(Hexagon(orientation).otf(torch.tensor([0.5, 0.0], dtype=torch.float64), 2 * hole))
    area = 3 * patch - 2 * overlap
    assert analyse_redundancy(mask).uv_filling == pytest.approx(area / math.pi, rel=1e-4)


@pytest.mark.parametrize("name", ["vlt_naco_7", "jwst_niriss_ami_7", "keck_lws_pattern2a_9"])
def test_covered_area_against_random_points(name):
    mask = SparseAperture.from_catalog(name)
    centers = mask.centers.numpy()
    sites = (centers[:, None] - centers[None]).reshape(-1, 2)
    rng = np.random.default_rng(3)
    n, half_width = 40_000, 1.2 * mask.extent
    points = rng.uniform(-half_width, half_width, (n, 2))
    offsets = points[:, None] - sites
    if mask.shape == Disc():
        inside = np.linalg.norm(offsets, axis=-1) < mask.subaperture_diameter
    else:
        angles = mask.shape.orientation + np.arange(3) * np.pi / 3
        across = offsets @ np.stack([np.cos(angles), np.sin(angles)])
        inside = np.abs(across).max(-1) < mask.subaperture_diameter
    share = inside.any(1).mean()
    area = share * (2 * half_width) ** 2
    error = math.sqrt(share * (1 - share) / n) * (2 * half_width) ** 2
    expected = analyse_redundancy(mask).uv_filling * math.pi * mask.mask_diameter**2
    assert abs(area - expected) < 4 * error


coordinate = st.floats(-1, 1).map(lambda value: round(value, 3))


@given(st.lists(st.tuples(coordinate, coordinate), min_size=3, max_size=6, unique=True))
@settings(max_examples=40, derandomize=True, deadline=None)
def test_largest_empty_circle_against_a_grid(points):
    points = np.array(points)
    sites = np.concatenate([points, -points])
    if np.linalg.matrix_rank(sites, tol=1e-2) < 2:
        return
    found = redundancy._largest_empty_circle(sites)
    axis = np.linspace(-1, 1, 161)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    grid = grid[Delaunay(sites, qhull_options="QJ").find_simplex(grid) >= 0]
    edges = np.concatenate([grid, sites])
    best = np.linalg.norm(edges[:, None] - sites[None], axis=-1).min(1).max()
    # The grid has a point within one diagonal of the best centre, unless the hull is thinner than that.
    assert best - 1e-6 <= found <= best + 2 * (axis[1] - axis[0])


def airy(x):
    return (2 * j1(np.pi * x) / (np.pi * x)) ** 2


def test_psf_width_of_two_holes():
    """Along the baseline the fringe decides, cos^2 = 1/2 at a quarter fringe; across it the hole, 1.0290 / d."""
    baseline, hole = 1.0, 0.01
    report = analyse_redundancy(mask_of([[-0.5, 0], [0.5, 0]], hole, 2.0))
    # The envelope narrows the fringe by a relative order (d / B)^2.
    assert report.fwhm_min == pytest.approx(2.0 / (2 * baseline), rel=(hole / baseline) ** 2)
    assert report.fwhm_max == pytest.approx(2.0 * 1.0289940 / hole, rel=1e-6)
    assert report.fwhm_min < report.fwhm < report.fwhm_max


def test_psf_width_is_that_of_a_disc_with_the_area_above_half_maximum():
    """In polar coordinates the area is the mean square of the radius; of two holes it ends at a root along each ray."""
    baseline, hole = 0.5, 0.3
    report = analyse_redundancy(mask_of([[-0.25, 0], [0.25, 0]], hole, 2.0))

    def radius(angle):
        fringe = math.pi * baseline * math.cos(angle)
        return brentq(lambda f: airy(hole * f) * math.cos(fringe * f) ** 2 - 0.5, 1e-6, 1.03 / hole)

    radii = np.array([radius(angle) for angle in np.arange(180) * math.pi / 180])
    assert report.fwhm == pytest.approx(2.0 * 2 * math.sqrt(np.mean(radii**2)), rel=1e-9)
    assert np.mean(radii) < 0.95 * math.sqrt(np.mean(radii**2))


@dataclasses.dataclass(frozen=True)
class Slit(Polygon):
    """A fifth as wide along y as along x."""

    name = "slit"

    def strips(self):
        return (0.0, 1.0), (math.pi / 2, 0.2)


def test_psf_width_of_holes_narrower_than_their_diameter():
    """Across the baseline sinc^2 = 1/2 at 0.44295 over the width of a slit, far beyond that of a round hole."""
    report = analyse_redundancy(SparseAperture([[-0.4, 0.0], [0.4, 0.0]], 0.1, 1.0, shape=Slit()))
    assert report.fwhm_max == pytest.approx(2 * 0.4429465 / (0.2 * 0.1), rel=1e-6)
    assert report.fwhm_min == pytest.approx(1 / (2 * 0.8), rel=(0.1 / 0.8) ** 2)


def test_side_lobe_of_two_holes():
    baseline, hole = 1.0, 0.3
    report = analyse_redundancy(mask_of([[-0.5, 0], [0.5, 0]], hole, 2.0))
    fringe = minimize_scalar(
        lambda f: -airy(hole * f) * np.cos(np.pi * baseline * f) ** 2,
        bounds=(0.6, 1.2),
        method="bounded",
        options={"xatol": 1e-10},
    )
    assert report.side_lobe == pytest.approx(-fringe.fun, rel=1e-8)


def test_side_lobe_of_a_triangle_is_its_grating_lobe():
    """Golay-3 repeats its peak on the reciprocal lattice, at 2 / (sqrt(3) pitch) under the envelope of the hole."""
    hole = 0.02
    report = analyse_redundancy(mask_of(catalog.entry("golay3").centers, hole, 1.2))
    assert report.side_lobe == pytest.approx(airy(hole * 2 / math.sqrt(3)), rel=(hole * 2) ** 3)


@pytest.mark.parametrize(("shape", "bound"), [(Disc(), 0.0042), (Hexagon(0.1), 0.0092), (Square(0.1), 0.0163)], ids=str)
def test_no_lobe_beyond_the_region_searched_exceeds_the_bound(shape, bound):
    axis = np.arange(-24, 24, 0.05)
    plane = np.stack(np.meshgrid(axis, axis), axis=-1)
    envelope = shape.amplitude(plane, 1.0) ** 2
    outside = envelope[np.abs(plane).max(-1) > 2.5].max()
    assert 0.5 * bound < outside < bound
    if shape == Disc():
        assert envelope[480, 480 + 20 * 1] == pytest.approx(airy(1.0), rel=1e-12)
        assert shape.amplitude(np.array([jn_zeros(1, 1)[0] / np.pi, 0]), 1.0) == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("shape", [Disc(), Hexagon(math.pi / 6), Square(0.2)], ids=str)
def test_closed_form_of_the_psf_against_the_fourier_transform(shape):
    """The sampled pupil converges to the closed form as its raster grows finer."""
    mask = SparseAperture.from_catalog("niriss").replace(shape=shape)
    errors = []
    for n in (128, 256):
        grid = Grid.nyquist(mask.extent, 1e-6, n)
        psf = psf_from_samples(mask.samples(grid)).numpy()
        k = np.fft.fftfreq(n, 1 / n)[:, None]
        frequency = np.stack(np.broadcast_arrays(k.T, k), axis=-1) / grid.period
        expected = psf_shape.mask_psf(frequency, mask.centers.numpy(), mask)
        near = (np.abs(k) < 20) & (np.abs(k.T) < 20)
        errors.append(np.abs(psf / psf[0, 0] - expected)[near].max())
    assert errors[0] < 0.03
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize("name", ["niriss", "keck_nirc2_9", "gpi"])
def test_width_and_side_lobe_against_a_finely_sampled_psf(name):
    mask = SparseAperture.from_catalog(name)
    report = analyse_redundancy(mask)
    n = math.ceil(20 * 2.5 * mask.extent / mask.subaperture_diameter)
    axis = np.arange(-n, n + 1) / (20 * mask.extent)  # 20 samples a fringe
    plane = np.stack(np.meshgrid(axis, axis[n - 40 :]), axis=-1)
    psf = psf_shape.mask_psf(plane, mask.centers.numpy(), mask)
    inner = psf[1:-1, 1:-1]
    neighbours = np.stack(
        [
            psf[1 + i : psf.shape[0] - 1 + i, 1 + j : psf.shape[1] - 1 + j]
            for i in (-1, 0, 1)
            for j in (-1, 0, 1)
            if i or j
        ]
    )
    maxima = inner[(inner > neighbours.max(0)) & (inner < 1)]
    # A maximum between samples is higher by at most the PSF's curvature over half a step, (pi extent step)^2 / 2.
    assert maxima.max() <= report.side_lobe <= maxima.max() + (math.pi / 20) ** 2
    core = psf >= 0.5
    core &= np.linalg.norm(plane, axis=-1) < report.fwhm_max / mask.mask_diameter
    area = core.sum() * (axis[1] - axis[0]) ** 2
    width = 2 * math.sqrt(area / math.pi) * mask.mask_diameter
    assert report.fwhm == pytest.approx(width, rel=0.04)


@given(st.integers(0, 1000), st.floats(0.2, 5), st.sampled_from(["disc", "hexagon", "square"]))
@settings(max_examples=8, derandomize=True, deadline=None)
def test_size_and_side_do_not_matter(seed, scale, shape):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-0.5, 0.5, (5, 2))
    report = analyse_redundancy(mask_of(points, 0.2, 1.0, shape=shape, orientation=0.2))
    other = mask_of(scale * points * [-1, 1], 0.2 * scale, scale, shape=shape, orientation=math.pi - 0.2)
    again = analyse_redundancy(other)
    for name, value in dataclasses.asdict(report).items():
        power = 1 if name in ("strict_hole_diameter", "shortest_baseline", "longest_baseline", "largest_gap") else 0
        # areas are sums over lines that cut the mirrored mask elsewhere; the side lobe is where a minimiser stopped
        loose = {"uv_filling": 1e-5, "gap_fraction": 1e-4, "side_lobe": 1e-6}.get(name, 1e-9)
        assert getattr(again, name) == pytest.approx(value * scale**power, rel=loose), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_prints_as_a_table(dtype):
    report = analyse_redundancy(SparseAperture.from_catalog("niriss", dtype=dtype))
    lines = str(report).splitlines()
    assert len(lines) == 12
    assert "21, 21 distinct" in lines[1]
    assert "1.32 m" in lines[5]
    assert len({line.index("  ", 12) for line in lines if len(line.split("  ")[0]) > 22}) <= 1


@pytest.mark.parametrize(
    ("mask", "tolerance", "message"),
    [
        (SparseAperture(torch.zeros(2, 3, 2), 0.1, 1.0), 0.02, "one mask of at least two holes"),
        (SparseAperture(torch.zeros(1, 2), 0.1, 1.0), 0.02, "one mask of at least two holes"),
        (FullAperture(1.0), 0.02, "one mask of at least two holes"),
        (SparseAperture(torch.zeros(2, 2), 0.1, 1.0), 0.02, "two holes lie at the same place"),
        (SparseAperture.from_catalog("gpi"), 1.0, "tolerance is 1.0"),
        (SparseAperture.from_catalog("gpi"), math.nan, "tolerance is nan"),
    ],
)
def test_bad_input_is_refused(mask, tolerance, message):
    with pytest.raises(ValueError, match=message):
        analyse_redundancy(mask, tolerance)
