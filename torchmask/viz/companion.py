"""A figure of where a companion may be, and how faint one would have been found."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from torchmask.interferometry.companion_limits import DetectionLimits
from torchmask.interferometry.companion_map import CompanionMap
from torchmask.viz import style as drawing

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_ARCSEC = drawing.angle_unit(1.0)[1]
_MAGNITUDE = 2.5 / np.log(10)
_POINTS: dict[str, Any] = {"color": drawing.COLORS[0], "marker": "o", "capsize": 2}


@drawing.styled
def companion_figure(found: CompanionMap, limits: DetectionLimits) -> Figure:
    """Draw how significant a companion is at each place around the star, east to the left, and the limits beside it.

    `found` is a map on a square raster, as `map_companions` makes it by default. The star is the cross, the circle
    stands around the most significant companion.
    """
    from matplotlib.colors import TwoSlopeNorm

    figure, (ax, beside) = drawing.row_of_axes([1.0, 1.1], height=3.6)
    east, north = found.offsets.numpy().T
    unit, scale = drawing.angle_unit(float(np.abs(found.offsets.numpy()).max()))
    xs, column = np.unique(np.round(east * scale, 9), return_inverse=True)
    ys, row = np.unique(np.round(north * scale, 9), return_inverse=True)
    image = np.full((len(ys), len(xs)), np.nan)
    image[row, column] = found.significance.numpy()
    step = float(np.diff(xs).min()) if len(xs) > 1 else 1.0
    extent = (xs[0] - step / 2, xs[-1] + step / 2, ys[0] - step / 2, ys[-1] + step / 2)
    most = max(5.0, float(np.nanmax(np.abs(image))))
    ax.imshow(image, cmap="RdBu_r", norm=TwoSlopeNorm(0, -most, most), origin="lower", extent=extent)
    place = found.best[1:].numpy() * scale
    ax.plot(0, 0, "+", color=drawing.INK)
    ax.plot(*place, "o", markersize=11, markerfacecolor="none", markeredgecolor=drawing.INK)
    ax.set(xlim=(extent[1], extent[0]), title="significance of a companion")
    ax.set(xlabel=f"east [{unit}]", ylabel=f"north [{unit}]")
    drawing.colorbar(figure, [ax], "standard errors")
    factor = scale / _ARCSEC
    shown = limits.contrast <= 1  # beyond, no companion would be found
    separation, contrast, errors = (values[shown] for values in (limits.separation, limits.contrast, limits.errors))
    beside.errorbar(separation * factor, -_MAGNITUDE * np.log(contrast), _MAGNITUDE * errors / contrast, **_POINTS)
    beside.invert_yaxis()  # the brighter, the higher
    beside.set(xlabel=f"separation [{unit}]", ylabel="magnitude difference")
    beside.set_title("faintest companion that would be found")
    return figure
