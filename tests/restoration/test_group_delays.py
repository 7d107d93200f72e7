"""Group delays in a band: phases that no path difference has, and pistons that find their fringes again."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.grid import Grid
from torchmask.optics.band import Band
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.descent import descend
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.group_delays import start_from_delays
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS

GRID = Grid.nyquist(1.0, 550e-9, 32, oversampling=1.5)
WIDE = Band.top_hat(600e-9, 200e-9, 5)
WAVE = 2 * math.pi * 600 / 550  # of the band's mean wavelength, in rad at the wavelength of the grid


@pytest.fixture(scope="module")
def wide(five_holes, five_hole_basis, explain):
    """Frames in a band of a third of the wavelength, and the state that explains them."""
    return explain(ExposureModel(five_holes, GRID, five_hole_basis, WIDE))


def off(objective, state, waves):
    """The state whose frames have pistons off by these waves (N,), the same in all of them."""
    pistons = WAVE * torch.tensor(waves, dtype=torch.float64)
    return replace(state, z=state.z + objective.model.aberrations.parameters_of_pistons(pistons))


def waves_off(objective, found, state):
    """Errors (T, N) of the pistons in waves, less what shifts the object or all of the light's phases."""
    basis, holes = objective.model.aberrations, objective.model.pupil.aperture.centers
    wrong = ((basis.coefficients(found.z) - basis.coefficients(state.z))[..., 0] / WAVE).T
    plane = torch.cat([holes, torch.ones(len(holes), 1)], 1).to(wrong)
    return (wrong - plane @ torch.linalg.lstsq(plane, wrong).solution).T


def descended(objective, state, iterations=300):
    return descend(objective, state, iterations, ProjectedLBFGS(), lambda *told: None)


def cost(objective, state):
    return float(objective.evaluator(state.calibration)(state.image, state.z).value)


@pytest.mark.parametrize("moves", [False, True])
def test_offsets_are_phases_of_whole_holes_alike_at_every_wavelength(moves, five_holes):
    """A path difference is not: it has more waves in bluer light. What was there before stays as it is."""
    basis = turbulent_basis(five_holes, 3, 6, 0.25, 20.0)
    basis = basis.in_motion(torch.ones(30, 2, dtype=torch.float64)) if moves else basis
    wider = basis.with_offsets()
    assert (wider.n_own, wider.n_common) == (basis.n_own + 5, basis.n_common)
    assert wider.instants == basis.instants
    narrow, wide = (ExposureModel(five_holes, GRID, one, WIDE).pupil.samples() for one in (basis, wider))
    own = basis.n_own
    kept = torch.cat([wide.basis[:, :own], wide.basis[:, own + 5 :]], 1)
    torch.testing.assert_close(kept, narrow.basis, rtol=0, atol=1e-14)  # rounding
    new = wide.basis[:, own : own + 5]
    holes = five_holes.centers / ExposureModel(five_holes, GRID, basis, WIDE).window.field.period
    nearest = torch.cdist(wide.positions / wide.chromaticity[:, None], holes).argmin(1)
    expected = 2 * math.pi * torch.nn.functional.one_hot(nearest, 5).double()
    torch.testing.assert_close(new, expected, rtol=0, atol=0)
    assert float(wide.chromaticity.max() / wide.chromaticity.min()) > 1.2


@pytest.mark.parametrize("waves", [[0, 1, 0, 0, 0], [0, 0.5, 0, -0.5, 0], [0.3, 0.5, -0.2, -0.4, 0]])
def test_pistons_find_the_fringes_that_a_descent_misses(waves, wide):
    """Whole waves and parts of one, the same in all frames, which the object takes over as far as it can."""
    objective, state = wide
    lost = descended(objective, descended(objective, off(objective, state, waves)))
    assert float(waves_off(objective, lost, state).abs().max()) > 0.3
    begun, evaluations = start_from_delays(objective, lost, 30.0, ProjectedLBFGS())
    assert 100 <= evaluations <= 130
    assert (begun.calibration.noise_inflation == 30).all()
    found = descended(objective, replace(begun, calibration=state.calibration))
    assert float(waves_off(objective, found, state).abs().max()) < 0.05
    assert cost(objective, found) < cost(objective, lost) - 10


def test_right_pistons_stay(wide):
    """Within the errors of group delays, a small part of a wave, and of the object at hand nothing is lost."""
    objective, state = wide
    right = descended(objective, state)
    begun, _ = start_from_delays(objective, right, 30.0, ProjectedLBFGS())
    assert float(waves_off(objective, begun, state).abs().max()) < 0.5
    found = descended(objective, replace(begun, calibration=state.calibration))
    torch.testing.assert_close(cost(objective, found), cost(objective, right), rtol=1e-3, atol=0)
    assert float(waves_off(objective, found, state).abs().max()) < 0.05


def test_common_aberrations_stay_common(five_holes, explain):
    basis = turbulent_basis(five_holes, 3, 6, 0.25, 20.0)
    objective, state = explain(ExposureModel(five_holes, GRID, basis, WIDE))
    begun, _ = start_from_delays(objective, off(objective, state, [0, 0.5, 0, 0, 0]), 30.0, ProjectedLBFGS())
    common = begun.z[:, basis.n_own :]
    torch.testing.assert_close(common, common[:1].expand_as(common), rtol=0, atol=0)
    torch.testing.assert_close(common, state.z[:, basis.n_own :], rtol=0, atol=0)  # only each frame's own are found
    assert begun.z.shape == state.z.shape
