"""Laws that every hole shape obeys, and what the shapes at hand are beyond them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from torch import Tensor

from torchmask.design.criterion import AsymptoticMSE
from torchmask.design.drawing import save_dxf, save_svg
from torchmask.design.manufacture import load_mask, save_fits, save_json
from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.round import disc_otf
from torchmask.optics.shape_base import Shape
from torchmask.optics.shapes import (
    Annulus,
    Circle,
    Contour,
    Corners,
    Disc,
    Hexagon,
    Polygon,
    Square,
    TelescopePupil,
    named_shape,
)
from torchmask.optics.zernike import aperture_modes

WIDTH = 0.7  # of the holes [m]


@dataclass(frozen=True)
class Rectangle(Polygon):
    """A shape that the library does not know: `aspect` times as long as it is wide."""

    name = "rectangle"

    aspect: float = 1.5

    def strips(self):
        return (0.0, 1.0), (math.pi / 2, self.aspect)

    @classmethod
    def from_outline(cls, outline, tolerance):
        if len(outline) != 1 or len(getattr(outline[0], "points", ())) != 4:
            return None
        a, b, c, _ = outline[0].points
        normal, length, width = (a + b) / 2, math.dist(a, b), math.dist(b, c)
        found = cls(math.atan2(normal[1], normal[0]), length / width)
        return (found, width) if np.abs(found.outline(width)[0].points - outline[0].points).max() < tolerance else None


SHAPES = (
    Disc(),
    Annulus(0.3),
    Hexagon(0.2),
    Square(0.4),
    Rectangle(0.3, 1.5),
    TelescopePupil(0.3, 0.04, (0.3, 1.7, 3.9)),
)
each_shape = pytest.mark.parametrize("shape", SHAPES, ids=str)
# Vanes end on arcs, which no outline holds: tests/optics/test_telescope_pupil.py compares them with rasters.
each_outlined = pytest.mark.parametrize("shape", SHAPES[:-1], ids=str)


def test_the_registry_is_complete():
    ours = {kind for kind in Shape.known.values() if kind.__module__.startswith("torchmask.")}
    assert {type(shape) for shape in SHAPES} - {Rectangle} == ours


def test_a_shape_is_one_class_of_at_most_eighty_lines():
    for shape in SHAPES[1:]:  # the disc came first, with what round shapes share
        assert len(inspect.getsource(type(shape)).splitlines()) <= 80, shape


# ---- what holes are, from their outlines alone

Interval = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def crossing(contour: Contour) -> Interval:
    """Where horizontal lines enter and leave what a contour holds; equal where they miss it."""

    def of_circle(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        half = np.sqrt(np.clip(contour.radius**2 - y**2, 0, None))
        return -half, half

    def of_polygon(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        left, right = np.full_like(y, np.inf), np.full_like(y, -np.inf)
        for a, b in zip(contour.points, np.roll(contour.points, -1, axis=0), strict=True):
            share = (y - a[1]) / (b[1] - a[1])
            x = a[0] + share * (b[0] - a[0])
            on = (share >= 0) & (share <= 1)
            left, right = np.where(on, np.minimum(left, x), left), np.where(on, np.maximum(right, x), right)
        return np.where(left < right, left, 0), np.where(left < right, right, 0)

    return of_circle if isinstance(contour, Circle) else of_polygon


def lines(shape: Shape, n: int = 40_001) -> tuple[np.ndarray, float]:
    """Heights of lines across a hole and its copies, and their distance."""
    reach = 1.2 * shape.outer_diameter(WIDTH)
    y, step = np.linspace(-reach, reach, n, retstep=True)
    return y, float(step)


def integral(shape: Shape, function: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]) -> float:
    """Of `function(y, left, right)`, an integral along x, over the open area."""
    y, step = lines(shape)
    signs = [1, *[-1] * (len(shape.outline(WIDTH)) - 1)]
    parts = [function(y, *crossing(contour)(y)).sum() for contour in shape.outline(WIDTH)]
    return float(np.dot(signs, parts) * step)


def overlap(shape: Shape, shift: tuple[float, float]) -> float:
    """Area that a hole shares with its copy, line by line."""
    y, step = lines(shape)
    total = 0.0
    for i, first in enumerate(shape.outline(WIDTH)):
        for k, second in enumerate(shape.outline(WIDTH)):
            left, right = crossing(first)(y)
            other_left, other_right = (x + shift[0] for x in crossing(second)(y - shift[1]))
            shared = np.clip(np.minimum(right, other_right) - np.maximum(left, other_left), 0, None).sum() * step
            total += shared * (-1 if (i > 0) != (k > 0) else 1)
    return total


def edge_points(shape: Shape) -> np.ndarray:
    """Points on the outer edge: corners, or so many that the farthest is missed by 1e-8 of the radius."""
    contour = shape.outline(WIDTH)[0]
    if isinstance(contour, Corners):
        return contour.points
    angle = np.linspace(0, 2 * math.pi, 40_000)
    return contour.radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def random_points(*size: int, scale: float = 1.0, seed: int = 0) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return scale * (torch.rand(*size, 2, generator=generator, dtype=torch.float64) - 0.5)


def rotation(angle: float) -> Tensor:
    return torch.tensor([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]], dtype=torch.float64)


# ---- area and edges


@each_outlined
def test_the_outline_encloses_the_area(shape):
    areas = []
    for contour in shape.outline(WIDTH):
        if isinstance(contour, Circle):
            areas.append(math.pi * contour.radius**2)
        else:
            x, y = contour.points.T
            areas.append(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2)
    assert all(area > 0 for area in areas)  # counterclockwise
    assert areas[0] - sum(areas[1:]) == pytest.approx(shape.area(WIDTH), rel=1e-14)


@each_shape
def test_the_circle_around_it_just_holds_the_hole(shape):
    assert 2 * np.linalg.norm(edge_points(shape), axis=-1).max() == pytest.approx(
        shape.outer_diameter(WIDTH), rel=1e-14
    )


@each_shape
def test_coverage_sums_to_the_area(shape):
    """Two-sided, and falling with the square of the step: a straight edge is exact.

    An arc bows by step^2 / (8 r) in a cell, which leaves pi step^2 / 12 along a circle, counted twice for slanting
    cells; in a cell with a corner the product of two fractions is off by at most a quarter.
    """
    contours = shape.outline(WIDTH)
    loss = sum(math.pi / 6 if isinstance(contour, Circle) else len(contour.points) / 4 for contour in contours)
    for n in (12, 24, 48):
        step = WIDTH / n
        axis = torch.arange(-n, n + 1, dtype=torch.float64) * step
        raster = torch.cartesian_prod(axis, axis)
        errors = []
        for place in step * random_points(20):
            weights = shape.coverage(raster - place, torch.tensor([step, step], dtype=torch.float64), WIDTH)
            assert float(weights.min()) > -1e-12
            assert float(weights.max()) < 1 + 1e-12
            errors.append(abs(float(weights.sum()) * step**2 - shape.area(WIDTH)))
        assert np.mean(errors) < loss * step**2


@each_shape
def test_coverage_is_differentiable_also_at_the_centre(shape):
    offsets = torch.cat([torch.zeros(1, 2, dtype=torch.float64), random_points(30, scale=1.2 * WIDTH)]).requires_grad_()
    cell = torch.tensor([0.05, 0.04], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: shape.coverage(x, cell, WIDTH), offsets)


# ---- transfer


@each_outlined
def test_otf_is_the_area_that_a_hole_shares_with_its_copy(shape):
    for shift in (
        (0.0, 0.0),
        (0.1, 0.05),
        (-0.3, 0.2),
        (0.0, 0.45),
        (0.2, -0.5),
        (0.52, 0.31),
        (-0.7, 0.0),
        (2.0, 0.0),
    ):
        value = float(shape.otf(torch.tensor(shift, dtype=torch.float64), WIDTH))
        # the trapezoidal rule over 4e4 lines, with the vertical tangents of circles and kinks at corners
        assert value == pytest.approx(overlap(shape, shift) / shape.area(WIDTH), abs=1e-6), shift


@each_shape
def test_otf_is_differentiable(shape):
    shift = random_points(40, scale=2 * WIDTH, seed=1).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: shape.otf(x, WIDTH), shift)


@each_shape
def test_otf_at_its_tip_and_at_its_edge(shape):
    """A cone's tip and, for straight sides, a kink at the edge: finite gradients, and 0 where both sides differ."""
    tip = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    value = shape.otf(tip, WIDTH)
    value.backward()
    assert float(value.detach()) == pytest.approx(1, abs=1e-15)
    assert tip.grad.tolist() == [0.0, 0.0]
    direction = torch.tensor([math.cos(0.3), math.sin(0.3)], dtype=torch.float64)
    touching = WIDTH / float(shape.separation(direction))  # copies that far apart touch
    edge = (touching * direction).requires_grad_()
    value = shape.otf(edge, WIDTH)
    value.backward()
    # what rounding leaves of a linear fall
    assert float(value.detach()) == pytest.approx(0, abs=1e-14)
    assert torch.isfinite(edge.grad).all()
    inside = (touching * (1 - 1e-9) * direction).requires_grad_()
    shape.otf(inside, WIDTH).backward()
    assert float(edge.grad.norm()) <= float(inside.grad.norm()) * (1 + 1e-6)
    assert float(shape.otf((1 + 1e-9) * edge.detach(), WIDTH)) == 0


@each_shape
def test_patches_are_the_squared_otf_with_its_derivative(shape):
    x, y = torch.linspace(-1.3, 1.2, 37, dtype=torch.float64), torch.linspace(-1.1, 1.4, 33, dtype=torch.float64)
    shift = torch.tensor([[0.013, -0.02], [0.3, 0.1]], dtype=torch.float64, requires_grad=True)
    columns, rows = (x + shift[:, :1])[:, None, :], (y + shift[:, 1:])[:, :, None]
    expected = shape.otf(torch.stack(torch.broadcast_tensors(columns, rows), -1), 1.0) ** 2
    weight = torch.rand(expected.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (slope,) = torch.autograd.grad((weight * expected).sum(), shift)
    patches = shape.patches(torch.float64, torch.device("cpu"))
    value, pullback = patches(columns.detach(), rows.detach(), differentiate=True)
    assert (value - expected).abs().max() < 1e-12  # of the series of a disc
    torch.testing.assert_close(pullback(weight), slope, rtol=1e-9, atol=1e-9)
    alone, _ = patches(columns.detach(), rows.detach(), differentiate=False)
    torch.testing.assert_close(alone, value, rtol=1e-13, atol=1e-16)


@each_shape
def test_amplitude_is_the_fourier_transform(shape):
    frequency = np.array([[0.0, 0.0], [1e-9, 0.0], [0.7, -0.2], [2.0, 1.0], [-1.5, 3.0], [0.0, 4.0]])
    nodes, weights = shape.quadrature(60, WIDTH)
    waves = torch.exp(-2j * math.pi * (torch.from_numpy(frequency) @ nodes.T))
    expected = (weights * waves).sum(-1)
    np.testing.assert_allclose(shape.amplitude(frequency, WIDTH), expected.numpy(), rtol=0, atol=1e-12)


@each_shape
def test_criterion_is_the_sum_over_all_baselines(shape):
    """MSE_a by its equation, with the closed form of the OTF over the whole grid."""
    grid, centers, n_frames = Grid.nyquist(1.0, 550e-9, 24), random_points(4, scale=0.7, seed=2), 5
    mask = SparseAperture(centers, 0.2, 1.0, shape)
    s_o, s_n = (
        10 ** torch.rand(24, 24, generator=torch.Generator().manual_seed(k), dtype=torch.float64) for k in (0, 1)
    )
    nu_y, nu_x = grid.frequencies(torch.float64)
    transfer = torch.zeros(24, 24, dtype=torch.float64)
    for m in range(4):
        for k in range(4):
            baseline = (centers[m] - centers[k]) / grid.period
            shift = torch.stack(torch.broadcast_tensors(nu_x - baseline[0], nu_y - baseline[1]), dim=-1)
            term = (shape.otf((shift - shift.round()) * grid.period, 0.2) / 4) ** 2
            transfer += term * (4 if m == k else 1)  # N^2 once, and not once for each hole
    expected = (s_o * s_n / (n_frames * s_o * transfer + s_n)).mean()
    assert float(AsymptoticMSE(grid, s_o, s_n, n_frames)(mask)) == pytest.approx(float(expected), rel=1e-11)


# ---- quadrature and modes


@each_outlined
@pytest.mark.parametrize("degree", [1, 4, 9])
def test_quadrature_is_exact_for_polynomials(shape, degree):
    nodes, weights = shape.quadrature(degree, WIDTH)
    fine_nodes, fine_weights = shape.quadrature(degree + 8, WIDTH)
    assert float(weights.min()) > 0
    for a in range(degree + 1):
        b = degree - a
        mean = float((weights * nodes[:, 0] ** a * nodes[:, 1] ** b).sum())
        scale = WIDTH**degree
        fine = float((fine_weights * fine_nodes[:, 0] ** a * fine_nodes[:, 1] ** b).sum())
        assert mean == pytest.approx(fine, abs=1e-14 * scale)
        by_lines = integral(
            shape, lambda y, left, right, a=a, b=b: y**b * (right ** (a + 1) - left ** (a + 1)) / (a + 1)
        )
        assert mean == pytest.approx(by_lines / shape.area(WIDTH), abs=1e-6 * scale)


@each_shape
def test_modes_are_orthonormal_over_the_open_area(shape):
    aperture = SparseAperture([[0.0, 0.0]], WIDTH, 2 * WIDTH, shape)
    nodes, weights = shape.quadrature(20, WIDTH)
    modes = aperture_modes(aperture, nodes, 21)
    gram = modes.T @ (weights[:, None] * modes)
    torch.testing.assert_close(gram, torch.eye(21, dtype=torch.float64), rtol=0, atol=1e-12)


# ---- gaps and rims


@each_outlined
def test_holes_nearer_than_their_separation_overlap(shape):
    for difference in random_points(12, scale=2.0, seed=3):
        diameter = float(shape.separation(difference))
        shift = tuple((difference * WIDTH / diameter).tolist())  # at which holes of WIDTH touch
        assert overlap(shape, tuple(1.001 * x for x in shift)) == 0
        # overlapping by 2 % of the difference, holes share at least a lens of that height
        assert overlap(shape, tuple(0.98 * x for x in shift)) > 1e-4 * shape.area(WIDTH)


@each_outlined
def test_the_gap_is_never_more_than_the_true_one(shape):
    points = edge_points(shape)[:: max(1, len(edge_points(shape)) // 400)]
    along = np.linspace(0, 1, 50)[:, None, None]
    side = (points + along * (np.roll(points, -1, axis=0) - points)).reshape(-1, 2)[::23]
    for difference in random_points(6, scale=4.0, seed=4):
        gap = float(shape.separation(difference)) - WIDTH
        if gap > 0:
            distance = np.linalg.norm(side[:, None] - (side[None] + difference.numpy()), axis=-1).min()
            assert gap < distance * (1 + 1e-3)


@each_shape
def test_gradient_parts_holes_at_the_same_place(shape):
    difference = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    shape.separation(difference).backward()
    assert 0.3 < float(difference.grad.norm()) < 2
    assert torch.autograd.gradcheck(shape.separation, random_points(10).requires_grad_())


@each_shape
def test_clearance_is_that_of_the_farthest_point(shape):
    centers = random_points(20, scale=2.0, seed=5)
    farthest = np.linalg.norm(centers.numpy()[:, None] + edge_points(shape), axis=-1).max(-1)
    expected = torch.from_numpy(1.5 - farthest)
    torch.testing.assert_close(shape.clearance(centers, WIDTH, 3.0), expected, rtol=0, atol=1e-7)
    assert torch.autograd.gradcheck(lambda c: shape.clearance(c, WIDTH, 3.0), centers.requires_grad_())


@each_shape
def test_no_centre_lies_beyond_the_center_radius(shape):
    radius = shape.center_radius(WIDTH, 3.0)
    angle = torch.linspace(0, 2 * math.pi, 20_001, dtype=torch.float64)
    direction = torch.stack([angle.cos(), angle.sin()], dim=-1)
    best = [float(shape.clearance(factor * radius * direction, WIDTH, 3.0).max()) for factor in (1 - 1e-4, 1 + 1e-9)]
    assert best[0] > 0 > best[1]  # the farthest place is where two corners touch the rim, between two of the directions


@each_shape
def test_chords_are_those_of_the_outer_edge(shape):
    turned = shape.turned(shape.askew)
    y = np.linspace(-1, 1, 999) * shape.outer_diameter(WIDTH)
    left, right = turned.chords(y, WIDTH)
    expected_left, expected_right = crossing(turned.outline(WIDTH)[0])(y)
    np.testing.assert_allclose(left, expected_left, rtol=0, atol=1e-13)
    np.testing.assert_allclose(right, expected_right, rtol=0, atol=1e-13)
    corners = edge_points(turned)
    sides = np.roll(corners, -1, axis=0) - corners
    if isinstance(turned.outline(WIDTH)[0], Corners):
        assert (np.abs(sides[:, 1]) > 0.2 * np.linalg.norm(sides, axis=-1)).all()  # none lies along x


# ---- turns, names, files


@each_shape
def test_turned_and_mirrored(shape):
    shift = random_points(50, scale=2 * WIDTH, seed=6)
    turned = shape.turned(0.4).otf(shift @ rotation(0.4).T, WIDTH)
    torch.testing.assert_close(turned, shape.otf(shift, WIDTH), rtol=0, atol=1e-14)
    mirrored = shape.mirrored().otf(shift * torch.tensor([-1.0, 1.0]), WIDTH)
    torch.testing.assert_close(mirrored, shape.otf(shift, WIDTH), rtol=0, atol=1e-14)
    assert shape.is_round == (shape.turned(0.4) == shape)


@each_shape
def test_a_name_and_parameters_say_it_all(shape):
    assert named_shape(shape.name, shape.parameters) == shape
    assert shape.plural.startswith(shape.name[:4])
    assert 0 < shape.fineness <= 1


def mask_of(shape: Shape, dtype: torch.dtype = torch.float64) -> SparseAperture:
    centers = torch.tensor([[0.0, 0.31], [0.3, -0.21], [-0.29, -0.18]], dtype=dtype)
    return SparseAperture(centers, 0.2 / 3, 4 / 3, shape)


@each_shape
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_files_give_back_every_bit(shape, dtype, tmp_path):
    mask = mask_of(shape, dtype)
    save_json(tmp_path / "a.json", mask)
    save_fits(tmp_path / "a.fits", mask)
    Observation(torch.ones(2, 8, 8), mask, Grid.nyquist(2.0, 550e-9, 8), 1.0).save(tmp_path / "a.npz")
    back = [
        load_mask(tmp_path / "a.json"),
        load_mask(tmp_path / "a.fits"),
        Observation.load(tmp_path / "a.npz").aperture,
    ]
    for aperture in back:
        assert torch.equal(aperture.centers, mask.centers)
        assert aperture.centers.dtype == dtype
        for name in ("shape", "subaperture_diameter", "mask_diameter"):
            assert getattr(aperture, name) == getattr(mask, name), name


@each_outlined
def test_drawings_come_back_as_they_are_drawn(shape, tmp_path):
    mask = mask_of(shape)
    save_dxf(tmp_path / "a.dxf", mask, scale=12.5)
    back = load_mask(tmp_path / "a.dxf")
    torch.testing.assert_close(back.centers, mask.centers, rtol=0, atol=1e-9)
    assert back.shape.name == shape.name
    assert back.shape.parameters == pytest.approx(shape.parameters, abs=1e-9)
    assert back.subaperture_diameter == pytest.approx(mask.subaperture_diameter, abs=1e-9)
    save_svg(tmp_path / "a.svg", mask)
    edges = sum((tmp_path / "a.svg").read_text().count(f"<{kind} ") for kind in ("circle", "polygon"))
    assert edges == 1 + 3 * len(shape.outline(1.0))  # the rim, and the edges of three holes


# ---- tensors


@each_shape
def test_float32_follows_within_rounding(shape):
    points, cell = random_points(200, scale=1.6 * WIDTH), torch.tensor([0.05, 0.04], dtype=torch.float64)
    calls = {
        "coverage": (lambda x: shape.coverage(x, cell.to(x), WIDTH), 1 / 0.04),
        "otf": (lambda x: shape.otf(x, WIDTH), 4 / WIDTH),
        "separation": (shape.separation, 1.5),
        "clearance": (lambda x: shape.clearance(x, WIDTH, 3.0), 1.5),
    }
    for name, (call, slope) in calls.items():
        single, double = call(points.float()), call(points.float().double())
        assert single.dtype == torch.float32, name
        # the rounding of places of half a metre, times the slope, and some operations more
        tolerance = torch.finfo(torch.float32).eps * (2 * slope + 20)
        assert float((single - double).abs().max()) < tolerance, name


@each_shape
def test_leading_axes_are_a_population(shape):
    points, cell = random_points(2, 3, 5, scale=WIDTH), torch.tensor([0.05, 0.04], dtype=torch.float64)
    for call in (
        lambda x: shape.coverage(x, cell, WIDTH),
        lambda x: shape.otf(x, WIDTH),
        shape.separation,
        lambda x: shape.clearance(x, WIDTH, 3.0),
    ):
        together = call(points)
        assert together.shape == (2, 3, 5)
        alone = torch.stack([call(point) for point in points.reshape(-1, 2)]).reshape(2, 3, 5)
        torch.testing.assert_close(together, alone, rtol=1e-14, atol=1e-15)


@each_shape
def test_shapes_map_and_differentiate_under_torch_func(shape):
    points, cell = random_points(7, scale=WIDTH, seed=8), torch.tensor([0.05, 0.04], dtype=torch.float64)
    for call in (
        lambda x: shape.coverage(x, cell, WIDTH),
        lambda x: shape.otf(x, WIDTH),
        shape.separation,
        lambda x: shape.clearance(x, WIDTH, 3.0),
    ):
        torch.testing.assert_close(torch.func.vmap(call)(points), call(points), rtol=1e-14, atol=1e-15)
        (gradient,) = torch.autograd.grad(call(leaf := points.clone().requires_grad_()).sum(), leaf)
        jacobian = torch.func.vmap(torch.func.jacrev(call))(points)
        torch.testing.assert_close(jacobian, gradient, rtol=1e-12, atol=1e-13)


# ---- closed values, and what is refused


def test_disc_otf_gradient_includes_the_degenerate_points():
    x = torch.tensor([0.01, 0.3, 0.99, 1.5], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(disc_otf, x, check_forward_ad=True)
    assert torch.autograd.gradgradcheck(disc_otf, x)
    edge = torch.tensor([0.0, 1.0], dtype=torch.float64, requires_grad=True)
    disc_otf(edge).sum().backward()
    assert edge.grad is not None
    assert edge.grad.tolist() == pytest.approx([-4 / math.pi, 0.0])


@pytest.mark.parametrize("hessian", [torch.autograd.functional.hessian, lambda f, x: torch.func.hessian(f)(x)])
def test_the_curvature_of_a_disc_otf_is_finite_at_its_edge(hessian):
    """The second derivative of T at 0 < x < 1 is (4 / pi) x / (1 - x^2)^(1/2), and 0 is taken where it is infinite."""
    x = torch.tensor([0.3, 0.8, 1.0, 1.5], dtype=torch.float64)
    expected = torch.where(x < 1, 4 / math.pi * x / (1 - x**2).abs().clamp(min=1e-9).sqrt(), 0)
    found = hessian(lambda x: disc_otf(x).sum(), x)
    torch.testing.assert_close(found, expected.diag(), rtol=1e-12, atol=0)


def test_a_thin_obstruction_changes_little_and_a_wide_one_leaves_a_ring():
    shift = random_points(50, scale=2.0)
    thin = Annulus(1e-3).otf(shift, 1.0) - Disc().otf(shift, 1.0)
    assert 0 < float(thin.abs().max()) < 4e-6  # twice the obstruction's share of the area, and what it rescales
    # A thin ring of radius R shares with its copy what lies around two crossings, at an angle 2 acos(s / 2 R).
    ring, s = Annulus(0.999), torch.tensor([0.6, 0.0], dtype=torch.float64)
    width = (1 - 0.999) / 2
    crossings = 2 * width**2 / math.sin(2 * math.acos(0.6))
    assert float(ring.otf(s, 1.0)) == pytest.approx(crossings / ring.area(1.0), rel=5e-3)


def test_squares_overlap_in_the_product_of_two_triangles():
    shift = random_points(50, scale=2.5)
    expected = (1 - (shift @ rotation(0.4)).abs()).clamp(min=0).prod(-1)
    torch.testing.assert_close(Square(0.4).otf(shift, 1.0), expected, rtol=0, atol=1e-15)


def test_names_tell_shapes_apart():
    def define():
        class Disc(Hexagon):
            name = "disc"

    with pytest.raises(ValueError, match="Disc is called 'disc' already"):
        define()
    assert Shape.known["disc"] is Disc


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Annulus(0.0), "obstruction is 0.0"),
        (lambda: Annulus(1.0), "obstruction is 1.0"),
        (lambda: Hexagon(math.inf), "orientation is inf"),
        (lambda: named_shape("star", {}), "shape is 'star': known shapes are"),
        (lambda: named_shape("annulus", {}), "needs obstruction"),
        (lambda: named_shape("annulus", {"obstruction": "wide"}), "could not convert"),
    ],
)
def test_impossible_shapes_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@dataclass(frozen=True)
class Enclosed(Polygon):
    """Any strips; without a name, so that no drawing is taken for it."""

    given: tuple[tuple[float, float], ...] = ()

    def strips(self):
        return self.given


@pytest.mark.parametrize(
    ("strips", "message"),
    [
        ([(0.0, 1.0)], r"Enclosed has the strips \[\(0\.0, 1\.0\)\]: at least two"),
        ([(0.0, 1.0), (1.5, -0.5)], "their widths must be finite and positive"),
        ([(0.0, math.nan), (1.5, 1.0)], "their widths must be finite and positive"),
        ([(0.0, 1.0), (0.0, 1.0)], "their angles must ascend from 0 to less than pi"),
        ([(0.0, 1.0), (math.pi, 1.0)], "their angles must ascend from 0 to less than pi"),
    ],
)
def test_strips_that_enclose_no_polygon_are_refused(strips, message):
    with pytest.raises(ValueError, match=message):
        Enclosed(given=strips)
