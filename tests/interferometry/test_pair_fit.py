"""What a fit says of companions, of resolved stars, and of pairs closer or farther than the search."""

from dataclasses import replace

import pytest
import torch

from torchmask.interferometry.companion_map import map_companions, raster
from torchmask.interferometry.disc_visibility import disc_visibilities
from torchmask.interferometry.pair_fit import RIVAL, PairVerdict, fit_pair

DIRECTION = torch.tensor([0.6, -0.8], dtype=torch.float64)


def search(seen, least=None, most=None):
    return fit_pair(seen, map_companions(seen, raster(seen, least, most)).best, least, most)


@pytest.fixture
def pair_at(measure_pair):
    """Measurements of a pair at a separation in units of half the finest fringe."""

    def measure(contrast, separation, seed=0):
        place = separation * measure_pair().finest / 2 * DIRECTION
        truth = torch.cat([torch.tensor([contrast], dtype=torch.float64), place])
        return truth, measure_pair(truth, seed, rms=0.002)

    return measure


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("diameter", [0.15, 0.3, 0.6, 0.9])
def test_a_uniform_disc_is_resolved_and_no_companion(diameter, seed, measure_pair):
    """Diameters in periods of the finest fringe. The best pair is closer than the search, or does not fit."""
    star = measure_pair(seed=seed, rms=0.002)
    size = diameter * star.finest
    seen = replace(star, vis2=star.vis2 - 1 + disc_visibilities(star.frequencies, size) ** 2)
    fit = search(seen)
    assert fit.significance > 5
    assert fit.verdict is PairVerdict.RESOLVED
    assert fit.explained
    assert not fit.detected
    assert abs(fit.disc.diameter - size) < 4 * fit.disc.error
    assert fit.disc.chi_square < fit.limit


@pytest.mark.parametrize("contrast", [0.05, 0.3, 0.8])
@pytest.mark.parametrize("separation", [1.1, 1.5, 2.0, 2.5])
def test_companions_are_found_from_half_the_finest_fringe_on(contrast, separation, pair_at):
    for seed in range(3):
        truth, seen = pair_at(contrast, separation, seed)
        fit = search(seen)
        assert fit.verdict is PairVerdict.COMPANION
        assert fit.disc.chi_square - fit.chi_square > 10 * RIVAL
        assert ((fit.companion - truth).abs() < 4 * fit.covariance.diagonal().sqrt()).all()


def test_closer_pairs_are_companions_if_their_contrast_is_known_and_else_told_as_such(pair_at):
    truth, seen = pair_at(0.5, 0.75)
    fit = search(seen)
    assert fit.verdict is PairVerdict.COMPANION
    assert fit.separation < fit.separations[0]
    assert ((fit.companion - truth).abs() < 4 * fit.covariance.diagonal().sqrt()).all()
    fit = search(pair_at(0.3, 0.2)[1])
    assert fit.companion[0] < 5 * fit.covariance[0, 0].sqrt()
    assert fit.disc.chi_square - fit.chi_square > RIVAL
    assert fit.verdict is PairVerdict.OUTSIDE
    # a search that includes the place finds it
    assert search(pair_at(0.3, 0.2)[1], 0.1 * seen.finest / 2).verdict is PairVerdict.COMPANION


def test_what_lies_beyond_the_search_is_not_within_it(pair_at):
    truth, seen = pair_at(0.3, 2.0)
    fit = fit_pair(seen, truth, most=0.9 * float(truth[1:].norm()))
    assert fit.verdict is PairVerdict.OUTSIDE
    assert not fit.detected
    assert fit_pair(seen, truth).verdict is PairVerdict.COMPANION


@pytest.mark.parametrize("closures", [True, False])
def test_stars_of_equal_light_are_equal_within_their_errors(closures, measure_pair):
    """Whose |V|^2 alone are the same to first order for any two that are nearly equal."""
    truth = torch.tensor([1.0, 4.4e-7, -2.4e-7], dtype=torch.float64)
    away, errors = [], []
    for seed in range(12):
        seen = measure_pair(truth, seed)
        if not closures:
            seen = replace(
                seen,
                triangles=seen.triangles[:0],
                triangle_wavelengths=seen.triangle_wavelengths[:0],
                closure_phases=seen.closure_phases[:0],
                closure_errors=seen.closure_errors[:0],
                closure_correlation=None,
            )
        fit = fit_pair(seen, truth * torch.tensor([0.8, 1.03, 0.97], dtype=torch.float64))
        assert fit.verdict is PairVerdict.COMPANION
        assert fit.companion[0] <= 1
        away.append(1 - float(fit.companion[0]))
        errors.append(float(fit.covariance[0, 0].sqrt()))
    assert max(one / error for one, error in zip(away, errors, strict=True)) < 4
    assert max(errors) < 0.2
    assert min(away) < min(errors)
