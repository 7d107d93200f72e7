"""A star and its companion as visibilities: closed form, and residuals whose covariance is 1."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck
from torch.autograd.functional import jacobian

from torchmask.interferometry.pair_model import PairResiduals, pair_visibilities, square


def test_the_closed_form_of_another_hand(binary):
    pair = binary(3e-7, -1e-7, 0.2)
    baselines = 4 * np.random.default_rng(0).standard_normal((7, 2))
    found = pair_visibilities(torch.as_tensor(baselines) / 2e-6, torch.tensor([0.2, 3e-7, -1e-7], dtype=torch.float64))
    np.testing.assert_allclose(found.numpy(), pair.visibilities(baselines, 2e-6), rtol=1e-12)


def test_residuals_differentiate(measure_pair):
    truth = torch.tensor([0.3, 8e-8, -5e-8], dtype=torch.float64)
    problem = PairResiduals(measure_pair(truth, seed=0))
    for contrast in (0.0, 0.2):
        scaled = torch.tensor([contrast, 0.4, -0.2], dtype=torch.float64, requires_grad=True)
        assert gradcheck(lambda x: problem.residuals(x * problem.unit), scaled)
        at = (scaled * problem.unit).detach()
        torch.testing.assert_close(problem.slopes(at), -jacobian(problem.residuals, at))


def test_residuals_of_noise_are_independent_and_of_variance_one(measure_pair):
    # 15 squared visibilities, and of 20 closure phases only 10 that are independent
    n = 400
    none = torch.zeros(3, dtype=torch.float64)
    problems = [PairResiduals(measure_pair(seed=seed)) for seed in range(n)]
    draws = torch.stack([problem.residuals(none) for problem in problems])
    assert draws.shape == (n, 25)
    covariance = draws.T @ draws / n
    away = (covariance - torch.eye(25)).abs()
    # variances scatter by sqrt(2/n), covariances by 1/sqrt(n); 25 and 300 of them stay below 4.5 of it
    assert away.diagonal().max() < 4.5 * math.sqrt(2 / n)
    assert (away - away.diagonal().diag()).max() < 4.5 / math.sqrt(n)


@pytest.mark.parametrize("contrast", [1.0, 1.25])
def test_the_brighter_one_is_the_star(contrast, measure_pair):
    """A companion of more light than the star is the star, and the star its companion on the other side."""
    truth = torch.tensor([contrast, 4.4e-7, -2.4e-7], dtype=torch.float64)
    problem = PairResiduals(measure_pair(truth))
    found, residual = problem.descend(truth * torch.tensor([0.8, 1.03, 0.97], dtype=torch.float64), 40)
    assert float(found[0]) == pytest.approx(1 / contrast, abs=1e-4)
    assert min(float((found[1:] - sign * truth[1:]).norm()) for sign in (1, -1)) < 1e-3 * float(problem.unit[1])
    assert contrast == 1 or found[1] < 0
    assert square(residual) < 1e-3


def test_a_contrast_is_never_fitted_below_the_faintest(measure_pair):
    """Data of a star less 0.7 of itself elsewhere would lead there; from -1 on the light of both is negative."""
    truth = torch.tensor([-0.7, 4.4e-7, -2.4e-7], dtype=torch.float64)
    problem = PairResiduals(measure_pair(truth))
    assert square(problem.residuals(truth)) < 1e-9
    start = torch.cat([torch.tensor([-0.3], dtype=torch.float64), truth[1:]])
    found, residual = problem.descend(start, 40)
    assert -0.5 <= float(found[0]) < -0.49
    assert 1 < square(residual) < square(problem.residuals(start))
