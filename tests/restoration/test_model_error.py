"""What modes beyond the basis leave, against closed forms and against frames that hold such modes."""

import math

import pytest
import torch

from torchmask.atmosphere.von_karman import modal_covariance
from torchmask.grid import Grid
from torchmask.optics.aperture import FullAperture, SparseAperture
from torchmask.restoration.aberrations import turbulent_basis
from torchmask.restoration.background import Background
from torchmask.restoration.forward import ExposureModel
from torchmask.restoration.model_error import LeftOut, expected_error
from torchmask.restoration.objective import Free, MyopicObjective
from torchmask.restoration.state import Calibration, State
from torchmask.restoration.variation import TotalVariation


@pytest.mark.parametrize(("n_modes", "noll", "beyond"), [(3, 0.134, 0.0164), (6, 0.0648, 0.0132)])
def test_variance_left_out_is_that_of_noll(n_modes, noll, beyond):
    """Noll's residuals after `n_modes` less those after the last mode that is drawn, his 0.2944 J^(-0.866)."""
    for aperture in (FullAperture(0.5), SparseAperture([[0.0, 0.4], [0.3, -0.2]], 0.5, 2.0)):
        left = LeftOut.of(aperture, n_modes, r0=0.2, outer_scale=1e4)
        variance = float(left.rest.mixing.square().sum()) / aperture.n_subapertures
        # Noll's constant is 1.0299 where the spectrum's own is 1.0324; conditioning on lower modes takes off up to 8 %.
        assert 0.9 < variance / ((noll - beyond) * (0.5 / 0.2) ** (5 / 3)) < 1.02


def test_holes_are_independent_and_what_is_left_out_has_no_low_modes(five_holes):
    rest = LeftOut.of(five_holes, 6, 0.25, 20.0).rest
    coefficients = rest.coefficients(torch.eye(rest.n_parameters, dtype=torch.float64))
    assert float(coefficients[..., :6].abs().max()) == 0
    assert int((coefficients.square().sum(2) > 0).sum(1).max()) == 1


@pytest.mark.parametrize("n_modes", [1, 3, 6])
def test_what_is_left_out_is_conditional_on_the_modes_that_are_included(n_modes, five_holes):
    """Modes of turbulence are correlated, so the others are known in part: their covariance is the inverse of their
    block of the inverse covariance of all."""
    rest = LeftOut.of(five_holes, n_modes, 0.25, 20.0).rest
    hole = five_holes.replace(centers=torch.zeros(1, 2, dtype=torch.float64))
    covariance = modal_covariance(hole, rest.n_modes, 0.25, 20.0)
    expected = torch.linalg.inv(torch.linalg.inv(covariance)[n_modes:, n_modes:])
    mixing = rest.mixing.unflatten(0, (5, rest.n_modes))[2]
    found = (mixing @ mixing.T)[n_modes:, n_modes:]
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-9 * float(expected.max()))
    if n_modes > 1:  # piston alone is hardly correlated
        assert float((expected - covariance[n_modes:, n_modes:]).abs().max()) > 0.01 * float(expected.max())


def with_left_out(objective, state, left_out, strength=1.0, seed=7):
    """The same frames, through turbulence that has its higher modes too, and their model with these alone."""
    model = objective.model
    total = left_out.rest.n_modes
    wide = ExposureModel(model.pupil.aperture, model.window.grid, total)
    low = torch.nn.functional.pad(model.aberrations.coefficients(state.z), (0, total - model.aberrations.n_modes))
    generator = torch.Generator().manual_seed(seed)
    drawn = torch.randn(len(state.z), left_out.rest.n_parameters, dtype=torch.float64, generator=generator)
    high = math.sqrt(strength) * left_out.rest.coefficients(drawn)
    return wide(state.image, (low + high).flatten(1)) - wide(state.image, low.flatten(1))


def test_without_anything_to_fit_it_is_what_the_modes_do(explain, five_holes):
    """Known aberrations and known transmission: of the latter a share is fitted all the same, and is known here."""
    objective, state = explain(n_frames=40, noise=0.003)
    left_out = LeftOut.of(five_holes, 3, 0.25, 20.0)
    known = objective.with_changes(free=Free.OBJECT)
    error = expected_error(known, state, left_out)
    strength = left_out.strength(objective, state)
    change = with_left_out(objective, state, left_out, strength)
    made = objective.model(state.image, state.z)
    share = (change * made).sum((1, 2)) / (made**2).sum((1, 2))
    left = ((change - share[:, None, None] * made) ** 2).mean((1, 2)) * float(objective.precision)
    assert error.fitted == pytest.approx(1, abs=1e-6)
    scatter = float(left.std()) / math.sqrt(8)  # of the frames that are tried
    assert abs(error.excess - float(left.mean())) < 4 * scatter * math.sqrt(1 + 8 / 40)
    assert scatter < 0.3 * float(left.mean())


def test_what_the_basis_fits_is_taken_off(explain, five_holes):
    objective, state = explain(n_frames=4, noise=0.003)
    left_out = LeftOut.of(five_holes, 3, 0.25, 20.0)
    free = expected_error(objective, state, left_out)
    known = expected_error(objective.with_changes(free=Free.OBJECT), state, left_out)
    assert 0 < free.excess < 0.7 * known.excess
    assert free.fitted == pytest.approx(1 + 14, abs=0.1)  # nothing holds them at this noise
    assert free.phase == known.phase


def test_priors_hold_what_noise_hides(explain, five_holes):
    objective, state = explain(n_frames=4, noise=30.0)
    error = expected_error(objective, state, LeftOut.of(five_holes, 3, 0.25, 20.0))
    assert 1 < error.fitted < 2
    assert error.excess < 1e-3


def test_it_follows_the_turbulence_that_was_found(explain, five_holes):
    objective, state = explain(noise=0.003)
    left_out = LeftOut.of(five_holes, 3, 0.25, 20.0)
    calm = State(state.image, 0.5 * state.z, state.calibration)
    assert left_out.strength(objective, calm) == pytest.approx(left_out.strength(objective, state) / 4)
    there, less = expected_error(objective, state, left_out), expected_error(objective, calm, left_out)
    assert less.phase == pytest.approx(there.phase / 2)
    assert less.excess < 0.5 * there.excess


def test_backgrounds_are_fitted_and_pixels_without_weight_do_not_count(explain, five_holes):
    objective, state = explain(noise=0.003)
    left_out = LeftOut.of(five_holes, 3, 0.25, 20.0)
    sky = MyopicObjective(
        objective.model.beside(Background.PER_FRAME), objective.frames, objective.precision, TotalVariation()
    )
    plain, beside = expected_error(objective, state, left_out), expected_error(sky, state, left_out)
    assert beside.fitted == pytest.approx(plain.fitted + 1, abs=0.01)
    assert beside.excess < plain.excess
    weight = objective.precision.expand_as(objective.frames).clone()
    weight[:, 20:] = 0
    half = MyopicObjective(objective.model, objective.frames, weight, TotalVariation())
    assert expected_error(half, state, left_out).excess != pytest.approx(plain.excess * 20 / 32, rel=0.01)
    assert expected_error(half, state, left_out).fitted < plain.fitted + 1e-6


def test_without_tips_and_tilts_turbulence_is_as_told(five_holes):
    basis = turbulent_basis(five_holes, 1, 0, 0.25, 20.0)
    model = ExposureModel(five_holes, Grid.nyquist(1.0, 550e-9, 32), basis)
    frames = torch.ones(2, 32, 32, dtype=torch.float64)
    objective = MyopicObjective(model, frames, torch.ones(1, 1, 1).double(), TotalVariation())
    ones = torch.ones(2, dtype=torch.float64)
    z = torch.ones(2, basis.n_parameters, dtype=torch.float64)
    state = State(torch.ones(model.window.field.shape).double(), z, Calibration(ones, ones, 1.0))
    assert LeftOut.of(five_holes, 1, 0.25, 20.0).strength(objective, state) == 1.0
