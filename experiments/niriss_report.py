"""What the AB Dor experiment says and shows: sentences, a table, images with north up, the search, the residuals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from rich.table import Table
from torch import Tensor

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion import Exposures
from torchmask.interferometry.companion_errors import MEASURED, polar
from torchmask.interferometry.companion_fit import CompanionFit
from torchmask.interferometry.companion_limits import SIGNIFICANCE, DetectionLimits
from torchmask.viz.style import COLORS, FAINT, new_figure, styled

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def findings(target: str, calibrator: str, results: dict[str, Any]) -> list[str]:
    """Return what was found, in sentences."""
    pose, own, single = results["pose"], results["companion"], results["calibrator"]
    tried = results["orientations_tried"]
    same, other = (min(r["chi_square"] for r in tried if (r["mirrored"] == pose.mirrored) == s) for s in (True, False))
    lines = [
        f"Mask on the detector: {'mirrored in x' if pose.mirrored else 'as in the catalogue, not mirrored'} (or that "
        f"turned by 180 degrees, which makes the same image), rotated by {pose.rotation:+.2f} degrees from x to y, "
        f"magnified by {pose.magnification:.4f}, holes of {pose.hole:.3f} m: chi-square {same:.2f}, against at least "
        f"{other:.0f} if mirrored the other way.",
        f"Model and exposures of {calibrator} differ by {100 * results['flux_error']:.1f} % of a pixel's flux "
        "beyond the noise.",
    ]
    limits = single["limits"]
    line = ", ".join(f"{m:.1f} mag at {s:.2f}" for s, m in zip(*limits.values(), strict=True))
    lines.append(
        f"{calibrator}: no companion above {SIGNIFICANCE:g} times the scatter (the highest point of the search "
        f"reaches {single['highest_over_limit']:.2f} of that). Detection limit: {line} arcsec."
    )
    if own is None:
        lines.append(
            f"{target}: NO companion found; the highest point of the search reaches "
            f"{results['highest_over_limit']:.2f} of the limit."
        )
    else:
        total = own["total_error"]
        lines.append(
            f"{target}: a companion at {own['separation']:.1f} +- {total['separation']:.1f} mas, position angle "
            f"{own['position_angle']:.2f} +- {total['position_angle']:.2f} degrees, "
            f"{own['magnitude_difference']:.2f} +- {total['magnitude_difference']:.2f} mag fainter; it is "
            f"{results['highest_over_limit']:.1f} times above the limit. Without it the highest point of the search "
            f"reaches {results['rest_over_limit']:.2f} of the limit."
        )
        apart = max(abs(value) for value in results["half_differences"].values())
        lines.append(
            f"The two halves of the exposures {'agree' if apart < 3 else 'DISAGREE'}: they differ by at most "
            f"{apart:.1f} of their errors from the exposures alone."
        )
    for name, seen in results["restored"].items():
        lines.append(
            f"Restored image of {name}: brightest beside the star at {seen['separation']:.0f} mas, position angle "
            f"{seen['position_angle']:.0f} degrees, {seen['magnitude_difference']:.1f} mag fainter."
        )
    return lines


def table(results: dict[str, Any]) -> Table:
    """Return the companion from all exposures and from each half."""
    sheet = Table("exposures", "separation [mas]", "position angle [deg]", "magnitude difference", "chi-square")
    for row in [results["companion"], *results["halves"]]:
        values = [
            f"{row[n]:.2f} +- {row['statistical_error'][n]:.2f} +- {row['systematic_error'][n]:.2f}" for n in MEASURED
        ]
        sheet.add_row(str(row["exposures"]), *values, f"{np.mean(row['chi_square']):.2f}")
    sheet.caption = "errors: from the exposures; from companions put beside the calibrator and fewer aberrations"
    return sheet


def _centroid(image: Tensor, row: int, column: int) -> tuple[float, Tensor]:
    """Return the light of 3 x 3 pixels, and its centre (y, x)."""
    box = image[row - 1 : row + 2, column - 1 : column + 2]
    offsets = torch.arange(-1, 2, dtype=torch.float64)
    place = torch.stack([(box.sum(1) * offsets).sum(), (box.sum(0) * offsets).sum()]) / box.sum().clamp(min=1e-30)
    return float(box.sum()), place + torch.tensor([row, column])


def brightest_beside(image: Tensor, to_pixels: Tensor, most: float = 0.7) -> dict[str, Any]:
    """Return the brightest source beside the star in a restored image, up to a separation [arcsec]."""
    row, column = divmod(int(image.argmax()), image.shape[1])
    flux, star = _centroid(image, row, column)
    rest = image.clone()
    rest[row - 1 : row + 2, column - 1 : column + 2] = 0
    y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in image.shape), indexing="ij")
    pixels_per_radian = float(to_pixels[0].norm()) / 2**0.5
    rest[torch.hypot(y - row, x - column) > most * ARCSEC * pixels_per_radian] = 0
    light, place = _centroid(image, *divmod(int(rest.argmax()), image.shape[1]))
    position = torch.linalg.inv(to_pixels.mean(0)) @ (place - star)
    return polar(torch.cat([torch.tensor([light / flux], dtype=torch.float64), position])) | {"star": star.tolist()}


def upright(image: Tensor, star: Sequence[float], to_pixels: Tensor, half: float = 0.7, n: int = 141) -> np.ndarray:
    """Return an image with north up and east left, `half` arcsec to each side of the star, in its nearest pixels."""
    from scipy.ndimage import map_coordinates

    line = np.linspace(-half, half, n) * ARCSEC
    east, north = np.meshgrid(line[::-1], line[::-1])
    rows, columns = np.tensordot(to_pixels.mean(0).numpy(), np.stack([east, north]), 1)
    return map_coordinates(image.numpy(), [rows + star[0], columns + star[1]], order=0)


@styled
def images_figure(images: dict[str, np.ndarray], marks: Sequence[dict[str, float]], half: float = 0.7) -> Figure:
    """Draw images (n, n) with north up, as fractions of their peak, with what was fitted as circles."""
    from matplotlib.colors import LogNorm

    figure = new_figure(3.0 * len(images) + 0.6, 3.7)
    axes = figure.subplots(1, len(images), squeeze=False)[0]
    for ax, (title, image) in zip(axes, images.items(), strict=True):
        shown = np.clip(image / image.max(), 1e-4, 1)
        drawn = ax.imshow(shown, cmap="magma", norm=LogNorm(1e-4, 1), extent=(half, -half, -half, half))
        ax.set(title=title, xlabel="east [arcsec]", ylabel="north [arcsec]" if ax is axes[0] else "")
        draw_marks(ax, marks)
    figure.colorbar(drawn, ax=axes, label="fraction of the peak, logarithmic", shrink=0.85)
    explain_marks(figure, axes[0])
    return figure


def draw_marks(ax: Axes, marks: Sequence[dict[str, float]]) -> None:
    """Draw circles around what was fitted."""
    for mark in marks:
        angle, away = math.radians(mark["position_angle"]), mark["separation"] / 1000
        place = (away * math.sin(angle), away * math.cos(angle))
        ax.plot(*place, "o", color=COLORS[2], markersize=13, fillstyle="none", label="companion of the fit")


def explain_marks(figure: Figure, ax: Axes) -> None:
    """Explain the circles in a legend above the panels, where there are any."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        figure.legend(handles[:1], labels[:1], loc="outside upper right")


@styled
def search_figure(
    offsets: Tensor, maps: dict[str, Tensor], limits: DetectionLimits, marks: Sequence[dict[str, float]] = ()
) -> Figure:
    """Draw contrast over the limit at its separation wherever a companion was looked for, and contrast and limit."""
    figure = new_figure(7.0, 0.4 + 3.1 * math.ceil((len(maps) + 1) / 2))
    axes = figure.subplots(math.ceil((len(maps) + 1) / 2), 2, squeeze=False).flat[: len(maps) + 1]
    east, north = (offsets / ARCSEC).T.numpy()
    line = np.unique(np.concatenate([east, north]).round(6))
    columns, rows = (np.searchsorted(line, along.round(6)) for along in (east, north))
    ratios = {title: contrast / limits(offsets) for title, contrast in maps.items()}
    most = max(1.0, *(float(ratio.abs().max()) for ratio in ratios.values()))
    for ax, (title, ratio) in zip(axes, ratios.items(), strict=False):
        plane = np.full((len(line), len(line)), np.nan)
        plane[rows, columns] = ratio.numpy()
        drawn = ax.pcolormesh(line, line, plane, cmap="RdBu_r", vmin=-most, vmax=most)
        draw_marks(ax, marks)
        ax.set(title=title, xlabel="east [arcsec]", ylabel="north [arcsec]", aspect="equal")
        ax.invert_xaxis()
        figure.colorbar(drawn, ax=ax, label="contrast / limit", shrink=0.85)
    explain_marks(figure, axes[0])
    ax, away = axes[-1], np.hypot(east, north)
    for color, (title, contrast) in zip((COLORS[1], FAINT, COLORS[4]), maps.items(), strict=False):
        ax.plot(away, contrast.numpy(), ".", linestyle="none", markersize=2.5, color=color, label=title)
    ax.plot(limits.separation, limits.contrast, color=COLORS[0], label="limit")
    largest = max(float(contrast.max()) for contrast in maps.values())
    ax.set(xlabel="separation [arcsec]", ylabel="contrast", yscale="log", ylim=(1e-4, 30 * largest))
    ax.set_title("what is found, and the limit")
    ax.legend(loc="upper left", markerscale=3, fontsize=7.5)
    return figure


@styled
def exposures_figure(exposures: Exposures, fit: CompanionFit, radius: float) -> Figure:
    """Draw the first exposure, the model of it, and what is left, in units of the peak."""
    from matplotlib.colors import LogNorm

    peak = float(fit.images[0].max())
    figure = new_figure(9.6, 3.2)
    axes = figure.subplots(1, 3)
    data = torch.where(exposures.valid[0], exposures.frames[0], torch.nan)
    for ax, title, image in zip(axes, ("exposure", "model"), (data, fit.images[0]), strict=False):
        drawn = ax.imshow((image / peak).clamp(min=1e-4).numpy(), cmap="magma", norm=LogNorm(1e-4, 1), origin="lower")
        ax.set(title=title, xlabel="x [pixels]", ylabel="y [pixels]" if ax is axes[0] else "")
    figure.colorbar(drawn, ax=list(axes[:2]), label="fraction of the peak", shrink=0.85)
    y, x = np.mgrid[: data.shape[0], : data.shape[1]]
    far = torch.from_numpy(np.hypot(y - data.shape[0] // 2, x - data.shape[1] // 2) > radius)
    left = torch.where(far, torch.nan, (data - fit.images[0]) / peak)
    drawn = axes[2].imshow(left.numpy(), cmap="RdBu_r", vmin=-0.01, vmax=0.01, origin="lower")
    axes[2].set(title="exposure - model", xlabel="x [pixels]")
    figure.colorbar(drawn, ax=axes[2], label="fraction of the peak", shrink=0.85)
    return figure
