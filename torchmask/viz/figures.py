"""Figures: masks, frequency coverage, transfer functions, images and curves.

Every function returns a matplotlib Figure that is independent of pyplot, so it works without a display and leaves
nothing open. Images have row 0 at the top; pupil and frequency planes have y upwards, as drawings of masks do. PSFs and
OTFs are given in FFT order; this module moves their origin to the middle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmask.grid import Grid
from torchmask.io import as_array
from torchmask.observation import number_frames
from torchmask.optics.aperture import Aperture
from torchmask.viz import style as drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def stretch(image: Any, percentile: float = 99.5, gamma: float = 0.5) -> np.ndarray:
    """Map an image to [0, 1] for display: 0 stays 0, `percentile` becomes 1, and the power `gamma` lifts faint parts.

    Negative values and NaN become 0, infinite ones 1. An image that is nowhere positive becomes 0 everywhere.

    Examples
    --------
    >>> stretch([[-1.0, 0.0], [1.0, 4.0]], percentile=100).tolist()
    [[0.0, 0.0], [0.5, 1.0]]
    """
    values = as_array(image).astype(float)
    values = np.where(values > 0, values, 0.0)
    white = peak(values, percentile)
    return (np.minimum(values, white) / white) ** gamma if white > 0 else np.where(values > 0, 1.0, 0.0)


def peak(values: np.ndarray, percentile: float = 99.5) -> float:
    """Return the value to show as white: `percentile`, or the largest value if that is not positive."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0
    white = float(np.percentile(finite, percentile))
    return white if white > 0 else float(finite.max())


def _on_grid(name: str, values: Any, grid: Grid) -> np.ndarray:
    """Return `values` (..., H, W) as an array with its leading axes flattened to one, after checking its shape."""
    array = as_array(values)
    if array.shape[-2:] != grid.shape or 0 in array.shape:
        raise ValueError(f"{name} has shape {array.shape}: it must end in that of the grid, {grid.shape}")
    return array.reshape(-1, *grid.shape)


@drawing.styled
def mask_figure(aperture: Aperture, title: str | None = None) -> Figure:
    """Draw the holes of one aperture to scale inside the disc of the mask. Axes are in metres or millimetres.

    Raises ValueError for a population of masks.
    """
    from matplotlib.patches import Circle

    centers, unit, scale = drawing.one_mask(aperture), *drawing.length_unit(aperture.mask_diameter)
    figure = drawing.new_figure(4.0, 4.1)
    ax = figure.subplots()
    radius = aperture.mask_diameter / 2 * scale
    ax.add_patch(Circle((0, 0), radius, facecolor=drawing.PALE, edgecolor=drawing.FAINT, linewidth=0.8))
    for center in centers * scale:
        ax.add_patch(drawing.hole(aperture, center, scale, facecolor=drawing.COLORS[0], edgecolor="none"))
        for blocked in aperture.shape.outline(aperture.subaperture_diameter * scale)[1:]:
            ax.add_patch(drawing.edge(blocked, center, facecolor=drawing.PALE))
    drawing.plane_axes(ax, 1.06 * max(radius, aperture.reach * scale), f"x [{unit}]", f"y [{unit}]")
    size = f"{aperture.subaperture_diameter * scale:.3g} {unit}"
    n = aperture.n_subapertures
    ax.set_title(title or (f"{aperture.shape} of {size}" if aperture.is_full else f"{n} {aperture.shape}s of {size}"))
    return figure


@drawing.styled
def uv_coverage_figure(aperture: Aperture, grid: Grid | None = None, title: str | None = None) -> Figure:
    """Draw the spatial frequencies that an aperture transmits.

    Each pair of holes covers the shape of a hole, twice as large, around its baseline; overlaps are darker. Axes are
    baselines in metres or millimetres. With a `grid` they are also frequencies in cycles/pixel, and a square shows what
    the grid samples, beyond which frequencies wrap around. Raises ValueError for a population of masks.
    """
    from matplotlib.patches import Rectangle

    centers, unit, scale = drawing.one_mask(aperture), *drawing.length_unit(aperture.mask_diameter)
    baselines = (centers[:, None] - centers[None]).reshape(-1, 2)
    pairs = baselines[~np.eye(len(centers), dtype=bool).ravel()]
    figure = drawing.new_figure(4.6, 4.9)
    ax = figure.subplots()
    for baseline in np.concatenate([np.zeros((1, 2)), pairs]) * scale:
        ax.add_patch(
            drawing.hole(aperture, baseline, 2 * scale, facecolor=drawing.COLORS[0], edgecolor="none", alpha=0.35)
        )
    if len(pairs):
        dots: dict[str, Any] = {"color": drawing.INK, "markersize": 2.5, "linestyle": "none"}
        ax.plot(*(pairs.T * scale), ".", label="pair of holes, in either order", **dots)
    reach, turn = aperture.mask_diameter * scale, np.linspace(0, 2 * np.pi, 361)
    circle = reach * np.cos(turn), reach * np.sin(turn)  # a line, as the legend shows any patch as a rectangle
    ax.plot(*circle, color=drawing.FAINT, linewidth=0.9, label="cut-off of the whole disc")
    half = max(reach, 2 * aperture.reach * scale)
    if grid is not None:
        nyquist = grid.period / 2 * scale
        half = max(half, nyquist)
        square = Rectangle((-nyquist, -nyquist), 2 * nyquist, 2 * nyquist, fill=False, color=drawing.COLORS[1])
        square.set(linestyle="--", linewidth=0.9, label="sampled by the grid")
        ax.add_patch(square)
        drawing.second_scale(ax, 1 / (grid.period * scale), "frequency [cycles/pixel]")
    drawing.plane_axes(ax, 1.06 * half, f"baseline x [{unit}]", f"baseline y [{unit}]")
    figure.legend(loc="outside lower center", ncols=2)
    ax.set_title(title or (f"{len(pairs) // 2} baselines" if len(pairs) else "a single aperture"))
    return figure


@drawing.styled
def mtf_figure(otfs: Mapping[str, Any], grid: Grid) -> Figure:
    """Draw modulation transfer functions, each in two dimensions, and the radial means of all.

    Parameters
    ----------
    otfs : mapping of name to (..., H, W) tensor or array
        Optical transfer functions in FFT order. For several frames, the mean modulus is shown, with a band between the
        10th and the 90th percentile of the frames' radial means.
    grid : Grid
        Pixels and wavelength of the images.

    Raises
    ------
    ValueError
        If an OTF does not have the shape of the grid, or there is none.
    """
    from matplotlib.colors import PowerNorm

    moduli = {name: np.abs(_on_grid(name, values, grid)) for name, values in drawing.not_empty(otfs).items()}
    figure, axes = drawing.row_of_axes([1.0] * len(moduli) + [1.35], height=2.9)
    for ax, (name, modulus) in zip(axes, moduli.items(), strict=False):
        mean = np.fft.fftshift(modulus.mean(0))
        ax.imshow(mean, cmap="magma", norm=PowerNorm(0.5, 0, 1), origin="lower", extent=drawing.frequency_extent(grid))
        drawing.image_axes(
            ax, f"{name}: MTF", r"$\nu_x$ [cycles/pixel]", r"$\nu_y$ [cycles/pixel]" if ax is axes[0] else ""
        )
    drawing.colorbar(figure, axes[:-1], ticks=[0, 0.01, 0.05, 0.2, 0.5, 1], format="%g")
    ax = axes[-1]
    for color, (name, modulus) in zip(drawing.colors(), moduli.items(), strict=False):
        profiles = np.stack([drawing.radial_mean(frame) for frame in modulus])
        frequency = np.arange(profiles.shape[1]) / min(grid.shape)
        ax.plot(frequency, profiles.mean(0), color=color, label=name)
        if len(profiles) > 1:
            ax.fill_between(frequency, *np.percentile(profiles, [10, 90], axis=0), color=color, alpha=0.2, linewidth=0)
    ax.set(xlim=(0, 0.5), ylim=(1e-3, 1.05), yscale="log", xlabel="frequency [cycles/pixel]", title="radial mean")
    unit, scale = drawing.length_unit(grid.period / 2)
    drawing.second_scale(ax, grid.period * scale, f"baseline [{unit}]")
    ax.legend()
    return figure


@drawing.styled
def psf_figure(psfs: Mapping[str, Any], grid: Grid) -> Figure:
    """Draw point-spread functions (H, W), given in FFT order, as fractions of their peaks over four decades.

    Raises ValueError if one does not have the shape of the grid, or there is none.
    """
    from matplotlib.colors import LogNorm

    figure, axes = drawing.row_of_axes([1.0] * len(drawing.not_empty(psfs)), height=3.1)
    unit, extent = drawing.sky_extent(grid.shape, grid.pixel_scale, centred=True)
    for ax, (name, values) in zip(axes, psfs.items(), strict=True):
        psf = np.fft.fftshift(_on_grid(name, values, grid).mean(0))
        ax.imshow(np.maximum(psf / psf.max(), 1e-4), cmap="magma", norm=LogNorm(1e-4, 1), extent=extent)
        drawing.image_axes(ax, name, f"x [{unit}]", f"y [{unit}]" if ax is axes[0] else "")
    drawing.colorbar(figure, axes, "fraction of the peak, logarithmic")
    return figure


@drawing.styled
def frames_figure(
    frames: Any,
    count: int = 4,
    pixel_scale: float | None = None,
    unit: str = "electrons",
    sky: Any | None = None,
    numbers: Sequence[int] = (),
) -> Figure:
    """Draw the first `count` exposures of a stack (T, H, W) and the mean of all, on one scale [`unit` per pixel].

    With `pixel_scale` [rad] the axes show angles instead of pixels. With `sky` (2, 2), such as
    `Observation.sky_matrix`, arrows show north and east. `numbers` (T,) are the frames' own, such as
    `Observation.frame_numbers`; they are counted from 0 if none are given.

    Raises ValueError if `frames` has another shape, or there are more or fewer numbers.
    """
    stack = as_array(frames).astype(float)
    if stack.ndim != 3 or 0 in stack.shape:
        raise ValueError(f"frames have shape {stack.shape}: a stack (frames, rows, columns) is needed")
    named = number_frames(numbers, len(stack))
    images = {f"frame {number}": frame for number, frame in zip(named, stack[:count], strict=False)}
    images[f"mean of {len(stack)}"] = stack.mean(0)
    figure, axes = drawing.row_of_axes([1.0] * len(images), height=2.5)
    angle, extent = drawing.sky_extent(stack.shape[1:], pixel_scale)
    norm = drawing.light_norm(peak(stack[:count], 99.9))
    for ax, (name, values) in zip(axes, images.items(), strict=True):
        ax.imshow(values, cmap="gray", norm=norm, extent=extent)
        drawing.image_axes(ax, name, f"x [{angle}]", f"y [{angle}]" if ax is axes[0] else "")
    if sky is not None:
        drawing.compass(axes[-1], sky)
    drawing.light_bar(figure, axes, unit)
    return figure


@drawing.styled
def history_figure(curves: Mapping[str, Any], label: str, x_label: str = "iteration") -> Figure:
    """Draw the quantity `label` that is minimised against the iteration, with one curve per stage or run.

    A curve is an array of values (n,), one for each iteration, or of points (n, 2), (iteration, value). The vertical
    axis is logarithmic if all values are positive and span more than a factor of 5. Values that are not finite leave
    gaps. Raises ValueError if there is no curve.
    """
    from matplotlib.ticker import MaxNLocator

    figure = drawing.new_figure(5.2, 3.2)
    ax = figure.subplots()
    series = {name: _points(values) for name, values in drawing.not_empty(curves).items()}
    for color, (name, points) in zip(drawing.colors(), series.items(), strict=False):
        shown = np.where(np.isfinite(points[:, 1]), points[:, 1], np.nan)
        ax.plot(points[:, 0], shown, color=color, label=name)
    finite = np.concatenate([points[np.isfinite(points[:, 1]), 1] for points in series.values()])
    if finite.size and finite.min() > 0 and finite.max() > 5 * finite.min():
        ax.set_yscale("log")
    ax.set(xlabel=x_label, ylabel=label)
    ax.grid(axis="y", color="#E4E4E4", linewidth=0.6)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.margins(x=0.01)
    ax.legend()
    return figure


def _points(curve: Any) -> np.ndarray:
    """Return points (n, 2): those of a curve (n, 2) unchanged, those of values (n,) numbered from 1."""
    values = as_array(curve).astype(float)
    if values.ndim == 2 and values.shape[1] == 2:
        return values
    return np.stack([np.arange(1, values.size + 1), values.ravel()], axis=-1)
