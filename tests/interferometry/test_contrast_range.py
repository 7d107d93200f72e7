"""Contrasts of a map stay where the model of a star and its companion means something."""

import pytest
import torch

from torchmask.interferometry.pair_model import PairResiduals


@pytest.mark.parametrize(("contrast", "nearest"), [(-0.7, -0.5), (0.999, 0.98), (0.3, 0.3)])
def test_a_contrast_outside_of_the_range_ends_at_its_border(measure_pair, contrast, nearest):
    """From -1 on the light of both is negative, and at 1 the derivatives in the contrast vanish."""
    place = [4.4e-7, -2.4e-7]
    problem = PairResiduals(measure_pair(torch.tensor([contrast, *place], dtype=torch.float64)))
    found, error, chi_square = problem.best_contrasts(torch.tensor([place], dtype=torch.float64))
    # inside, twelve Gauss-Newton steps on exact data end at rounding
    assert float(found) == pytest.approx(nearest, abs=1e-9)
    assert bool(torch.isfinite(error).all() & torch.isfinite(chi_square).all())
