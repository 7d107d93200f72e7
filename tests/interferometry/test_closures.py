"""Combinations of closure phases that sums of the baselines' phases can take."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from torchmask.atmosphere.phase import TurbulencePhase
from torchmask.grid import Grid
from torchmask.interferometry.closures import closure_combinations
from torchmask.interferometry.companion_map import map_companions
from torchmask.interferometry.fringes import frame_observables
from torchmask.interferometry.measurements import Measurements, join
from torchmask.interferometry.pair_fit import fit_pair
from torchmask.interferometry.pair_model import PairResiduals, square
from torchmask.optics.aperture import SparseAperture
from torchmask.optics.detector import Detector
from torchmask.simulation.exposures import simulate_observation

NONE = torch.zeros(0, dtype=torch.float64)
GRID = Grid.nyquist(1.0, 550e-9, 48)
MASK = SparseAperture.from_catalog("golay9", 1.0, fill_factor=0.15)


def closing(n_holes, seed, errors=None, phases=None):
    """Closure phases of all triangles of random holes, and the signs (C, B) of the phases that they sum."""
    stations = torch.rand(n_holes, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    pairs = {pair: index for index, pair in enumerate(itertools.combinations(range(n_holes), 2))}
    triangles = list(itertools.combinations(range(n_holes), 3))
    signs = torch.zeros(len(triangles), len(pairs), dtype=torch.float64)
    for row, (i, j, k) in enumerate(triangles):
        signs[row, pairs[i, j]] = signs[row, pairs[j, k]] = 1
        signs[row, pairs[i, k]] = -1
    sides = torch.stack([torch.stack([stations[j] - stations[i], stations[k] - stations[j]]) for i, j, k in triangles])
    covariance = signs @ signs.T
    errors = covariance.diagonal().sqrt() if errors is None else errors
    values = torch.zeros(len(triangles), dtype=torch.float64) if phases is None else signs @ phases
    at = torch.full_like(values, 550e-9)
    seen = Measurements(NONE.view(0, 2), NONE, NONE, NONE, None, sides, at, values, errors, covariance / 3)
    return seen, signs


@given(st.integers(3, 8), st.integers(0, 99))
@settings(deadline=None, max_examples=25)
def test_phases_of_n_holes_close_in_as_many_ways_as_a_first_hole_has_triangles(n_holes, seed):
    seen, signs = closing(n_holes, seed)
    found = closure_combinations(seen)
    assert found.shape[1] == (n_holes - 1) * (n_holes - 2) // 2
    torch.testing.assert_close(found.T @ found, torch.eye(found.shape[1], dtype=torch.float64))
    torch.testing.assert_close(found @ (found.T @ signs), signs, rtol=0, atol=1e-12)


def test_what_is_uncorrelated_counts_by_itself_and_sets_of_measurements_each():
    seen, _ = closing(5, 0)
    alone = Measurements(
        *(getattr(seen, name) for name in seen.__dataclass_fields__ if name != "closure_correlation"), None
    )
    assert torch.equal(closure_combinations(alone), torch.eye(10, dtype=torch.float64))
    both = closure_combinations(join([seen, seen]))
    assert both.shape == (20, 12)
    assert not bool((both[:10].abs().sum(0) * both[10:].abs().sum(0)).any())
    nothing = Measurements(
        NONE.view(0, 2), NONE, NONE, NONE, None, NONE.view(0, 2, 2), NONE, NONE, NONE, NONE.view(0, 0)
    )
    assert closure_combinations(nothing).shape == (0, 0)


@given(st.integers(0, 99), st.floats(1.0, 3.0))
@settings(deadline=None, max_examples=25)
def test_errors_that_are_told_unequally_make_no_residual_large(seed, unequal):
    """Errors of triangles that are up to so many times too large take chi-square down, by its square at most.

    That is so as independent combinations of these triangles have equal variances: the errors' factors are between 1
    and that number for each combination of them too.
    """
    generator = torch.Generator().manual_seed(seed)
    scale = 1 + (unequal - 1) * torch.rand(20, generator=generator, dtype=torch.float64)
    phases = 0.01 * torch.randn(15, generator=generator, dtype=torch.float64)
    _, signs = closing(6, seed)
    errors = 0.01 * (signs @ signs.T).diagonal().sqrt()
    none = torch.zeros(3, dtype=torch.float64)
    right, wrong = (PairResiduals(closing(6, seed, told, phases)[0]) for told in (errors, errors * scale))
    assert right.size == wrong.size == 10
    independent = torch.linalg.pinv(signs) @ signs @ phases / 0.01
    assert square(right.residuals(none)) == pytest.approx(square(independent), rel=1e-9)
    ratio = square(wrong.residuals(none)) / square(right.residuals(none))
    assert unequal**-2 * (1 - 1e-9) <= ratio <= 1 + 1e-9


@pytest.mark.filterwarnings("ignore:.*of the star is known to fewer")  # in three frames
@pytest.mark.parametrize(("n_frames", "r0"), [(3, 0.2), (20, None)])
def test_a_single_star_has_no_companion(n_frames, r0):
    """Beside another star as a calibrator, by chance in fewer than one of a hundred: none of four."""
    star = torch.zeros(48, 48, dtype=torch.float64)
    star[24, 24] = 1e6
    turbulence = None if r0 is None else TurbulencePhase(r0, 20.0)
    for seed in range(4):
        generator = torch.Generator().manual_seed(seed)
        one, other = (
            frame_observables(simulate_observation(star, MASK, GRID, turbulence, Detector(3.0), n_frames, generator))
            for _ in range(2)
        )
        seen = one.calibrate(other).measurements(550e-9)
        found = fit_pair(seen, map_companions(seen).best)
        assert found.degrees_of_freedom == 36 + 28 - 3
        assert not found.detected
        assert found.explained
