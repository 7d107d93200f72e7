"""A figure that compares restorations with the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from torchmask.io import as_array
from torchmask.metrics import align, lowpass, relative_error
from torchmask.viz import style as drawing
from torchmask.viz.figures import peak

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@drawing.styled
def comparison_figure(
    truth: Any,
    results: Mapping[str, tuple[Any, Any]],
    cutoff: float,
    pixel_scale: float | None = None,
    sky: Any | None = None,
) -> Figure:
    """Draw the truth, its diffraction limit, and for each instrument an exposure and the restoration with their scores.

    Parameters
    ----------
    truth : (H, W) tensor or array
        True object.
    results : mapping of name to (frame (H, W), restoration (H, W))
        An exposure and the restoration of each instrument.
    cutoff : float
        Cut-off frequency of the scores and of the diffraction limit [cycles/pixel].
    pixel_scale : float, optional
        Angle of a pixel [rad], to draw a scale bar.
    sky : (2, 2) tensor or array, optional
        Matrix from pixels (x, y) to the sky, as `Observation.sky_matrix`, to draw arrows to north and east.

    Notes
    -----
    All images share one grey scale, from 0 to the 99.5th percentile of the diffraction-limited truth, with a
    square-root stretch. Restorations are registered and scaled as for their score (`torchmask.metrics.align`); frames
    are only scaled to the flux of the truth. Scores and errors raised are those of `torchmask.metrics.relative_error`.
    """
    images = _comparison_images(truth, drawing.not_empty(results), cutoff)
    n = len(results)
    if n == 1:
        layout: list[Any] = [["truth", "limit", "frame 0", "restored 0"]]
    else:
        first = ["truth", "limit"] + ["."] * (n - 2)
        layout = [[first[k], f"frame {k}", f"restored {k}"] for k in range(n)]
    figure = drawing.new_figure(2.6 * len(layout[0]), 3.1 * len(layout))
    norm = drawing.light_norm(peak(images["limit"][1]))
    axes = figure.subplot_mosaic(layout)
    for key, ax in axes.items():
        title, image = images[key]
        ax.imshow(image, cmap="gray", norm=norm)
        ax.set(title=title, xticks=[], yticks=[])
        if key == "truth" and pixel_scale is not None:
            drawing.scale_bar(ax, image.shape[1], pixel_scale)
        if key == "truth" and sky is not None:
            drawing.compass(ax, sky)
    drawing.light_bar(figure, list(axes.values()))
    return figure


def _comparison_images(
    truth: Any, results: Mapping[str, tuple[Any, Any]], cutoff: float
) -> dict[str, tuple[str, np.ndarray]]:
    reference = as_array(truth).astype(float)
    limit = lowpass(reference, cutoff).numpy()
    images = {"truth": ("truth", reference), "limit": ("truth at the diffraction limit", limit)}
    for k, (name, (frame, restored)) in enumerate(results.items()):
        raw = as_array(frame).astype(float)
        images[f"frame {k}"] = (
            f"{name}\none exposure, score {relative_error(raw, reference, cutoff):.3f}",
            raw * (reference.sum() / raw.sum()),
        )
        images[f"restored {k}"] = (
            f"{name}\nrestored, score {relative_error(restored, reference, cutoff):.3f}",
            align(restored, reference, cutoff).numpy(),
        )
    return images
