"""Group delays in a band: phases that no path difference has, and pistons that find their fringes again."""

import math
from dataclasses import replace

import pytest
import torch

from torchmask.restoration import group_delays
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.descent import descend
from torchmask.restoration.fringes import change_fringes
from torchmask.restoration.group_delays import delay_errors, start_from_delays, tells_delays
from torchmask.restoration.objective import MyopicObjective
from torchmask.restoration.projected_lbfgs import ProjectedLBFGS

WAVE = 2 * math.pi * 600 / 550  # of the mean wavelength of the wide band, in rad at the wavelength of the grid


def waves_off(objective, found, state):
    """Errors (T, N) of the pistons in waves, less what shifts the object or all of the light's phases."""
    basis, holes = objective.model.aberrations, objective.model.pupil.aperture.centers
    wrong = ((basis.coefficients(found.z) - basis.coefficients(state.z))[..., 0] / WAVE).T
    plane = torch.cat([holes, torch.ones(len(holes), 1)], 1).to(wrong)
    return (wrong - plane @ torch.linalg.lstsq(plane, wrong).solution).T


def descended(objective, state, iterations=150):
    return descend(objective, state, iterations, ProjectedLBFGS(), lambda *told: None)


def found_from(objective, begun, state):
    """The end of a descent with whole waves changed: a single frame may end a fringe off, by how a processor rounds."""
    ended = descended(objective, replace(begun, calibration=state.calibration))
    return descended(objective, change_fringes(objective, ended)[0])


def cost(objective, state):
    return float(objective.evaluator(state.calibration)(state.image, state.z).value)


@pytest.mark.parametrize("moves", [False, True])
def test_offsets_are_phases_of_whole_holes_alike_at_every_wavelength(moves, five_holes, in_band):
    """A path difference is not: it has more waves in bluer light. What was there before stays as it is."""
    basis = turbulent_basis(five_holes, 3, 6, 0.25, 20.0)
    basis = basis.in_motion(torch.ones(30, 2, dtype=torch.float64)) if moves else basis
    wider = basis.with_offsets()
    assert (wider.n_own, wider.n_common) == (basis.n_own + 5, basis.n_common)
    assert wider.instants == basis.instants
    narrow, wide = (in_band(one).pupil.samples() for one in (basis, wider))
    own = basis.n_own
    kept = torch.cat([wide.basis[:, :own], wide.basis[:, own + 5 :]], 1)
    torch.testing.assert_close(kept, narrow.basis, rtol=0, atol=1e-14)  # rounding
    new = wide.basis[:, own : own + 5]
    holes = five_holes.centers / in_band(basis).window.field.period
    nearest = torch.cdist(wide.positions / wide.chromaticity[:, None], holes).argmin(1)
    expected = 2 * math.pi * torch.nn.functional.one_hot(nearest, 5).double()
    torch.testing.assert_close(new, expected, rtol=0, atol=0)
    assert float(wide.chromaticity.max() / wide.chromaticity.min()) > 1.2


@pytest.mark.parametrize("waves", [[0, 1, 0, 0, 0], [0, 0.5, 0, -0.5, 0], [0.3, 0.5, -0.2, -0.4, 0]])
def test_pistons_find_the_fringes_that_a_descent_misses(waves, wide, off):
    """Whole waves and parts of one, the same in all frames, which the object takes over as far as it can."""
    objective, state = wide
    lost = descended(objective, descended(objective, off(objective, state, waves)))
    missed = float(waves_off(objective, lost, state).abs().max())
    assert missed > 0.2  # four times what counts as found
    begun, evaluations = start_from_delays(objective, lost, 30.0, ProjectedLBFGS())
    assert 100 <= evaluations <= 130
    assert (begun.calibration.noise_inflation == 30).all()
    assert float(waves_off(objective, begun, state).abs().max()) < min(0.3, missed)
    found = found_from(objective, begun, state)
    assert float(waves_off(objective, found, state).abs().max()) < 0.05
    assert cost(objective, found) < cost(objective, lost) - 10


def test_right_pistons_stay(wide):
    """Within a fifth of a wave, and a descent from there ends where it did before."""
    objective, state = wide
    right = descended(objective, state)
    begun, _ = start_from_delays(objective, right, 30.0, ProjectedLBFGS())
    assert float(waves_off(objective, begun, state).abs().max()) < 0.2
    found = descended(objective, replace(begun, calibration=state.calibration))
    torch.testing.assert_close(cost(objective, found), cost(objective, right), rtol=1e-3, atol=0)
    assert float(waves_off(objective, found, state).abs().max()) < 0.05


def test_a_search_for_delays_reports_every_iteration(wide, off):
    objective, state = wide
    records = []
    start_from_delays(objective, off(objective, state, [0, 0.5, 0, 0, 0]), 30.0, ProjectedLBFGS(), records.append)
    assert [(one.stage, one.step, one.n_steps) for one in records] == [("group delays", n, 100) for n in range(1, 101)]
    assert records[-1].scalars["cost"] < records[0].scalars["cost"] - 10


def test_common_aberrations_stay_common(five_holes, explain, off, in_band):
    """Each frame's own are found, held by a prior around what is expected."""
    basis = turbulent_basis(five_holes, 3, 6, 0.25, 20.0)
    objective, state = explain(in_band(basis))
    objective = objective.with_changes(centre=state.z)
    lost = off(objective, state, [0, 1, 0, 0, 0])
    begun, _ = start_from_delays(objective, lost, 30.0, ProjectedLBFGS())
    torch.testing.assert_close(begun.z[:, basis.n_own :], state.z[:, basis.n_own :], rtol=0, atol=0)
    assert float(waves_off(objective, lost, state).abs().max()) > 0.39
    assert float(waves_off(objective, begun, state).abs().max()) < 0.2


@pytest.mark.parametrize("moves", [False, True])
def test_float32_and_frames_that_last_find_them_too(moves, five_hole_basis, explain, off, in_band):
    basis = five_hole_basis
    if moves:
        basis = basis.in_motion(0.1 * basis.mixing[:, :4])
    objective, state = explain(in_band(basis))
    single = objective.model.single(), objective.frames.float(), objective.precision.float(), objective.prior
    objective = MyopicObjective(*single)
    lost = off(objective, state, [0, 1, 0, -1, 0])
    begun, _ = start_from_delays(objective, lost, 30.0, ProjectedLBFGS())
    assert begun.z.dtype == torch.float64
    assert float(waves_off(objective, begun, state).abs().max()) < 0.3
    ends = [descended(objective, replace(lost, calibration=state.calibration)), found_from(objective, begun, state)]
    errors = [float(waves_off(objective, one, state).abs().max()) for one in ends]
    assert errors[1] < 0.05 < 0.3 < errors[0]


def by_autograd(objective, state, hole):
    """The standard errors (T,) of one hole's delay, from the exact slope of the fields along it."""
    model, basis = objective.model, objective.model.aberrations
    samples = model.pupil.samples()
    centers = model.pupil.aperture.centers / model.window.field.period
    is_hole = torch.cdist(samples.positions / samples.chromaticity[:, None], centers).argmin(1) == hole
    pistons = WAVE * torch.nn.functional.one_hot(torch.tensor(hole), basis.n_subapertures).double()
    path = samples.phase(basis.parameters_of_pistons(pistons)[None])  # of one wave at the band's mean wavelength

    def frames(step):
        phase = samples.phase(state.z) + step * (path - 2 * math.pi * is_hole)
        amplitude = model.amplitude(samples, samples.field(phase))
        transfer = torch.fft.rfft2(amplitude.abs().square().sum(1))
        return model.window.crop(torch.fft.irfft2(transfer * model.spectrum(state.image), s=model.window.field.shape))

    zero = torch.zeros((), dtype=torch.float64)
    _, slope = torch.autograd.functional.jvp(frames, zero, torch.ones_like(zero))
    return (objective.precision * slope**2).sum((1, 2)).rsqrt()


def test_errors_of_delays_are_cramer_rao_bounds(wide):
    """By finite differences within what these leave out, of second order in a step of a twentieth of a wave."""
    objective, state = wide
    found = delay_errors(objective, state)
    expected = torch.stack([by_autograd(objective, state, hole) for hole in range(5)], 1)
    torch.testing.assert_close(found, expected, rtol=0.05, atol=0)
    inflated = delay_errors(objective, state.with_noise_inflation(4.0))  # the noise as given counts
    torch.testing.assert_close(inflated, found, rtol=1e-12, atol=0)


def test_delays_are_told_by_a_wide_band_in_bright_light(in_band, five_hole_basis, explain):
    """Contrast changes with the square of the delay times the width, so errors go with noise over width squared."""
    said, errors = [], []
    for width, noise in ((200e-9, 0.03), (100e-9, 0.03), (50e-9, 0.03), (100e-9, 0.0075), (200e-9, 0.12)):
        objective, state = explain(in_band(five_hole_basis, width), noise=noise)
        said.append(tells_delays(objective, state))
        errors.append(float(delay_errors(objective, state).median()))
    assert said == [True, False, False, True, False]
    assert errors[2] / errors[1] == pytest.approx(4, rel=0.1)  # narrow enough for the law
    assert errors[3] / errors[1] == pytest.approx(0.25, rel=1e-6)
    assert errors[4] / errors[0] == pytest.approx(4, rel=1e-6)


def test_what_is_expected_of_the_aberrations_holds_them(wide, off):
    objective, state = wide
    known = objective.with_changes(centre=state.z)
    held = off(objective, state, [0, 0.5, 0, 0, 0]).calibrated(aberration_weight=1e9)
    begun, _ = start_from_delays(known, held, 30.0, ProjectedLBFGS())
    torch.testing.assert_close(begun.z, state.z, rtol=0, atol=1e-3)  # 1e9 against a misfit of some 1e5


@pytest.mark.parametrize(
    ("errors", "tells"),
    [([0.1, 0.1, 0.26, 0.26, 0.26], False), ([0.24, 0.24, 0.24, 9.0, 9.0], True), ([0.26] * 5, False)],
)
def test_delays_are_told_if_those_of_most_holes_are_to_a_quarter_of_a_wave(errors, tells, explained, monkeypatch):
    """Of which two standard errors are half a wave."""
    monkeypatch.setattr(group_delays, "delay_errors", lambda *_: torch.tensor([errors, errors]))
    assert tells_delays(*explained) is tells
