"""Companions in squared visibilities and closure phases: found where they are, with errors and limits that hold."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from torchmask.grid import Grid
from torchmask.interferometry.companion_map import map_companions, raster, rival_place
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.measurements import Measurements, join
from torchmask.interferometry.pair_fit import fit_pair
from torchmask.interferometry.pair_limits import pair_limits
from torchmask.interferometry.pair_model import PairResiduals, pair_visibilities
from torchmask.observation import Observation
from torchmask.optics.aperture import SparseAperture

TRUTH = torch.tensor([0.08, 1.1e-7 * 4, -0.6e-7 * 4], dtype=torch.float64)
SEEDS = 60


def pull_statistics(pulls):
    """Mean in units of its standard error, and the variance's distance from 1 in units of its own."""
    n = len(pulls)
    return pulls.mean(0) * math.sqrt(n), (pulls.var(0) - 1) / math.sqrt(2 / n)


@pytest.mark.parametrize("contrast", [0.02, 0.6, 0.95])
def test_without_noise_the_companion_is_found_exactly(contrast, measure_pair):
    truth = torch.cat([torch.tensor([contrast], dtype=torch.float64), TRUTH[1:]])
    seen = measure_pair(truth)
    found = map_companions(seen)
    best = found.best
    assert torch.linalg.vector_norm(best[1:] - truth[1:]) < seen.finest / 8
    fit = fit_pair(seen, best)
    assert fit.companion[0] == pytest.approx(contrast, rel=1e-6)
    torch.testing.assert_close(fit.companion[1:], truth[1:], rtol=1e-5, atol=0)
    assert fit.chi_square < 1e-9


def test_the_errors_are_those_that_occur(measure_pair):
    pulls, chi_squares = [], []
    for seed in range(SEEDS):
        fit = fit_pair(measure_pair(TRUTH, seed), TRUTH)
        pulls.append((fit.companion - TRUTH) @ torch.linalg.inv(torch.linalg.cholesky(fit.covariance)).T)
        chi_squares.append(fit.chi_square)
    mean, variance = pull_statistics(torch.stack(pulls))
    # errors grow with a chi-square above its expectation, by a few percent on average
    assert mean.abs().max() < 4
    assert (variance + 1.0).abs().max() < 4
    expected = fit.degrees_of_freedom
    assert expected == 22
    scatter = math.sqrt(2 * expected / SEEDS)
    assert abs(sum(chi_squares) / SEEDS - expected) < 4 * scatter


def test_errors_that_were_told_too_small_grow_with_what_is_left(measure_pair):
    pulls = []
    for seed in range(SEEDS):
        fit = fit_pair(measure_pair(TRUTH, seed, told=0.3), TRUTH)
        pulls.append((fit.companion - TRUTH) / fit.covariance.diagonal().sqrt())
    mean, variance = pull_statistics(torch.stack(pulls))
    assert mean.abs().max() < 4
    # Student's t of 22 degrees of freedom has a variance of 22/20, and a kurtosis of 6/18
    assert (variance * math.sqrt(2 / SEEDS) + 1 - 1.1).abs().max() < 4 * 1.1 * math.sqrt((2 + 6 / 18) / SEEDS)


def test_fringes_stronger_than_those_of_a_star_are_no_companion(measure_pair):
    """As of a calibrator that is resolved: what fits best takes light away, however clearly."""
    dark = TRUTH * torch.tensor([-1.0, 1.0, 1.0])
    fit = fit_pair(measure_pair(dark), dark)
    assert float(fit.companion[0]) == pytest.approx(-0.08)
    assert fit.explained
    assert fit.significance > 5
    assert not fit.detected


def test_errors_never_fall_below_those_of_the_measurements(measure_pair):
    """Without noise nothing is left, which would be no reason to trust the measurements any more than they say."""
    seen = measure_pair(TRUTH)
    fit, found = fit_pair(seen, TRUTH), map_companions(seen, TRUTH[None, 1:])
    problem = PairResiduals(seen)
    scaled = torch.autograd.functional.jacobian(lambda x: problem.residuals(x * problem.unit), TRUTH / problem.unit)
    expected = torch.linalg.inv(scaled.T @ scaled) * problem.unit[:, None] * problem.unit
    torch.testing.assert_close(fit.covariance, expected, rtol=1e-6, atol=0)
    # at a known place only the contrast is unknown
    assert float(found.errors) == pytest.approx(float(scaled[:, 0].square().sum().rsqrt()), rel=1e-6)
    assert float(found.significance) == pytest.approx(math.sqrt(found.star_chi_square), rel=1e-6)
    assert found.degrees_of_freedom == fit.degrees_of_freedom == 25 - 3


def test_what_errors_half_as_large_again_do_not_explain_is_no_companion(measure_pair):
    fits = [fit_pair(measure_pair(TRUTH, seed, told=told), TRUTH) for told in (1.0, 1 / 1.5, 0.3) for seed in range(8)]
    assert [fit.explained for fit in fits] == 16 * [True] + 8 * [False]
    assert [fit.detected for fit in fits] == [fit.explained for fit in fits]
    assert min(fit.significance for fit in fits) > 5
    assert fits[0].limit == pytest.approx(1.5**2 * (22 + 5 * math.sqrt(44)), rel=1e-12)
    assert replace(fits[0], chi_square=fits[0].limit).explained
    assert not replace(fits[0], chi_square=1.001 * fits[0].limit).explained


def test_a_star_alone_is_as_significant_as_chance(measure_pair):
    place = TRUTH[None, 1:]
    maps = [map_companions(measure_pair(seed=seed), place) for seed in range(SEEDS)]
    pulls = torch.cat([found.contrast / found.errors for found in maps])
    mean, variance = pull_statistics(pulls)
    assert abs(mean) < 4
    assert variance < 4  # errors count what chance leaves above the expectation
    assert variance > -4 - 0.15 / math.sqrt(2 / SEEDS)
    linear = torch.cat([found.significance for found in maps])
    assert torch.allclose(linear, pulls, atol=0.15, rtol=0.15)


@pytest.mark.parametrize(("shortest", "most"), [(2.0, 1.25), (0.05, 25.0)])
def test_a_raster_ends_at_half_the_widest_fringe_and_at_25_of_the_finest(shortest, most):
    """Baselines up to 5 m; separations in periods of their fringe, eight points to each."""
    baselines = torch.tensor([[shortest, 0.0], [0.0, -5.0], [1.2, 1.6]], dtype=torch.float64)
    one, none = torch.ones(3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    seen = Measurements(
        baselines, 2e-6 * one, one, 0.01 * one, None, torch.zeros(0, 2, 2, dtype=torch.float64), none, none, none, None
    )
    radius = torch.linalg.vector_norm(raster(seen), dim=1) / (2e-6 / 5)
    line = np.arange(-220, 221) / 8
    expected = np.hypot(*np.meshgrid(line, line))
    assert len(radius) == ((expected > 0.5) & (expected < most)).sum()
    assert 0.5 < radius.min() < radius.max() < most


def test_closure_phases_alone_and_several_observations(measure_pair):
    one, other = measure_pair(TRUTH, 1), measure_pair(TRUTH, 2)
    alone, both = fit_pair(one, TRUTH), fit_pair(join([one, other]), TRUTH)
    closures = fit_pair(one.closures_only(), TRUTH)
    assert closures.degrees_of_freedom == 10 - 3
    assert both.degrees_of_freedom == 2 * 25 - 3
    assert closures.covariance[0, 0] > alone.covariance[0, 0] > both.covariance[0, 0]
    assert (closures.companion - TRUTH).abs().div(closures.covariance.diagonal().sqrt()).max() < 4


def test_a_companion_in_front_of_a_mask_is_found_after_calibration(expose_points):
    # Frames of a binary and of a star, divided; a hole's diffraction pattern dims what is away from the middle.
    mask = SparseAperture([[0.0, 0.42], [0.38, -0.2], [-0.4, -0.15], [0.1, -0.05], [-0.2, 0.28], [0.3, 0.22]], 0.1, 1.0)
    grid = Grid.nyquist(mask.extent, 550e-9, 48, 1.1)
    generator = torch.Generator().manual_seed(3)

    def observe(stars):
        frames = torch.poisson(expose_points(mask, grid, stars, electrons=1e6, n_frames=12), generator)
        return frame_observables(Observation(frames, mask, grid, 0.0)).measurements(grid.wavelength)

    seen = observe(((0, 0, 1), (1.8, -1.2, 0.05))).calibrate(observe(((0, 0, 1),)))
    truth = torch.tensor([0.05, 1.8 * grid.pixel_scale, -1.2 * grid.pixel_scale], dtype=torch.float64)
    fit = fit_pair(seen, map_companions(seen).best)
    errors = fit.covariance.diagonal().sqrt()
    assert fit.significance > 10
    # dimmed by 2 to 3 %, and moved by a hundredth, which the fringes' envelopes take up
    assert (fit.companion - truth).abs()[0] < 4 * errors[0] + 0.05 * truth[0]
    assert ((fit.companion - truth).abs() < 4 * errors + 0.02 * truth.abs())[1:].all()
    nothing = observe(((0, 0, 1),)).calibrate(observe(((0, 0, 1),)))
    assert fit_pair(nothing, map_companions(nothing).best).significance < 5


def test_what_cannot_be_is_refused(measure_pair):
    seen = measure_pair(TRUTH)
    with pytest.raises(ValueError, match=r"from 0\.3 to 0\.2 arcsec: the first must"):
        raster(seen, 0.3 * math.pi / 648000, 0.2 * math.pi / 648000)
    with pytest.raises(ValueError, match="to inf arcsec: the first must"):
        raster(seen, most=math.inf)
    with pytest.raises(ValueError, match=r"the largest separation \[arcsec\] is 1e\+09: that takes at least .* GiB"):
        raster(seen, most=1e9 * math.pi / 648000)
    with pytest.raises(ValueError, match="no point lies between"):
        raster(seen, 0.0, 1e-12)
    few = seen.closures_only()
    two = type(seen)(
        *(few.baselines, few.wavelengths, few.vis2, few.vis2_errors, None, few.triangles[:2]),
        *(few.triangle_wavelengths[:2], few.closure_phases[:2], few.closure_errors[:2], None),
    )
    with pytest.raises(ValueError, match="there are 2 independent measurements"):
        map_companions(two)
    line = torch.tensor([[1.0, 0.0]], dtype=torch.float64) * torch.arange(1, 6, dtype=torch.float64)[:, None]
    flat = type(seen)(
        *(line, seen.wavelengths[:5], seen.vis2[:5], seen.vis2_errors[:5], None, few.triangles[:0]),
        *(few.wavelengths, few.closure_phases[:0], few.closure_errors[:0], None),
    )
    for look in (map_companions, lambda measured: fit_pair(measured, TRUTH)):
        with pytest.raises(ValueError, match="all baselines have one direction"):
            look(flat)


def test_where_fringes_repeat_no_companion_would_be_found():
    """At a whole period of the lattice of these holes |V|^2 are those of the star alone, whatever the contrast."""
    stations = torch.tensor([[0, 0], [3, 0], [1, 1], [2, 1]], dtype=torch.float64)
    pairs = torch.combinations(torch.arange(4))
    baselines, none = stations[pairs[:, 1]] - stations[pairs[:, 0]], torch.zeros(0, dtype=torch.float64)
    truth = torch.tensor([0.1, 2e-7, 1e-7], dtype=torch.float64)
    power = pair_visibilities(baselines / 2e-6, truth).abs() ** 2
    ones = torch.ones_like(power)
    seen = Measurements(
        *(baselines, 2e-6 * ones, power, 0.01 * ones, None, none.view(0, 2, 2), none, none, none, None),
    )
    period = torch.tensor([[2e-6, 0.0]], dtype=torch.float64)
    found = map_companions(seen, torch.cat([truth[None, 1:], period]))
    assert float(found.contrast[0]) == pytest.approx(0.1, rel=1e-6)
    assert found.contrast.isfinite().all()
    assert found.errors[1] > 1e6
    assert pair_limits(seen, fit_pair(seen, truth), found.offsets, 1e-6).contrast[-1] > 1e6


def test_a_place_that_fits_as_well_is_named_and_no_worse_one(measure_pair):
    """Baselines on a lattice see the same a period away; those of six other holes tell where it is."""
    baselines = torch.tensor([[1, 0], [0, 1], [3, 1], [1, 2], [2, 3]], dtype=torch.float64)
    ones, none = torch.ones(5, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    truth = torch.tensor([0.1, 6e-7, 3e-7], dtype=torch.float64)
    vis2 = pair_visibilities(baselines / 2e-6, truth).abs() ** 2
    seen = Measurements(baselines, 2e-6 * ones, vis2, 0.01 * ones, None, none.view(0, 2, 2), none, none, none, None)
    fit = fit_pair(seen, truth, most=2e-6)
    place, chi_square = rival_place(seen, map_companions(seen, raster(seen, most=2e-6)), fit)
    assert chi_square < 1e-3
    periods = [(place[1:] - sign * truth[1:]) / 2e-6 for sign in (1, -1)]
    assert min(float((each - each.round()).abs().max()) for each in periods) < 1e-3
    assert max(float(each.abs().max()) for each in periods) > 0.5
    assert rival_place(seen, map_companions(seen), fit_pair(seen, truth)) is None
    one = measure_pair(TRUTH, 0)
    assert rival_place(one, map_companions(one), fit_pair(one, TRUTH)) is None
