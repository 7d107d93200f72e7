"""The figure of a companion's map: which place is drawn where."""

import numpy as np
import pytest
import torch

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import DetectionLimits, search_offsets
from torchmask.interferometry.companion_map import CompanionMap
from torchmask.viz.companion import companion_figure

pytest.importorskip("matplotlib")


def test_east_is_left_north_up_and_limits_are_magnitudes():
    offsets = search_offsets(0.05, 0.08, 0.4)
    contrast = torch.zeros(len(offsets), dtype=torch.float64)
    place = torch.tensor([0.3, -0.1], dtype=torch.float64) * ARCSEC
    best = int((offsets - place).norm(dim=1).argmin())
    contrast[best] = 0.05
    errors = torch.full_like(contrast, 0.002)
    chi_square = 700 - (contrast / errors) ** 2
    found = CompanionMap(offsets, contrast, errors, chi_square, float(chi_square.min()), 700.0, 75)
    limits = DetectionLimits(np.array([0.1, 0.2, 0.3]), np.full(3, 0.01), np.full(3, 0.001))
    figure = companion_figure(found, limits)
    image, beside = figure.axes[:2]
    assert image.get_xlim()[0] > image.get_xlim()[1]
    assert image.get_ylim()[0] < image.get_ylim()[1]
    shown = image.images[0]
    left, right, bottom, top = shown.get_extent()
    values = np.ma.filled(shown.get_array(), np.nan)
    row, column = np.unravel_index(np.nanargmax(values), values.shape)
    x = left + (column + 0.5) * (right - left) / values.shape[1]
    y = bottom + (row + 0.5) * (top - bottom) / values.shape[0]
    assert (x, y) == pytest.approx((300, -100))
    assert image.lines[1].get_xydata()[0] == pytest.approx([300, -100])
    assert beside.lines[0].get_ydata() == pytest.approx([5.0] * len(limits.contrast))
    assert beside.get_ylim()[0] > beside.get_ylim()[1]
    contrast = np.where(np.arange(len(limits.contrast)) == 0, np.inf, limits.contrast)
    beside = companion_figure(found, DetectionLimits(limits.separation, contrast, limits.errors)).axes[1]
    assert len(beside.lines[0].get_ydata()) == len(contrast) - 1  # where fringes repeat there is no limit
