"""Uniform discs: closed form, derivatives, and a fit with the error that occurs."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import j1

from torchmask.interferometry.disc_model import disc_residuals, disc_slope, fit_disc
from torchmask.interferometry.disc_visibility import disc_slopes, disc_visibilities
from torchmask.interferometry.pair_model import PairResiduals

SEEDS = 40


@pytest.fixture(scope="module")
def measure_disc(measure_pair):
    """Measurements of a uniform disc [rad], with the noise of those of a star."""

    def measure(diameter, seed=None):
        star = measure_pair(seed=seed)
        return replace(star, vis2=star.vis2 - 1 + disc_visibilities(star.frequencies, diameter) ** 2)

    return measure


def test_the_closed_form():
    frequencies = torch.tensor([[3e6, 4e6], [0.0, 1.0], [-1e7, 0.0]], dtype=torch.float64)
    sizes = torch.tensor([1e-9, 2e-7], dtype=torch.float64)
    x = math.pi * np.outer(sizes, [5e6, 1.0, 1e7])
    np.testing.assert_allclose(disc_visibilities(frequencies, sizes), 2 * j1(x) / x, rtol=1e-12)
    assert disc_visibilities(frequencies, 0.0).tolist() == [1.0, 1.0, 1.0]


def test_slopes_are_those_of_the_visibilities(measure_disc):
    frequencies = torch.tensor([[3e6, 4e6], [0.0, 100.0], [-1e7, 0.0]], dtype=torch.float64)
    for diameter in (1e-11, 1e-7, 3e-7):
        step = 1e-4 * diameter
        ends = [disc_visibilities(frequencies, diameter + sign * step) for sign in (1, -1)]
        # rounding of 1 over the step
        expected = (ends[0] - ends[1]) / (2 * step)
        torch.testing.assert_close(disc_slopes(frequencies, diameter), expected, rtol=1e-6, atol=1e-15 / step)
    problem = PairResiduals(measure_disc(1e-7, seed=0))
    ends = disc_residuals(problem, torch.tensor([0.9999e-7, 1.0001e-7], dtype=torch.float64))
    torch.testing.assert_close(disc_slope(problem, 1e-7), (ends[0] - ends[1]) / 2e-11, rtol=1e-5, atol=1e-3)


@pytest.mark.parametrize("diameter", [0.0, 4e-8, 3e-7, 1.2e-6])
def test_without_noise_a_disc_is_found_exactly(diameter, measure_disc):
    """From a tenth of the finest fringe to three of it, whose long baselines see the third lobe."""
    seen = measure_disc(diameter)
    sides = disc_visibilities(seen.triangle_frequencies.flatten(0, 1), diameter).unflatten(0, (-1, 3)).prod(1)
    seen = replace(seen, closure_phases=torch.where(sides < 0, math.pi, 0.0).double())
    fit = fit_disc(PairResiduals(seen))
    assert fit.diameter == pytest.approx(diameter, rel=1e-6, abs=1e-8 * seen.finest)
    assert fit.chi_square < 1e-6


def test_the_error_is_that_which_occurs(measure_disc):
    fits = [fit_disc(PairResiduals(measure_disc(1.5e-7, seed))) for seed in range(SEEDS)]
    pulls = torch.tensor([(fit.diameter - 1.5e-7) / fit.error for fit in fits])
    assert abs(float(pulls.mean())) < 4 / math.sqrt(SEEDS)
    assert abs(float(pulls.var()) - 1) < 4 * math.sqrt(2 / SEEDS)
    chi_square = sum(fit.chi_square for fit in fits) / SEEDS
    assert abs(chi_square - 24) < 4 * math.sqrt(2 * 24 / SEEDS)
