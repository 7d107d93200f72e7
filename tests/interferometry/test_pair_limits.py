"""How faint a companion may be: beside a star, beside a companion that was found, and beside a resolved star."""

import math
from dataclasses import replace

import pytest
import torch
from torch.autograd.functional import jacobian

from torchmask.grid import ARCSEC
from torchmask.interferometry.companion_limits import MOSTLY
from torchmask.interferometry.companion_map import map_companions, raster
from torchmask.interferometry.disc_visibility import disc_visibilities
from torchmask.interferometry.pair_fit import PairVerdict, fit_pair
from torchmask.interferometry.pair_limits import contrast_errors, pair_limits
from torchmask.interferometry.pair_model import PairResiduals, pair_visibilities

TRUTH = torch.tensor([0.08, 4.4e-7, -2.4e-7], dtype=torch.float64)
SEEDS = 60


def limits_of(seen, offsets, annulus):
    return pair_limits(seen, fit_pair(seen, map_companions(seen).best), offsets, annulus)


def test_a_companion_at_the_limit_is_found_at_the_significance_of_the_limit(measure_pair):
    seen = measure_pair(seed=1000, rms=0.01)
    limits = limits_of(seen, raster(seen), 2 * seen.finest)
    assert (limits.errors > 0).all()
    contrast = limits(TRUTH[1:])[None]
    truth = torch.cat([contrast.double(), TRUTH[1:]])
    found = [map_companions(measure_pair(truth, seed), TRUTH[None, 1:]) for seed in range(SEEDS)]
    significance = torch.cat([each.contrast / each.errors for each in found])
    # 5 of them, as far as the limit of the ring is that of this place and its own chance allows
    slack = 5 * float(limits.errors[0] / limits.contrast[0])
    assert abs(float(significance.mean()) - 5) < slack + 4 / math.sqrt(SEEDS)
    assert float(significance.mean()) > 4


def test_the_error_of_a_limit_holds_its_scatter_and_that_of_the_errors_themselves(measure_pair):
    """Errors scaled by a chi-square of n degrees of freedom are known to 1 / (2 n)^(1/2) of themselves."""
    seen = measure_pair(seed=0)
    places = torch.tensor([[0.0, 0.4], [-0.8, 0.0], [0.0, -1.2], [1.6, 0.0]], dtype=torch.float64) * ARCSEC / 10
    fit = fit_pair(seen, map_companions(seen).best)
    assert fit.verdict is PairVerdict.NONE
    assert fit.chi_square < 22
    first, second, third, fourth = contrast_errors(seen, fit, places).tolist()
    found = pair_limits(seen, fit, places, 0.1 * ARCSEC, 3.0)
    own = 1 / math.sqrt(2 * 22)
    assert found.separation == pytest.approx([0.06, 0.14], rel=1e-12)
    rms = [math.hypot(first, second) / math.sqrt(2), math.hypot(third, fourth) / math.sqrt(2)]
    assert found.contrast == pytest.approx([3 * value for value in rms], rel=1e-12)
    scatter = [abs(first - second) / 2, abs(third - fourth) / 2]
    expected = [3 * math.hypot(one, own * value) for one, value in zip(scatter, rms, strict=True)]
    assert found.errors == pytest.approx(expected, rel=1e-12)


def test_errors_are_those_of_a_joint_fit_of_both_companions(measure_pair):
    """The curvature of chi-square in the companion that is known and one of no light, in units of the star's."""
    seen = measure_pair(TRUTH)
    fit, problem = fit_pair(seen, TRUTH), PairResiduals(seen)
    assert fit.detected
    place = torch.tensor([-2e-7, -3e-7], dtype=torch.float64)

    def residuals(parameters):
        known, extra = parameters[:3] * problem.unit, parameters[3]
        values = []
        for frequencies in (problem.frequencies, problem.sides):
            pair = (1 + known[0]) * pair_visibilities(frequencies, known)
            turn = -2 * math.pi * (frequencies @ place)
            values.append((pair + extra * torch.complex(turn.cos(), turn.sin())) / (1 + known[0] + extra))
        return problem.left_by(*values)

    slopes = jacobian(residuals, torch.cat([TRUTH / problem.unit, torch.zeros(1, dtype=torch.float64)]))
    expected = torch.linalg.inv(slopes.T @ slopes)[3, 3].sqrt()
    torch.testing.assert_close(contrast_errors(seen, fit, place[None])[0], expected, rtol=1e-6, atol=0)


def test_limits_beside_a_companion_are_about_those_of_the_star_alone(measure_pair):
    """Not polluted by it: they were up to seven times larger beside a companion of a fifth of the star's light."""
    star = measure_pair(seed=0, rms=0.002)
    alone = limits_of(star, raster(star), star.finest)
    for contrast in (0.02, 0.2, 0.5):
        truth = torch.cat([torch.tensor([contrast], dtype=torch.float64), TRUTH[1:]])
        seen = measure_pair(truth, 0, rms=0.002)
        ratio = limits_of(seen, raster(seen), seen.finest).contrast / alone.contrast
        # some of the 25 numbers are spent on the known companion, and fringes of less contrast tell less
        assert ratio.min() > 0.9
        assert ratio.max() < 2 * (1 + contrast)
    assert len(alone.contrast) > 1


def test_limits_beside_a_resolved_star_are_about_those_of_a_point(measure_pair):
    star = measure_pair(seed=0, rms=0.002)
    size = 0.4 * star.finest
    seen = replace(star, vis2=star.vis2 - 1 + disc_visibilities(star.frequencies, size) ** 2)
    fit = fit_pair(seen, map_companions(seen).best)
    assert fit.verdict is PairVerdict.RESOLVED
    ratio = limits_of(seen, raster(seen), star.finest).contrast / limits_of(star, raster(star), star.finest).contrast
    assert ratio.min() > 0.7
    assert ratio.max() < 2


@pytest.mark.parametrize(("factor", "share"), [(1.0, 0.5), (MOSTLY, 0.9)])
def test_a_companion_at_the_limit_is_found_half_of_the_time_and_a_brighter_one_mostly(factor, share, measure_pair):
    """Searched for anew each time, at the separation of a limit in any direction."""
    seen = measure_pair(seed=1000, rms=0.005)
    limits = limits_of(seen, raster(seen), seen.finest)
    found = []
    for seed in range(SEEDS):
        angle = torch.tensor(2 * math.pi * seed / SEEDS, dtype=torch.float64)
        place = limits.separation[0] * ARCSEC * torch.stack([angle.cos(), angle.sin()])
        truth = torch.cat([torch.tensor([factor * limits.contrast[0]], dtype=torch.float64), place])
        one = measure_pair(truth, seed, rms=0.005)
        found.append(fit_pair(one, map_companions(one).best).detected)
    # the limit is that of a ring whose errors scatter, and the search takes the place where chance helps most
    assert abs(sum(found) / SEEDS - share) < 4 * math.sqrt(share * (1 - share) / SEEDS)
