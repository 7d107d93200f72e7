"""Figures of a run's masks, exposures and restorations, in TensorBoard and as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from torchmask.design.constraint_base import Constraint
from torchmask.design.constraints import KeepOutDisc, KeepOutSegment
from torchmask.design.search import SearchResult
from torchmask.grid import Grid
from torchmask.io import as_array
from torchmask.observation import Observation
from torchmask.optics.band import Band
from torchmask.optics.psf import fold
from torchmask.simulation.exposed_psf import ExposedPSF
from torchmask.tracking import RunLogger
from torchmask.viz import figures as viz
from torchmask.viz import style as drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COST_STEPS = (
    "The cost falls within a segment and steps between two, where noise and\n"
    "turbulence are estimated anew or candidates change; it leaps at a new start.",
    "So costs can be compared within a segment only. The first iterations of every start follow several candidates for "
    "each frame, and show their mean.",
)


def log_design(design: SearchResult, grid: Grid, logger: RunLogger, constraints: Sequence[Constraint] = ()) -> None:
    """Draw the mask with the zones it must avoid, its spatial frequencies, and the history of the search."""
    mask = viz.mask_figure(design.aperture)
    draw_zones(mask, constraints, drawing.length_unit(design.aperture.mask_diameter)[1])
    logger.figure("design/mask", mask)
    logger.figure("design/uv_coverage", viz.uv_coverage_figure(design.aperture, grid))
    logger.figure(
        "design/history",
        viz.history_figure(
            {stage: best for stage, best in design.history.items() if len(best)}, "relative MSE", "evaluations"
        ),
    )
    logger.scalar("summary/relative_mse", design.relative_mse)


def draw_zones(figure: Figure, constraints: Sequence[Constraint], scale: float) -> None:
    """Shade the zones of the pupil that holes must avoid; `scale` is the number of axis units per metre."""
    from matplotlib.patches import Circle, Polygon

    style: dict[str, Any] = {"facecolor": drawing.FAINT, "edgecolor": "none"}
    for zone in constraints:
        if isinstance(zone, KeepOutDisc):
            center = scale * np.array(zone.center)
            figure.axes[0].add_patch(Circle((center[0], center[1]), scale * zone.diameter / 2, **style))
        elif isinstance(zone, KeepOutSegment):
            start, end = scale * np.array(zone.start), scale * np.array(zone.end)
            across = np.array([start[1] - end[1], end[0] - start[0]])
            across *= scale * zone.width / 2 / np.linalg.norm(across)
            corners = [start + across, end + across, end - across, start - across]
            figure.axes[0].add_patch(Polygon(np.array(corners), **style))


def log_observation(name: str, observation: Observation, logger: RunLogger, band: Band | None = None) -> None:
    """Draw PSFs in light of a band with and without turbulence, their MTFs, and frames."""
    assert observation.psfs is not None
    grid = observation.grid
    psfs = torch.fft.ifftshift(observation.psfs, dim=(-2, -1))
    optics = ExposedPSF(observation.true_aperture or observation.aperture, grid, band, observation.pixel)
    still = fold(optics([None]), grid.shape).to(psfs)
    otfs = {"no turbulence": torch.fft.fft2(still), "exposures": torch.fft.fft2(psfs)}
    logger.figure(f"{name}/psf", viz.psf_figure({"no turbulence": still, "first exposure": psfs[0]}, grid))
    logger.figure(f"{name}/mtf", viz.mtf_figure(otfs, grid))
    logger.figure(f"{name}/frames", viz.frames_figure(observation.frames, pixel_scale=grid.pixel_scale))
    logger.image(f"{name}/first_frame", observation.frames[0])


def log_cost(name: str, curves: Mapping[str, Sequence[float]], logger: RunLogger) -> None:
    """Draw the cost of restorations at every iteration, and explain its steps in the figure and as text."""
    figure = viz.history_figure(curves, "cost")
    figure.axes[0].set_title(COST_STEPS[0], fontsize=8.5)
    logger.figure(name, figure)
    logger.text(name, " ".join(COST_STEPS))


@drawing.styled
def restored_figure(
    image: Any,
    frames: Any | None = None,
    residuals: Any | None = None,
    pixel_scale: float | None = None,
    title: str = "restored",
    deviation: Any | None = None,
    unit: str = "electrons",
    sky: Any | None = None,
    first_frame: int = 0,
) -> Figure:
    """Draw a restored image (H, W) beside the first and the mean of `frames` (T, H, W) and the rms of `residuals`.

    `first_frame` is the number of the first frame. If `deviation` (H, W) is given, the standard deviation of the image
    is drawn too.

    Light is shown with a square-root stretch, each image up to its own 99.5th percentile [`unit` per pixel]. Residuals
    (T, H, W) are in units of the noise, so that noise alone gives 1. `pixel_scale` [rad] labels the axes with angles;
    `sky` (2, 2), as `Observation.sky_matrix`, adds north and east.
    """
    restored = as_array(image)
    lights = {title: restored}
    if frames is not None:
        stack = as_array(frames)
        lights = {f"frame {first_frame}": stack[0], f"mean of {len(stack)} frames": stack.mean(0), **lights}
    panels = len(lights) + (residuals is not None) + (deviation is not None)
    figure, axes = drawing.row_of_axes([1.3] * panels, height=3.2)
    angle, extent = drawing.sky_extent((restored.shape[0], restored.shape[1]), pixel_scale)
    for ax, (name, values) in zip(axes, lights.items(), strict=False):
        ax.imshow(values, cmap="gray", norm=drawing.light_norm(viz.peak(values)), extent=extent)
        drawing.image_axes(ax, name, f"x [{angle}]", f"y [{angle}]" if ax is axes[0] else "")
        drawing.light_bar(figure, [ax], unit)
        if sky is not None and name == title:
            drawing.compass(ax, sky)
    if deviation is not None:
        ax = axes[len(lights)]
        ax.imshow(as_array(deviation), cmap="magma", vmin=0, extent=extent)
        drawing.image_axes(ax, "standard deviation", f"x [{angle}]", "")
        drawing.colorbar(figure, [ax], f"{unit}, linear")
    if residuals is not None:
        rms = np.sqrt((as_array(residuals) ** 2).mean(0))
        axes[-1].imshow(rms, cmap="magma", vmin=0, vmax=max(2.0, float(np.percentile(rms, 99.5))), extent=extent)
        drawing.image_axes(axes[-1], "rms residual", f"x [{angle}]", "")
        drawing.colorbar(figure, axes[-1:], "noise, linear")
    return figure
