"""Figures of the AB Dor experiment: images with north up, the search for companions, an exposure and its model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from companion_fit import Exposures, Fit
from torch import Tensor

from torchmask._drawing import COLORS, FAINT, new_figure, styled
from torchmask.data.keywords import ARCSEC

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def upright(image: Tensor, star: Sequence[float], to_pixels: Tensor, half: float = 0.7, n: int = 141) -> np.ndarray:
    """An image with north up and east left, `half` arcsec to each side of the star, in its nearest pixels."""
    from scipy.ndimage import map_coordinates

    line = np.linspace(-half, half, n) * ARCSEC
    east, north = np.meshgrid(line[::-1], line[::-1])
    rows, columns = np.tensordot(to_pixels.mean(0).numpy(), np.stack([east, north]), 1)
    return map_coordinates(image.numpy(), [rows + star[0], columns + star[1]], order=0)


@styled
def images_figure(images: dict[str, np.ndarray], marks: Sequence[dict[str, float]], half: float = 0.7) -> Figure:
    """Images (n, n) with north up, as fractions of their peak, with what was fitted as circles."""
    from matplotlib.colors import LogNorm

    figure = new_figure(3.2 * len(images) + 0.6, 3.6)
    axes = figure.subplots(1, len(images), squeeze=False)[0]
    for ax, (title, image) in zip(axes, images.items(), strict=True):
        shown = np.clip(image / image.max(), 1e-4, 1)
        drawn = ax.imshow(shown, cmap="magma", norm=LogNorm(1e-4, 1), extent=(half, -half, -half, half))
        ax.set(title=title, xlabel="east [arcsec]", ylabel="north [arcsec]" if ax is axes[0] else "")
        for mark in marks:
            angle, away = math.radians(mark["position_angle"]), mark["separation"] / 1000
            ax.plot(
                away * math.sin(angle), away * math.cos(angle), "o", color=COLORS[4], markersize=13, fillstyle="none"
            )
    figure.colorbar(drawn, ax=axes, label="fraction of the peak", shrink=0.85)
    return figure


@styled
def search_figure(offsets: Tensor, maps: dict[str, Tensor], separation: np.ndarray, limit: np.ndarray) -> Figure:
    """Contrast over the limit at its separation [arcsec] wherever a companion was looked for, and the limit itself."""
    figure = new_figure(2.7 * len(maps) + 3.9, 3.4)
    axes = figure.subplots(1, len(maps) + 1, width_ratios=[1.0] * len(maps) + [1.25])
    east, north = (offsets / ARCSEC).T.numpy()
    away = np.hypot(east, north)
    for ax, (title, contrast) in zip(axes, maps.items(), strict=False):
        ratio = contrast.numpy() / np.interp(away, separation, limit)
        drawn = ax.scatter(east, north, c=ratio, cmap="RdBu_r", vmin=-2, vmax=2, s=19, marker="s", linewidths=0)
        ax.set(title=title, xlabel="east [arcsec]", ylabel="north [arcsec]" if ax is axes[0] else "", aspect="equal")
        ax.invert_xaxis()
    figure.colorbar(drawn, ax=list(axes[:-1]), label="contrast / limit", shrink=0.85)
    ax = axes[-1]
    for color, (title, contrast) in zip((COLORS[1], FAINT, COLORS[2]), maps.items(), strict=False):
        ax.plot(away, contrast.abs().numpy(), ".", linestyle="none", markersize=3, color=color, label=title)
    ax.plot(separation, limit, color=COLORS[0], label="limit")
    ax.set(xlabel="separation [arcsec]", ylabel="contrast", yscale="log", ylim=(2e-5, 2), title="detection limit")
    ax.legend(loc="upper left", markerscale=2)
    return figure


@styled
def exposures_figure(exposures: Exposures, fit: Fit, radius: float) -> Figure:
    """The first exposure, the model of it, and what is left, in units of the peak."""
    from matplotlib.colors import LogNorm

    peak = float(fit.images[0].max())
    figure = new_figure(9.6, 3.2)
    axes = figure.subplots(1, 3)
    data = torch.where(exposures.valid[0], exposures.frames[0], torch.nan)
    for ax, title, image in zip(axes, ("exposure", "model"), (data, fit.images[0]), strict=False):
        drawn = ax.imshow((image / peak).clamp(min=1e-4).numpy(), cmap="magma", norm=LogNorm(1e-4, 1), origin="lower")
        ax.set_title(title)
    figure.colorbar(drawn, ax=list(axes[:2]), label="fraction of the peak", shrink=0.85)
    y, x = np.mgrid[: data.shape[0], : data.shape[1]]
    far = torch.from_numpy(np.hypot(y - data.shape[0] // 2, x - data.shape[1] // 2) > radius)
    left = torch.where(far, torch.nan, (data - fit.images[0]) / peak)
    drawn = axes[2].imshow(left.numpy(), cmap="RdBu_r", vmin=-0.01, vmax=0.01, origin="lower")
    axes[2].set_title("exposure - model")
    figure.colorbar(drawn, ax=axes[2], label="fraction of the peak", shrink=0.85)
    return figure
