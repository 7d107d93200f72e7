"""Pupils with the vanes of a spider: against closed areas, fine rasters and their FFT, and what is refused."""

import math

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.observation import Observation
from torchmask.optics.aperture import FullAperture
from torchmask.optics.detector import Detector
from torchmask.optics.otf import OTF, analytic_otf
from torchmask.optics.shapes import Annulus, Disc, TelescopePupil
from torchmask.simulation.exposures import simulate_observation

CROSS = (0.0, math.pi / 2, math.pi, 3 * math.pi / 2)
PUPILS = (
    TelescopePupil(0.2, 0.03, tuple(0.3 + angle for angle in CROSS)),
    TelescopePupil(0.14, 0.01, (0.0, 2.1, 4.2)),
    TelescopePupil(0.0, 0.05, (0.1, 0.1 + math.pi)),  # one bar right across
    TelescopePupil(0.1, 0.06, (0.2, 1.2, 1.9, 3.8)),  # two of them meet outside the obstruction
    TelescopePupil(0.3, 0.06, (1.0,)),
)
each_pupil = pytest.mark.parametrize("pupil", PUPILS, ids=repr)
N = 1200  # cells across the pupil


def raster(pupil: TelescopePupil) -> np.ndarray:
    """Whether the middles of N x N cells are open, for a diameter of 1."""
    axis = (np.arange(N) + 0.5) / N - 0.5
    x, y = np.meshgrid(axis, axis)
    r = np.hypot(x, y)
    open_ = (r < 0.5) & (r > pupil.obstruction / 2)
    for angle in pupil.vane_angles:
        along, across = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle)
        open_ &= (along < 0) | (np.abs(across) > pupil.vane_width / 2)
    return open_


def loss(pupil: TelescopePupil) -> float:
    """Standard deviation of an area counted in cells: those on an edge err by half of one each, independently."""
    length = math.pi * (1 + pupil.obstruction) + 2 * len(pupil.vane_angles)
    return 0.5 * math.sqrt(length * N) / N**2


def test_area_is_the_annulus_less_the_vanes():
    """Four vanes that meet behind the obstruction: strips between two circles, whose ends are arcs."""
    ring, width = 0.25, 0.02
    pupil = FullAperture(2.0, ring, width, CROSS)

    def segment(radius):  # from the centre to the circle, below half a width
        half = width / 2
        return half * math.sqrt(radius**2 - half**2) + radius**2 * math.asin(half / radius)

    expected = FullAperture(2.0, ring).area - 4 * (segment(1.0) - segment(ring))
    assert pupil.area == pytest.approx(expected, rel=1e-14)


@each_pupil
def test_area_and_overlap_are_those_of_a_raster_by_fft(pupil):
    """Two-sided, within five standard deviations of counting cells, along and across the vanes and anywhere."""
    cells = raster(pupil).astype(float)
    assert abs(cells.mean() - pupil.area(1.0)) < 5 * loss(pupil)
    power = np.abs(np.fft.rfft2(cells, s=(2 * N, 2 * N))) ** 2
    overlap = np.fft.irfft2(power, s=(2 * N, 2 * N)) / N**2
    steps = np.array([(0, 0), (300, 0), (0, 300), (3, -2), (-411, 250), (700, -600), (90, 1100), (40, 1)])
    found = pupil.otf(torch.from_numpy(steps / N), 1.0) * pupil.area(1.0)
    expected = overlap[steps[:, 1] % (2 * N), steps[:, 0] % (2 * N)]
    assert np.abs(found.numpy() - expected).max() < 5 * math.sqrt(2) * loss(pupil)


@each_pupil
def test_overlap_is_continuous_where_edges_coincide(pupil):
    """Copies moved along a vane have edges in common: the overlap changes there by no more than it moves."""
    angle, moved = pupil.vane_angles[0], 1e-6
    along = torch.tensor([math.cos(angle), math.sin(angle)], dtype=torch.float64)
    across = torch.stack([-along[1], along[0]])
    for length in (1e-3, 0.2, 0.5):
        shifts = length * along + moved * torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)[:, None] * across
        values = pupil.otf(shifts, 1.0)
        # an edge as long as the whole boundary
        slope = (2 * math.pi + 4 * len(pupil.vane_angles)) / pupil.area(1.0)
        assert float((values - values[1]).abs().max()) < slope * moved


@each_pupil
def test_means_over_the_open_area(pupil):
    """Positive weights, exact for polynomials at any degree, and moments of a raster."""
    cells = raster(pupil)
    y, x = (np.nonzero(cells)[k] / N - 0.5 + 0.5 / N for k in (0, 1))
    fine, shares = pupil.quadrature(24, 1.0)
    for a, b in ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (3, 1), (0, 6)):
        points, weights = pupil.quadrature(a + b, 1.0)
        assert float(weights.min()) > 0
        mean = float(weights @ (points[:, 0] ** a * points[:, 1] ** b))
        assert mean == pytest.approx(float(shares @ (fine[:, 0] ** a * fine[:, 1] ** b)), abs=1e-14)
        assert abs((x**a * y**b).mean() - mean) < 10 * loss(pupil) / pupil.area(1.0) * 2.0 ** -(a + b)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_sampled_otf_tends_to_the_overlap(dtype):
    """As for a ring, the cone's tip is blunt by up to 0.15 of the step times its slope, the perimeter over the area."""
    pupil = FullAperture(1.0, 0.3, 0.02, tuple(0.4 + angle for angle in CROSS), dtype=dtype)
    grid = Grid.nyquist(1.0, 550e-9, 24, 1.01)
    exact = analytic_otf(pupil, grid)
    assert exact.real.dtype == dtype
    slope = (math.pi * 1.3 + 8 * 0.35) / pupil.area
    for oversampling in (2, 8):
        error = float((OTF(pupil, grid, oversampling)() - exact).abs().max())
        assert error < 0.15 * slope / (24 * oversampling)


def test_vanes_take_light_and_send_it_into_spikes():
    grid = Grid.nyquist(1.0, 550e-9, 48)
    star = torch.zeros(48, 48, dtype=torch.float64)
    star[24, 24] = 1.0
    psfs = [
        simulate_observation(star, pupil, grid, None, Detector(), n_frames=1).psfs[0]
        for pupil in (FullAperture(1.0, 0.2), FullAperture(1.0, 0.2, 0.04, CROSS))
    ]
    spiked = psfs[1] - psfs[0]
    axes = torch.cat([spiked[24, 34:44], spiked[34:44, 24]])
    diagonal = torch.stack([spiked[24 + k, 24 + k] for k in range(8, 18)])
    assert float(axes.mean()) > 10 * float(diagonal.abs().mean())


def test_full_pupils_come_back_from_files(tmp_path):
    grid = Grid.nyquist(2.0, 550e-9, 8)
    for angles in (CROSS, (0.3,)):
        pupil = FullAperture(2.0, 0.25, 0.03, angles, dtype=torch.float32)
        Observation(torch.ones(2, 8, 8), pupil, grid, 1.0).save(tmp_path / f"{len(angles)}.npz")
        back = Observation.load(tmp_path / f"{len(angles)}.npz").aperture
        assert isinstance(back, FullAperture)
        assert (back.shape, back.vane_width, back.vane_angles) == (pupil.shape, pupil.vane_width, pupil.vane_angles)
        assert repr(back) == repr(pupil)
        assert back.centers.dtype == torch.float32


def test_without_vanes_nothing_changes():
    assert (FullAperture(1.0).shape, FullAperture(1.0, 0.2).shape) == (Disc(), Annulus(0.2))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.2, 0.01, ()), "vanes need both"),
        ((0.2, 0.0, CROSS), "vanes need both"),
        ((0.2, -0.01, CROSS), "vane_width is -0.01"),
        ((0.2, 0.01, (0.0, math.nan)), "at least one finite angle"),
        ((0.2, 0.1, (0.0, 0.1)), "vanes 5.73 degrees apart"),
        ((0.2, 0.1, (0.0, 2 * math.pi)), "leave no opening"),
        ((0.0, 0.1, (0.0, 0.5)), "wider than the central obstruction"),
        ((1.0, 0.1, CROSS), "central_obstruction is 1.0"),
    ],
)
def test_impossible_vanes_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        FullAperture(1.0, *arguments)
