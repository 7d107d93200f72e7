"""Chi-squares of measurements with errors of their own and strong correlations, by the inverse of the covariance."""

import pytest
import torch

from torchmask.interferometry.measurements import Measurements
from torchmask.interferometry.pair_model import PairResiduals, pair_visibilities, square

SIDES = torch.tensor([[3.0, 0.4], [-1.0, 2.2], [0.7, -2.9], [2.1, 1.8]], dtype=torch.float64)
VIS2_ERRORS = torch.tensor([0.01, 0.02, 0.05, 0.3], dtype=torch.float64)
CLOSURE_ERRORS = torch.tensor([0.02, 0.1, 0.4], dtype=torch.float64)


def shared(n, part):
    """The correlation of `n` errors that have a `part` of their variance in common: eigenvalues 1 - part and above."""
    return (1 - part) * torch.eye(n, dtype=torch.float64) + part


def covariance(errors, part):
    return shared(len(errors), part) * errors * errors[:, None]


@pytest.mark.parametrize("part", [0.0, 0.5, 0.999])
def test_chi_square_is_that_of_the_inverse_covariance(part):
    triangles = torch.stack([SIDES[:3], SIDES[1:]], 1)
    generator = torch.Generator().manual_seed(0)
    vis2 = 0.8 + 0.1 * torch.rand(4, generator=generator, dtype=torch.float64)
    closures = 0.1 * torch.randn(3, generator=generator, dtype=torch.float64)
    wavelengths = torch.full((4,), 2e-6, dtype=torch.float64)
    correlations = (shared(4, part), shared(3, part)) if part else (None, None)
    measured = Measurements(
        *(SIDES, wavelengths, vis2, VIS2_ERRORS, correlations[0]),
        *(triangles, wavelengths[:3], closures, CLOSURE_ERRORS, correlations[1]),
    )
    companion = torch.tensor([0.1, 8e-8, -5e-8], dtype=torch.float64)
    whole = torch.cat([triangles, -triangles.sum(1, keepdim=True)], 1)  # the third side closes it
    away = vis2 - pair_visibilities(SIDES / 2e-6, companion).abs() ** 2
    of_sides = pair_visibilities(whole.flatten(0, 1) / 2e-6, companion).view(3, 3)
    turned = closures - of_sides.prod(-1).angle()
    expected = sum(
        float(one @ torch.linalg.solve(covariance(errors, part), one))
        for one, errors in ((away, VIS2_ERRORS), (turned, CLOSURE_ERRORS))
    )
    problem = PairResiduals(measured)
    assert problem.size == 7
    # rounding, enlarged by the condition of a correlation of 0.999
    assert square(problem.residuals(companion)) == pytest.approx(expected, rel=1e-10)
