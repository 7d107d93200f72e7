"""Figures show what they were given, where it belongs, and leave no trace in pyplot."""

import itertools
import math
import os
import subprocess
import sys

import matplotlib
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Patch
from matplotlib.transforms import Affine2D

from torchmask.grid import Grid
from torchmask.metrics import align, lowpass, relative_error
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.optics.otf import OTF, analytic_otf
from torchmask.optics.psf import PSF
from torchmask.viz import figures as viz
from torchmask.viz import style as drawing
from torchmask.viz.comparison import comparison_figure

GRID = Grid.nyquist(diameter=1.0, wavelength=550e-9, n_pixels=64)
CENTERS = torch.tensor([[0.3, 0.1], [-0.35, 0.2], [0.05, -0.37]], dtype=torch.float64)


def mask(shape: str = "disc", dtype: torch.dtype = torch.float64, orientation: float = 0.2) -> SparseAperture:
    return SparseAperture(CENTERS.to(dtype), 0.2, 1.0, shape, orientation)


def rendered(figure: Figure) -> np.ndarray:
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())


def images(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(ax.images[0].get_array()) for ax in figure.axes if ax.images]


def contains(patch: Patch, points: torch.Tensor) -> np.ndarray:
    """Which points lie in a patch; enlarged, because matplotlib breaks curves into chords as if units were pixels."""
    enlarged = patch.get_patch_transform() + Affine2D().scale(1e4)
    return enlarged.transform_path(patch.get_path()).contains_points(1e4 * points.numpy())


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_the_mask_is_drawn_to_scale(shape, dtype):
    aperture = mask(shape, dtype)
    ax = viz.mask_figure(aperture).axes[0]
    disc, *holes = ax.patches
    assert isinstance(disc, Circle)
    assert disc.radius == 0.5
    assert len(holes) == 3
    for hole, center in zip(holes, CENTERS.tolist(), strict=True):
        assert np.allclose(hole.center if shape == "disc" else hole.xy[:-1].mean(0), center)
    # What is drawn open is what lets light through: the coverage of the pupil samples, cell by cell.
    samples = aperture.samples(GRID, 4)
    points = (samples.offsets + aperture.centers[:, None]).detach().double()
    for k, hole in enumerate(holes):
        inside = contains(hole, points[k])
        weights = samples.weights[k].double().numpy()
        assert inside[weights > 0.99].all()
        assert not inside[weights < 0.01].any()
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    assert ax.get_ylim()[0] < 0 < ax.get_ylim()[1]  # y upwards


def test_small_masks_are_in_millimetres_and_full_pupils_have_their_obstruction():
    small = SparseAperture(CENTERS * 0.01, 0.002, 0.01)
    ax = viz.mask_figure(small).axes[0]
    assert ax.get_xlabel() == "x [mm]"
    assert ax.patches[0].radius == pytest.approx(5)
    assert ax.get_title(loc="left") == "3 discs of 2 mm"
    full = viz.mask_figure(FullAperture(2.0, 0.25), title="telescope").axes[0]
    assert [patch.radius for patch in full.patches] == [1, 1, 0.25]
    assert full.get_title(loc="left") == "telescope"


@pytest.mark.parametrize("shape", ["disc", "hexagon", "square"])
def test_coverage_is_where_the_transfer_function_is(shape):
    aperture = mask(shape)
    ax = viz.uv_coverage_figure(aperture, GRID).axes[0]
    discs = ax.patches[:7]  # the centre and six baselines
    frequencies = torch.fft.fftfreq(64, dtype=torch.float64) * GRID.period
    points = torch.cartesian_prod(frequencies, frequencies)
    covered = np.zeros(len(points), dtype=bool)
    for disc in discs:
        covered |= contains(disc, points)
    baselines = (CENTERS[:, None] - CENTERS[None]).reshape(-1, 1, 2)
    shift, form = points[None] - baselines, aperture.shape
    overlap = form.otf(shift, 0.2).sum(0).numpy()
    assert covered[overlap > 1e-3].all()
    wider = form.otf(shift, 0.2 * 1.001).sum(0).numpy()  # matplotlib's circles are Bezier curves
    assert not covered[wider == 0].any()
    pairs = {tuple(np.round(a - b, 12)) for a, b in itertools.permutations(CENTERS.numpy(), 2)}
    assert {tuple(np.round(xy, 12)) for xy in ax.lines[0].get_xydata()} == pairs
    assert ax.get_title(loc="left") == "3 baselines"
    labels = [text.get_text() for text in ax.figure.legends[0].get_texts()]
    assert labels == ["pair of holes, in either order", "cut-off of the whole disc", "sampled by the grid"]


def test_psf_and_otf_have_their_origin_in_the_middle():
    for n in (64, 63):
        grid = Grid.nyquist(1.0, 550e-9, n)
        perfect = mask()
        psf = PSF(perfect, grid)()
        figure = viz.psf_figure({"mask": psf, "again": psf.float()}, grid)
        rendered(figure)
        (ax, *_), (shown, _) = figure.axes, images(figure)
        row, column = np.unravel_index(shown.argmax(), shown.shape)
        left, right, bottom, top = ax.images[0].get_extent()
        assert shown.max() == pytest.approx(1)
        assert left + (column + 0.5) * (right - left) / n == pytest.approx(0, abs=1e-9)
        assert top + (row + 0.5) * (bottom - top) / n == pytest.approx(0, abs=1e-9)
        assert bottom > top  # row 0 at the top, as in the array
        assert right - left == pytest.approx(n * grid.pixel_scale * math.degrees(1) * 3600)

        figure = viz.mtf_figure({"mask": OTF(perfect, grid)()}, grid)
        rendered(figure)
        (shown,), left_bottom = images(figure), figure.axes[0].images[0].get_extent()
        row, column = np.unravel_index(shown.argmax(), shown.shape)
        assert shown.max() == pytest.approx(1)
        assert figure.axes[0].images[0].origin == "lower"
        assert left_bottom[0] + (column + 0.5) / n == pytest.approx(0, abs=1e-12)
        assert left_bottom[2] + (row + 0.5) / n == pytest.approx(0, abs=1e-12)


def test_mtf_axes_agree_with_the_baselines():
    """The peak of a pair's fringe stands at its baseline, on both sides of the sign conventions."""
    pair = SparseAperture([[0.0, 0.0], [0.5, 0.25]], 0.2, 1.2)
    grid = Grid(64, 550e-9 / 2, 550e-9)  # one cycle per pixel is 2 m
    figure = viz.mtf_figure({"pair": analytic_otf(pair, grid)}, grid)
    shown = images(figure)[0].copy()
    left, right, bottom, _ = figure.axes[0].images[0].get_extent()
    assert right - left == 1
    centre = (math.floor(-left * 64), math.floor(-bottom * 64))
    y, x = np.indices(shown.shape)
    shown[np.hypot(x - centre[0], y - centre[1]) < 7] = 0
    row, column = np.unravel_index(shown.argmax(), shown.shape)
    peak = (left + (column + 0.5) / 64, bottom + (row + 0.5) / 64)
    assert sorted([abs(peak[0]), abs(peak[1])]) == [0.125, 0.25]
    assert peak[0] * peak[1] > 0
    assert abs(peak[0]) == 0.25  # x is horizontal


def test_radial_mean_of_a_radial_function():
    for shape in ((64, 64), (63, 48)):
        nu = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
        profile = drawing.radial_mean(nu)
        rings = np.arange(min(shape) // 2 + 1) / min(shape)
        # Within a ring of half-width 1 / (2 n) no frequency is further than that from the middle.
        np.testing.assert_allclose(profile, rings, atol=0.5 / min(shape))
    assert drawing.radial_mean(np.ones((16, 16))).tolist() == [1.0] * 9


def test_the_band_of_several_frames():
    otfs = torch.fft.fft2(torch.rand(5, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0)))
    otfs = otfs / otfs[:, :1, :1]
    ax = viz.mtf_figure({"stack": otfs.to(torch.complex64)}, GRID).axes[1]
    expected = np.mean([drawing.radial_mean(frame.abs().numpy()) for frame in otfs], axis=0)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), expected, rtol=1e-5)
    assert len(ax.collections) == 1
    assert not viz.mtf_figure({"one": otfs[0]}, GRID).axes[1].collections


def test_frames_keep_their_values_and_share_a_scale():
    frames = torch.rand(6, 20, 30, generator=torch.Generator().manual_seed(1)) * 1000 - 5
    figure = viz.frames_figure(frames, count=3, pixel_scale=1e-7)
    shown = images(figure)
    assert len(shown) == 4
    np.testing.assert_array_equal(np.stack(shown[:3]), frames[:3].double().numpy())
    np.testing.assert_allclose(shown[3], frames.double().mean(0).numpy())
    assert {ax.images[0].norm.vmax for ax in figure.axes if ax.images} == {np.percentile(frames[:3].double(), 99.9)}
    assert figure.axes[0].get_xlabel() == "x [mas]"
    assert viz.frames_figure(frames).axes[0].get_xlabel() == "x [pixels]"
    assert [ax.get_title("left") for ax in figure.axes[:4]] == ["frame 0", "frame 1", "frame 2", "mean of 6"]
    assert viz.frames_figure(frames, numbers=[3, 5, 6, 7, 8, 9]).axes[1].get_title("left") == "frame 5"
    rendered(viz.frames_figure(torch.zeros(1, 4, 4)))


@pytest.mark.parametrize("peak", [0.6, 1.0, 49.0, 5200.0, 9.7e5])
def test_numbers_beside_the_bar_of_frames_do_not_overlap(peak):
    ramp = peak * torch.linspace(0, 1, 1024, dtype=torch.float64).reshape(1, 32, 32)
    figure = viz.frames_figure(ramp)
    rendered(figure)
    bar = figure.axes[-1]
    low, high = bar.get_ylim()
    boxes = [label.get_window_extent() for label in bar.get_yticklabels()]
    assert len(boxes) == 5
    assert all(low <= tick <= high for tick in bar.get_yticks())
    assert all(below.y1 < above.y0 for below, above in itertools.pairwise(boxes))


def test_history_is_logarithmic_where_it_helps():
    ax = viz.history_figure({"a": [100.0, 10.0, 1.0], "b": np.array([50.0, math.nan, math.inf, 2.0])}, "cost").axes[0]
    assert ax.get_yscale() == "log"
    assert ax.lines[0].get_xdata().tolist() == [1, 2, 3]
    np.testing.assert_array_equal(ax.lines[1].get_ydata(), [50, np.nan, np.nan, 2])
    line = viz.history_figure({"a": torch.tensor([[10.0, 3.0], [20.0, 2.0]])}, "cost").axes[0].lines[0]
    assert (line.get_xdata().tolist(), line.get_ydata().tolist()) == ([10.0, 20.0], [3.0, 2.0])
    for values in ([3.0, 2.0], [1.0, -1.0], [math.nan]):
        assert viz.history_figure({"a": values}, "cost").axes[0].get_yscale() == "linear"


def test_comparison_shows_what_is_scored():
    generator = torch.Generator().manual_seed(0)
    truth = lowpass(torch.rand(32, 32, dtype=torch.float64, generator=generator), 0.4)
    frame = torch.rand(32, 32, generator=generator) * 50
    restored = 3 * truth.roll((2, 5), (0, 1)) + 0.2 * torch.rand(32, 32, generator=generator)
    peak = np.percentile(lowpass(truth, 0.3), 99.5)

    figure = comparison_figure(truth, {"mask": (frame, restored), "full": (frame, truth)}, 0.3, pixel_scale=1e-7)
    *axes, bar = figure.axes
    panels = {ax.get_title(loc="left"): ax.images[0].norm(np.asarray(ax.images[0].get_array())) for ax in axes}
    assert list(panels) == [
        "truth",
        f"mask\none exposure, score {relative_error(frame, truth, 0.3):.3f}",
        f"mask\nrestored, score {relative_error(restored, truth, 0.3):.3f}",
        "truth at the diffraction limit",
        f"full\none exposure, score {relative_error(frame, truth, 0.3):.3f}",
        "full\nrestored, score 0.000",
    ]

    def shown(image: torch.Tensor) -> np.ndarray:
        return np.sqrt(np.clip(image.double().numpy() / peak, 0, 1))

    expected = [
        truth,
        frame * (truth.sum() / frame.double().sum()),
        align(restored, truth, 0.3),
        lowpass(truth, 0.3),
        frame * (truth.sum() / frame.double().sum()),
        align(truth, truth, 0.3),
    ]
    for panel, image in zip(panels.values(), expected, strict=True):
        np.testing.assert_allclose(panel, shown(image), atol=1e-6)
    assert [ax.images[0].get_clim() for ax in axes] == [(0, pytest.approx(peak))] * 6
    assert bar.get_ylim() == (0, pytest.approx(peak))
    assert axes[0].texts[0].get_text() == "200 mas"  # a third of 32 pixels of 20.6 mas is 220
    assert len(comparison_figure(truth, {"mask": (frame, restored)}, 0.3).axes) == 5  # with the bar
    assert len(comparison_figure(truth, dict.fromkeys("abc", (frame, restored)), 0.3).axes) == 9


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: viz.mask_figure(SparseAperture(CENTERS[None], 0.1, 1.0)), "one mask"),
        (lambda: viz.uv_coverage_figure(SparseAperture(CENTERS[None], 0.1, 1.0)), "one mask"),
        (lambda: viz.mtf_figure({"a": torch.ones(32, 64)}, GRID), r"a has shape \(32, 64\).*\(64, 64\)"),
        (lambda: viz.psf_figure({"b": torch.ones(5)}, GRID), r"b has shape \(5,\)"),
        (lambda: viz.psf_figure({}, GRID), "nothing to draw"),
        (lambda: viz.mtf_figure({}, GRID), "nothing to draw"),
        (lambda: viz.history_figure({}, "cost"), "nothing to draw"),
        (lambda: comparison_figure(torch.ones(4, 4), {}, 0.3), "nothing to draw"),
        (lambda: viz.frames_figure(torch.ones(4, 4)), r"shape \(4, 4\): a stack"),
        (lambda: viz.frames_figure(torch.ones(0, 4, 4)), "a stack"),
        (lambda: comparison_figure(torch.ones(4, 4), {"a": (torch.ones(4, 4), torch.ones(5, 4))}, 0.3), "shape"),
    ],
)
def test_bad_input(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@settings(derandomize=True, deadline=None)
@given(
    hnp.arrays(st.sampled_from([np.float32, np.float64]), hnp.array_shapes(min_dims=2, max_dims=2)),
    st.floats(50, 100),
    st.floats(0.2, 2),
)
def test_stretch_is_bounded_and_monotonic(image, percentile, gamma):
    shown = viz.stretch(image, percentile, gamma)
    assert shown.shape == image.shape
    assert shown.min() >= 0
    assert shown.max() <= 1
    order = np.argsort(np.where(np.isnan(image), -np.inf, image).ravel(), kind="stable")
    assert (np.diff(shown.ravel()[order]) >= 0).all()
    assert (shown[~(image > 0)] == 0).all()


def test_stretch_values():
    image = torch.tensor([[math.nan, -3.0, 0.0], [1.0, 4.0, math.inf]], requires_grad=True)
    np.testing.assert_allclose(viz.stretch(image, percentile=100), [[0, 0, 0], [0.5, 1, 1]])
    assert (viz.stretch(torch.zeros(3, 3)) == 0).all()
    np.testing.assert_array_equal(viz.stretch(torch.tensor([[0.0, math.inf, -math.inf]])), [[0, 1, 0]])
    glint = torch.zeros(100, 100)
    glint[3, 4] = 2.0  # a single point brighter than the percentile is still seen
    assert viz.stretch(glint).max() == 1


def test_units():
    assert drawing.angle_unit(math.radians(1 / 3600)) == ("arcsec", pytest.approx(206264.806, rel=1e-8))
    assert drawing.angle_unit(math.radians(0.1 / 3600)) == ("mas", pytest.approx(206264806, rel=1e-8))
    assert [drawing.round_below(v) for v in (1, 1.9, 2, 4.99, 5, 9.9, 0.03)] == [1, 1, 2, 2, 5, 5, 0.02]


def test_the_callers_style_and_pyplot_are_left_alone(tmp_path):
    with matplotlib.rc_context({"font.size": 33.0, "axes.spines.top": True}):
        before = dict(matplotlib.rcParams)
        viz.mask_figure(mask())
        assert dict(matplotlib.rcParams) == before
    code = (
        "import sys, torch, torchmask.viz.figures as viz, torchmask.tracking, torchmask.metrics\n"
        "assert not {'matplotlib', 'tensorboard', 'skimage', 'rich', 'kornia'} & set(sys.modules)\n"
        "from torchmask.optics.aperture import FullAperture\n"
        "viz.mask_figure(FullAperture(1.0)).savefig(sys.argv[1])\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.png")]
    process = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "MPLBACKEND": "TkAgg"})
    assert process.returncode == 0, process.stderr  # no display is asked for
    assert (tmp_path / "a.png").stat().st_size > 1000


@pytest.mark.parametrize("angle", [0.0, 0.5, 2.0])
@pytest.mark.parametrize("compared", [False, True])
@pytest.mark.parametrize("mirrored", [False, True])
def test_arrows_point_north_and_east_as_the_sky_says(sky_matrix, angle, mirrored, compared):
    """Along each arrow the sky's coordinates change in its own direction alone, whatever the turn and the parity."""
    matrix = sky_matrix(angle, 1e-7, mirrored)
    if compared:
        truth = np.ones((24, 32))
        ax = comparison_figure(truth, {"mask": (truth, truth)}, 0.5, 1e-7, matrix).axes[0]
        ax.texts[0].remove()  # of the scale bar
    else:
        ax = viz.frames_figure(np.ones((2, 24, 32)), pixel_scale=1e-7, sky=matrix).axes[2]
    tips = [text for text in ax.texts if not text.get_text()]
    assert [text.get_text() for text in ax.texts if text.get_text()] == ["E", "N"]
    for arrow, expected in zip(tips, np.eye(2), strict=True):
        step = np.subtract(arrow.xy, arrow.xyann)  # data coordinates: y grows with the row
        along = matrix @ step
        np.testing.assert_allclose(along / np.linalg.norm(along), expected, atol=1e-12)
    left, right, bottom, top = ax.images[0].get_extent()
    places = np.array([text.get_position() for text in ax.texts])
    assert ((places > [left, top]) & (places < [right, bottom])).all()


def test_images_have_a_bar_that_names_unit_and_stretch():
    frames = np.random.default_rng(0).random((3, 16, 16))
    labels = {
        "frames": viz.frames_figure(frames, unit="adu").axes[-1].get_ylabel(),
        "unknown": viz.frames_figure(frames, unit="").axes[-1].get_ylabel(),
        "comparison": comparison_figure(frames[0], {"mask": (frames[1], frames[2])}, 0.5).axes[-1].get_ylabel(),
        "psf": viz.psf_figure({"a": frames[0]}, Grid(16, 1e-7, 1e-6)).axes[-1].get_ylabel(),
    }
    assert labels == {
        "frames": "adu, square-root stretch",
        "unknown": "square-root stretch",
        "comparison": "electrons, square-root stretch",
        "psf": "fraction of the peak, logarithmic",
    }
