"""Figures: masks, frequency coverage, transfer functions, images and curves."""

from torchmask.viz.companion import companion_figure
from torchmask.viz.comparison import comparison_figure
from torchmask.viz.figures import (
    frames_figure,
    history_figure,
    mask_figure,
    mtf_figure,
    psf_figure,
    stretch,
    uv_coverage_figure,
)
from torchmask.viz.planning import plan_figure

__all__ = [
    "companion_figure",
    "comparison_figure",
    "frames_figure",
    "history_figure",
    "mask_figure",
    "mtf_figure",
    "plan_figure",
    "psf_figure",
    "stretch",
    "uv_coverage_figure",
]
