"""The radial mean of a transfer function on a grid that is not square has the frequencies of its own rings."""

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.viz.figures import mtf_figure

pytest.importorskip("matplotlib")


@pytest.mark.parametrize("shape", [(24, 48), (48, 24), (32, 32)])
def test_the_curve_of_a_modulus_that_is_the_frequency_is_the_diagonal(shape):
    grid = Grid(shape, 1e-7, 550e-9)
    nu_y, nu_x = grid.frequencies(torch.float64)
    curve = mtf_figure({"straight": torch.hypot(nu_y, nu_x)}, grid).axes[1].lines[0]
    frequency, mean = (np.asarray(values) for values in (curve.get_xdata(), curve.get_ydata()))
    assert frequency[-1] == 0.5
    # all of a ring is within half its width of the frequency that stands for it
    assert np.abs(mean - frequency).max() <= 0.5 / min(shape) + 1e-12
