"""The common style of the figures in `viz`, and helpers for units, axes and patches."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from torchmask.grid import ARCSEC, MAS, Grid
from torchmask.io import extra
from torchmask.optics.aperture import Aperture
from torchmask.optics.shape_base import Circle, Contour

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import PowerNorm
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

P = ParamSpec("P")
T = TypeVar("T")

# Okabe and Ito's colours, which colour-blind readers can distinguish.
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00")
INK, FAINT, PALE = "#222222", "#8A8A8A", "#EFEFEF"
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.labelcolor": INK,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.6,
    "figure.dpi": 110.0,
}


def styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """Decorate a function so that it draws in this module's style, without changing the caller's."""

    @functools.wraps(draw)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> Figure:
        with extra("experiments"):
            import matplotlib

        with matplotlib.rc_context(_STYLE):
            return draw(*args, **kwargs)

    return wrapped


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of `width` x `height` inches, independent of pyplot."""
    with extra("experiments"):
        from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def row_of_axes(widths: Sequence[float], height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure of `height` inches with axes side by side.

    `widths` are in units of the height of the axes, which is `height` less 0.6 inches for labels.
    """
    figure = new_figure((height - 0.6) * sum(widths) + 1.3, height)
    return figure, list(figure.subplots(1, len(widths), squeeze=False, width_ratios=list(widths))[0])


def colors() -> Iterator[str]:
    """Yield the colours of successive curves, in an endless cycle."""
    return itertools.cycle(COLORS)


def not_empty(things: Mapping[str, T]) -> Mapping[str, T]:
    """Return `things`, or raise ValueError if there is nothing to draw."""
    if not things:
        raise ValueError("there is nothing to draw: the mapping is empty, give at least one name and its array")
    return things


def length_unit(length: float) -> tuple[str, float]:
    """Return the unit suited to `length` [m], m or mm, and its number per metre."""
    return ("m", 1.0) if length >= 0.1 else ("mm", 1e3)


def angle_unit(angle: float) -> tuple[str, float]:
    """Return the unit suited to `angle` [rad], arcsec or mas, and its number per radian."""
    return ("arcsec", 1 / ARCSEC) if angle >= 0.5 * ARCSEC else ("mas", 1 / MAS)


def round_below(value: float) -> float:
    """Return the largest 1, 2 or 5 times a power of ten that does not exceed `value` > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step for step in (power, 2 * power, 5 * power) if step <= value * (1 + 1e-9))


def sky_extent(
    shape: tuple[int, int], pixel_scale: float | None, centred: bool = False
) -> tuple[str, tuple[float, float, float, float]]:
    """Return unit and extent of an image with row 0 at the top.

    The origin is pixel [0, 0], or the middle pixel (after fftshift) if `centred`.
    """
    rows, columns = shape
    unit, step = ("pixels", 1.0)
    if pixel_scale is not None:
        unit, scale = angle_unit(pixel_scale * min(shape) / 2)
        step = pixel_scale * scale
    y0, x0 = (rows // 2, columns // 2) if centred else (0, 0)
    left, top = -x0 - 0.5, -y0 - 0.5
    return unit, (left * step, (left + columns) * step, (top + rows) * step, top * step)


def frequency_extent(grid: Grid) -> tuple[float, float, float, float]:
    """Return the extent of an fftshifted Fourier plane with y upwards [cycles/pixel]."""
    rows, columns = grid.shape
    left, bottom = (-columns // 2 + columns % 2 - 0.5) / columns, (-rows // 2 + rows % 2 - 0.5) / rows
    return left, left + 1, bottom, bottom + 1


def one_mask(aperture: Aperture) -> np.ndarray:
    """Return the centres (N, 2) of one aperture [m]; raises ValueError for a population."""
    centers = aperture.centers.numpy(force=True)
    if centers.ndim != 2:
        raise ValueError(f"centers has shape {centers.shape}: give one mask, (n_subapertures, 2), at a time")
    return centers


def hole(aperture: Aperture, center: np.ndarray, scale: float, **style: Any) -> Patch:
    """Return a patch for a sub-aperture, enlarged by `scale`, around `center` (x, y), which is already scaled."""
    return edge(aperture.shape.outline(aperture.subaperture_diameter * scale)[0], center, **style)


def edge(contour: Contour, center: np.ndarray, **style: Any) -> Patch:
    """Return a patch for the area within one edge of a hole, around `center` (x, y) in the unit of the contour."""
    with extra("experiments"):
        from matplotlib import patches

    if isinstance(contour, Circle):
        return patches.Circle((float(center[0]), float(center[1])), contour.radius, **style)
    return patches.Polygon(contour.points + center, **style)


def plane_axes(ax: Axes, half: float, x_label: str, y_label: str) -> None:
    """Make the axes a square plane around the origin, y upwards, with the same ticks on both axes."""
    ax.set(xlim=(-half, half), ylim=(-half, half), aspect="equal", xlabel=x_label, ylabel=y_label)
    ax.set_yticks(ax.get_xticks())
    ax.set(xlim=(-half, half), ylim=(-half, half))


def image_axes(ax: Axes, title: str, x_label: str, y_label: str) -> None:
    """Set title and labels of an image; without a y label, because a neighbour has it, y has no tick labels either."""
    ax.set(title=title, xlabel=x_label, ylabel=y_label)
    ax.locator_params(nbins=5)
    ax.tick_params(labelleft=bool(y_label))


def second_scale(ax: Axes, factor: float, label: str) -> None:
    """Add a second horizontal axis on top, with `factor` times the values of the first."""
    top = ax.secondary_xaxis("top", functions=(lambda x: np.multiply(x, factor), lambda x: np.divide(x, factor)))
    top.set_xlabel(label)


def colorbar(figure: Figure, axes: list[Axes], label: str = "", **options: Any) -> None:
    """Add a slim colour bar to the right of `axes`, whose images share one scale."""
    bar = figure.colorbar(axes[0].images[0], ax=axes, shrink=0.9, pad=0.015, aspect=28, label=label, **options)
    bar.outline.set_visible(False)  # type: ignore[operator]


def light_norm(peak: float) -> PowerNorm:
    """Return a square-root normalisation from 0 to `peak`, which lifts the faint parts."""
    with extra("experiments"):
        from matplotlib.colors import PowerNorm

    return PowerNorm(0.5, 0, peak or 1.0, clip=True)


def light_bar(figure: Figure, axes: list[Axes], unit: str = "electrons") -> None:
    """Add a colour bar for images with `light_norm` that names the unit and the stretch."""
    peak = axes[0].images[0].get_clim()[1]
    even = (0, 0.05, 0.2, 0.5, 1)  # almost evenly spaced under the square root
    label = f"{unit}, square-root stretch" if unit else "square-root stretch"
    colorbar(figure, axes, label, ticks=[round_below(peak) * part for part in even], format="%g")


def compass(ax: Axes, matrix: Any) -> None:
    """Draw arrows to north and east in the lower right corner of an image with a `sky_extent`.

    `matrix` (2, 2) converts pixels (x, y) to (east, north), as `Observation.sky_matrix` does.
    """
    left, right, bottom, top = ax.images[0].get_extent()
    side = min(abs(right - left), abs(bottom - top))
    towards = np.linalg.inv(np.asarray(matrix, dtype=float)).T  # rows are steps to east and to north, in pixels
    middle = np.array([right - 0.2 * side, bottom - 0.2 * side])
    for name, step in zip(("E", "N"), towards / np.linalg.norm(towards, axis=1, keepdims=True), strict=True):
        (x, y), (tip_x, tip_y) = middle, middle + 0.11 * side * step
        arrow = {"arrowstyle": "->", "color": "white", "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (float(tip_x), float(tip_y)), (float(x), float(y)), arrowprops=arrow)
        x, y = middle + 0.15 * side * step
        ax.text(float(x), float(y), name, color="white", fontsize=8.5, ha="center", va="center")


def scale_bar(ax: Axes, columns: int, pixel_scale: float) -> None:
    """Draw a white scale bar with its angle, at most a third of the image wide, in the lower left corner."""
    unit, scale = angle_unit(pixel_scale * columns / 4)
    angle = round_below(pixel_scale * columns / 3 * scale)
    length = angle / scale / pixel_scale / columns
    ax.plot([0.05, 0.05 + length], [0.06, 0.06], transform=ax.transAxes, color="white", linewidth=2)
    ax.text(0.05, 0.085, f"{angle:g} {unit}", transform=ax.transAxes, color="white", fontsize=8.5)


def radial_mean(plane: np.ndarray) -> np.ndarray:
    """Return the mean of a Fourier plane in FFT order over rings one step wide, from 0 to 1/2 cycles/pixel."""
    rows, columns = plane.shape
    nu = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.fftfreq(columns))
    ring = np.rint(nu * min(plane.shape)).astype(int).ravel()
    mean = np.bincount(ring, plane.ravel()) / np.maximum(np.bincount(ring), 1)
    return mean[: min(plane.shape) // 2 + 1]
