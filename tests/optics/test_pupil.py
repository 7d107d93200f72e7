import math

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import nn

from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.pupil import Aperture

WAVELENGTH = 550e-9
GRID = Grid.nyquist(1.0, WAVELENGTH, 64)
TRIANGLE = [[0.0, 0.4], [0.3, -0.2], [-0.3, -0.2]]


def sampled_area(aperture: Aperture, grid: Grid, oversampling: int) -> float:
    samples = aperture.samples(grid, oversampling)
    return float(samples.weights.sum()) * samples.step[0] * samples.step[1]


def rotated_mean(values):
    return float(np.mean(np.abs(values)))


@pytest.mark.parametrize(("shape", "edge"), [("disc", 2.0), ("hexagon", 0.0)])
def test_sampled_area_is_the_geometric_area(shape, edge):
    """A straight edge is exact. A disc's edge bows by step^2 / (8 r) in a cell: relative area (step / d)^2 / 3."""
    generator = torch.Generator().manual_seed(0)
    for oversampling in (1, 2, 4):
        errors = []
        for _ in range(20):
            center = 0.1 * torch.rand(1, 2, generator=generator, dtype=torch.float64)
            orientation = float(torch.rand((), generator=generator))
            aperture = SparseAperture(center, 0.3, 1.0, shape, orientation)
            errors.append(sampled_area(aperture, GRID, oversampling) / aperture.area - 1)
        relative_step = GRID.period / (64 * oversampling) / 0.3
        # Corners of the hexagon: six cells each of which misjudges at most a twelfth of its area.
        corners = 0 if shape == "disc" else 6 / 12 / 0.866
        assert rotated_mean(errors) < (corners + edge / 3) * relative_step**2


def test_full_aperture_with_obstruction_has_its_area():
    aperture = FullAperture(0.9, 0.3)
    assert aperture.area == pytest.approx(math.pi / 4 * 0.81 * (1 - 0.09), rel=1e-14)
    assert sampled_area(aperture, GRID, 8) == pytest.approx(aperture.area, rel=1e-4)


def test_a_cell_is_open_by_the_fraction_a_straight_edge_leaves():
    """The weights of a hexagon near the middle of a side, against a count of fine points."""
    aperture = SparseAperture([[0.013, -0.007]], 0.3, 1.0, "hexagon", orientation=0.4)
    samples = aperture.samples(GRID)
    fine = (torch.arange(200, dtype=torch.float64) + 0.5) / 200 - 0.5
    dy, dx = samples.step
    points = samples.offsets[0, :, None, None, :] + torch.stack(
        torch.meshgrid(fine * dx, fine * dy, indexing="ij"), dim=-1
    )
    angles = 0.4 + torch.arange(6) * math.pi / 3
    normals = torch.stack([angles.cos(), angles.sin()], -1).double()
    inside = ((points[..., None, :] * normals).sum(-1) < 0.15).all(-1).double().mean((-2, -1))
    corners = (
        0.15 / math.cos(math.pi / 6) * torch.stack([(angles + math.pi / 6).cos(), (angles + math.pi / 6).sin()], -1)
    )
    away = torch.cdist(samples.offsets[0], corners.double()).amin(-1) > math.hypot(dx, dy)
    error = (samples.weights[0] - inside).abs()[away]
    assert ((inside > 0.1) & (inside < 0.9))[away].sum() > 10  # edges are among them
    # An edge passes about 200 of the 200^2 points, each of which is wrong by at most a half.
    assert error.max() < 1.5 / 200


def test_samples_lie_on_the_raster():
    aperture = SparseAperture(TRIANGLE, 0.25, 1.0)
    samples = aperture.samples(GRID, 2)
    position = (aperture.centers[:, None] + samples.offsets) / torch.tensor([samples.step[1], samples.step[0]])
    whole = position.round()
    assert (position - whole).abs().max() < 1e-12
    rows, columns = samples.raster
    assert torch.equal(samples.index, ((whole[..., 1] % rows) * columns + whole[..., 0] % columns).long())


def test_rows_are_y_and_columns_are_x():
    grid = Grid((64, 128), GRID.pixel_scale, WAVELENGTH)
    samples = SparseAperture([[0.25, -0.125]], 0.2, 1.0).samples(grid)
    assert samples.raster == (64, 128)
    assert samples.step == (grid.period / 64, grid.period / 128)
    pupil = (
        torch.zeros(64 * 128, dtype=torch.float64).scatter_add(0, samples.index[0], samples.weights[0]).view(64, 128)
    )
    row, column = np.unravel_index(int((pupil == 1).to(torch.int8).argmax()), pupil.shape)
    y, x = np.fft.fftfreq(64)[row] * grid.period, np.fft.fftfreq(128)[column] * grid.period
    assert math.hypot(x - 0.25, y + 0.125) < 0.1


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    x=st.floats(-0.3, 0.3), y=st.floats(-0.3, 0.3), shape=st.sampled_from(["disc", "hexagon"]), angle=st.floats(0, 6.3)
)
@example(x=0.0, y=8.552064288643836e-160, shape="disc", angle=0.0)  # whose square underflows
def test_weights_are_fractions_and_move_by_whole_samples(x, y, shape, angle):
    aperture = SparseAperture([[x, y]], 0.25, 1.0, shape, angle)
    samples = aperture.samples(GRID)
    # Three squares of up to (a + b)^2 over 2 a b, b counting as 1e-4 a at least: each rounds by 2^-53 of 5e3.
    rounding = 3 * 5e3 * 2**-53
    assert float(samples.weights.min()) >= -rounding
    assert float(samples.weights.max()) <= 1 + rounding
    moved = SparseAperture([[x + 2 * samples.step[1], y]], 0.25, 1.0, shape, angle).samples(GRID)
    # Each has that rounding, and the centre 1 ulp of 0.3 m over a step of 0.03 m, times the slope of a weight.
    assert (moved.weights - samples.weights).abs().max() < 2 * rounding


def test_weights_are_differentiable_also_where_a_sample_is_the_centre():
    on_a_sample = torch.zeros(1, 2, dtype=torch.float64, requires_grad=True)
    between = torch.tensor([[0.011, -0.2]], dtype=torch.float64, requires_grad=True)
    for shape in ("disc", "hexagon"):
        for center in (on_a_sample, between):
            # 0.27 m puts no kink of the ramp on a sample when the centre is one.
            assert torch.autograd.gradcheck(
                lambda c, s=shape: SparseAperture(c, 0.27, 1.0, s, 0.1).samples(GRID).weights, center
            )


def test_population_equals_its_members():
    generator = torch.Generator().manual_seed(1)
    centers = 0.3 * torch.rand(4, 3, 2, generator=generator, dtype=torch.float64)
    together = SparseAperture(centers, 0.2, 1.0).samples(GRID)
    for k in range(4):
        alone = SparseAperture(centers[k], 0.2, 1.0).samples(GRID)
        assert torch.equal(together.weights[k], alone.weights)
        assert torch.equal(together.index[k], alone.index)


def test_extent_reaches_from_outer_edge_to_outer_edge():
    assert SparseAperture([[0.0, 0.0], [0.3, 0.4]], 0.1, 1.0).extent == pytest.approx(0.6, rel=1e-15)
    assert FullAperture(0.7).extent == 0.7


def test_reach_is_the_distance_of_the_outermost_edge():
    assert SparseAperture([[0.1, 0.0], [0.3, 0.4]], 0.1, 1.0).reach == pytest.approx(0.55, rel=1e-15)
    hexagon = SparseAperture([[0.3, 0.0]], 0.1, 1.0, "hexagon", math.pi / 6)  # a corner on +x
    assert hexagon.reach == pytest.approx(0.3 + 0.1 / math.sqrt(3), rel=1e-15)


def test_a_full_pupil_is_a_single_opening():
    assert FullAperture(1.0).is_full
    assert SparseAperture([[0.1, 0.0]], 0.1, 1.0).is_full
    assert not SparseAperture(TRIANGLE, 0.1, 1.0).is_full


@pytest.mark.parametrize("kind", ["buffer", "parameter", "result"])
def test_a_still_copy_stays_while_the_mask_moves(kind):
    centers = torch.tensor(TRIANGLE)
    if kind == "parameter":
        centers = nn.Parameter(centers)
    if kind == "result":
        centers = 2 * centers.requires_grad_()
    mask = SparseAperture(centers, 0.1, 1.0, "hexagon", 0.2)
    still = mask.still()
    before = mask.centers.detach().clone()
    with torch.no_grad():
        mask.centers += 1.0
    assert torch.equal(still.centers, before)
    assert not still.centers.requires_grad
    assert isinstance(still.centers, nn.Parameter) == (kind == "parameter")
    assert (still.shape, still.subaperture_diameter, still.mask_diameter) == (mask.shape, 0.1, 1.0)
    assert isinstance(FullAperture(1.0, 0.2).still(), FullAperture)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_is_that_of_the_centers(dtype):
    aperture = SparseAperture(torch.tensor(TRIANGLE, dtype=dtype), 0.2, 1.0)
    assert aperture.samples(GRID).weights.dtype == dtype
    assert FullAperture(0.7, dtype=dtype).samples(GRID).weights.dtype == dtype


def test_impossible_sampling_is_refused():
    aperture = SparseAperture(TRIANGLE, 0.05, 1.0)
    with pytest.raises(
        ValueError, match=r"take an image at least (\d\.\d+) times as wide or oversampling of at least 2$"
    ) as told:
        aperture.samples(GRID)
    wider = float(str(told.value).split("image at least ")[1].split()[0])
    aperture.samples(Grid(math.ceil(wider * 64), GRID.pixel_scale, WAVELENGTH))
    with pytest.raises(ValueError, match="at least 2 are needed"):
        aperture.samples(Grid(math.floor((wider - 0.01) * 64), GRID.pixel_scale, WAVELENGTH))
    aperture.samples(GRID, 2)
    for oversampling in (0, 1.5):
        with pytest.raises(ValueError, match="oversampling"):
            aperture.samples(GRID, oversampling)
    with pytest.raises(ValueError, match="pixel_scale must be at most"):
        FullAperture(1.2).samples(GRID)
